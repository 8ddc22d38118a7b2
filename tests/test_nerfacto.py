"""Nerfacto: decisions from the scene, and the effect of each part."""

import dataclasses
from functools import partial
from pathlib import Path

import pytest
import torch

from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.scene import Scene
from nerfloom.evaluation.appearance import fit_appearance
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.fields.appearance import Appearance
from nerfloom.registry import load_method
from nerfloom.training.trainer import Trainer
from tests.conftest import EditJson
from tests.training.helpers import chosen, said_otherwise, tiny_run, tiny_trainer

SCENE = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, 6.0, 4, True, False, 32)
captured = partial(said_otherwise, "nerfacto")
"""A trainer on the tiny data set with other facts of its scene."""


def test_a_bounded_scene_with_exact_poses_needs_little(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = captured(shared_tiny, tmp_path, {})
    found = chosen(trainer)
    assert found["contraction"] == found["gradient scaling near cameras"] == found["pose refinement"] == "off"
    assert (found["distortion loss"], found["appearance"]) == ("0", "none")
    model = trainer.model
    assert not model.field.unbounded
    assert model.poses is None
    assert model.field.appearance is None


def test_what_ends_at_its_box_is_marched_and_all_else_is_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lego after 45 s: 31.5 dB by an occupancy grid, 24.9 dB by proposals (docs/notes/captures.md)."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    method = load_method("nerfacto")

    def decided(seconds: float | None, **facts: object) -> tuple[str, int | None, float]:
        machine = MachineConfig(device_type="cpu")
        asked = dataclasses.replace(method.config, max_seconds=seconds, machine=machine)
        config, _ = method.decided(asked, dataclasses.replace(SCENE, **facts))
        return config.sampler, config.samples_per_batch, config.thin_gradients

    assert decided(45.0) == decided(150.0) == ("occupancy", 2**15, 0.5)
    assert decided(300.0) == decided(None) == ("occupancy", 2**16, 0.5)
    assert decided(45.0, unbounded=True) == decided(None, unbounded=True) == ("proposal", None, 0.0)


def test_a_capture_gets_what_it_needs(shared_tiny: Path, tmp_path: Path) -> None:
    facts = {"unbounded": True, "poses": "device", "appearance_varies": True}
    trainer = captured(shared_tiny, tmp_path, facts, max_num_iterations=4)
    found = chosen(trainer)
    assert found["contraction"] == found["gradient scaling near cameras"] == "on"
    assert found["pose refinement"] == "SO3xR3"
    assert found["appearance"] == "vector"
    trainer.train()
    model = trainer.model
    assert bool((model.poses.tangents != 0).any())
    assert model.field.appearance.size == 16
    assert bool((model.field.appearance.vectors != 0).any())
    report = trainer.train_step()
    assert {"rgb", "interlevel", "distortion"} <= report.losses.keys()


def test_what_is_asked_for_is_done_and_not_called_a_decision(shared_tiny: Path, tmp_path: Path) -> None:
    asked = {
        "contraction": False, "distortion_loss_mult": 0.0, "appearance": "none", "camera_optimizer": "off",
        "gradient_scaling": False,
    }  # fmt: skip
    facts = {"unbounded": True, "poses": "device", "appearance_varies": True}
    trainer = captured(shared_tiny, tmp_path, facts, **asked)
    assert not {"contraction", "distortion loss", "appearance", "pose refinement"} & chosen(trainer).keys()
    assert trainer.model.poses is None
    assert not trainer.model.field.unbounded


def test_poses_that_are_to_be_refined_get_proposals_in_a_box_too(shared_tiny: Path, tmp_path: Path) -> None:
    """Marched samples have no gradient to rays."""
    trainer = captured(shared_tiny, tmp_path, {}, sampler="auto", camera_optimizer="SE3")
    assert chosen(trainer)["sampler"] == "proposal"
    for _ in range(4):
        trainer.train_step()
    assert bool((trainer.model.poses.tangents != 0).any())


@pytest.mark.medium
@pytest.mark.parametrize("unbounded", [True, False])
def test_it_learns(unbounded: bool, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = captured(shared_tiny, tmp_path, {"unbounded": unbounded}, max_num_iterations=60)
    first = trainer.train_step().losses["rgb"]
    trainer.train()
    assert trainer.state.skipped == 0
    assert trainer.train_step().losses["rgb"] < first / 3


def test_gradients_fade_towards_the_camera(shared_tiny: Path, tmp_path: Path) -> None:
    """Moving a scene to a tenth of the distance scales its gradients by a hundredth, values being the same."""
    trainer = captured(shared_tiny, tmp_path, {"unbounded": True})
    assert trainer.model.renderer.unit_length is not None
    from nerfloom.kernels.math import scale_gradient

    values = torch.ones(3, 2, requires_grad=True)
    out = scale_gradient(values, torch.tensor([0.01, 1.0, 0.25]))
    assert torch.equal(out, values)
    out.sum().backward()
    assert values.grad is not None
    assert values.grad[:, 0].tolist() == pytest.approx([0.01, 1.0, 0.25])


def test_held_out_photographs_are_shown_in_the_mean_appearance() -> None:
    appearance = Appearance(2, 3)
    with torch.no_grad():
        appearance.vectors.copy_(torch.tensor([[0.0, 3.0], [1.0, 0.0], [2.0, 0.0]]))
    assert appearance(torch.tensor([2, 0]), 2).tolist() == [[2.0, 0.0], [0.0, 3.0]]
    assert appearance(None, 2).tolist() == [[1.0, 1.0], [1.0, 1.0]]
    with appearance.shown(torch.tensor([5.0, 6.0])):
        assert appearance(None, 1).tolist() == [[5.0, 6.0]]
    assert appearance(None, 1).tolist() == [[1.0, 1.0]]


def test_in_a_share_of_the_steps_an_image_has_the_mean_appearance() -> None:
    torch.manual_seed(0)
    appearance = Appearance(2, 400, mean_share=0.25)
    with torch.no_grad():
        appearance.vectors.copy_(torch.arange(800.0).view(400, 2))
    indices, mean = torch.arange(400).repeat_interleave(3), appearance.vectors.detach().mean(0)
    shown = appearance(indices, len(indices)).view(400, 3, 2)
    has_mean = (shown == mean).all(-1)
    assert torch.equal(has_mean, has_mean[:, :1].expand(-1, 3))  # all samples of an image alike
    assert has_mean[:, 0].float().mean().item() == pytest.approx(0.25, abs=4 * (0.25 * 0.75 / 400) ** 0.5)
    assert torch.equal(shown[~has_mean[:, 0], 0], appearance.vectors[~has_mean[:, 0]])
    shown.sum().backward()
    assert appearance.vectors.grad is not None
    assert torch.equal(appearance.vectors.grad, torch.where(has_mean[:, :1], 0.0, 3.0).expand(-1, 2))
    assert not torch.equal(appearance(indices, len(indices)).view(400, 3, 2), shown)  # others in the next step
    assert torch.equal(appearance.eval()(indices, len(indices)), appearance.vectors[indices])


def dimmed(folder: Path, out: Path, factors: torch.Tensor, **settings: object) -> Trainer:
    """Return a trained nerfacto of the tiny data set with photographs darkened by factors (M,)."""
    still = tiny_trainer("nerfacto", folder, out / "still").train_set
    sizes, pixels = still.cameras.widths * still.cameras.heights, still.pixels.clone()
    pixels[:, :3] = (still.pixels[:, :3] * factors.repeat_interleave(sizes)[:, None]).round().to(torch.uint8)
    varied = dataclasses.replace(still, pixels=pixels, scene=dataclasses.replace(still.scene, appearance_varies=True))
    (out / "run").mkdir()
    trainer = Trainer.of(tiny_run("nerfacto", folder, out / "run", max_eval_images=0, **settings), varied)
    trainer.train()
    return trainer


@pytest.mark.medium
def test_half_of_a_held_out_photograph_tells_the_others_appearance(shared_tiny: Path, tmp_path: Path) -> None:
    """Trained on darker and lighter copies, a held-out dark photograph is found to be dark from its left half.

    The mean vector is not trained here: each light comes from one direction, so the mean would know it too.
    """
    factors = torch.linspace(0.1, 1.0, len(tiny_trainer("nerfacto", shared_tiny, tmp_path / "any").train_set))
    trainer = dimmed(shared_tiny, tmp_path, factors, max_num_iterations=150, mean_appearance_share=0.0)
    model = trainer.model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    found = {}
    for choice in ("mean", "half"):
        model.field.appearance.held_out = choice
        found[choice] = evaluate(model, trainer.train_set, max_images=2).per_image[0]["psnr"]
    assert found["half"] > found["mean"] + 2
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


@pytest.mark.medium
def test_the_mean_appearance_is_what_photographs_have_in_common(
    tiny: Path, edit_json: EditJson, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each photograph is there twice, once as it is and once five times darker: pictures show the light between them.

    The fit of an appearance starts from the appearance of a photograph in the same light.
    """
    edit_json(lambda content: content.update(frames=2 * content["frames"]))
    factors, off = torch.tensor([1.0, 0.2]).repeat_interleave(10), {}
    for share in (0.0, 0.25):
        (tmp_path / str(share)).mkdir()
        trainer = dimmed(tiny, tmp_path / str(share), factors, max_num_iterations=300, mean_appearance_share=share)
        shown = trainer.model.render_view(trainer.train_set.view(0), torch.zeros(3))
        expected = trainer.train_set.image(0)[..., :3] / 255 * 0.6
        inside = shown.accumulation > 0.95
        off[share] = (shown.rgb - expected)[inside].square().mean().sqrt().item()
    print(f"off the mean photograph by {off[0.0]:.3f} without the mean vector in training, {off[0.25]:.3f} with it")
    assert off[0.25] < 0.6 * off[0.0]
    monkeypatch.setattr("nerfloom.evaluation.appearance.STEPS", 0)
    model, dataset = trainer.model, trainer.train_set
    appearance = model.appearance
    assert appearance is not None
    for index in range(0, len(factors), 3):  # of either light
        start = fit_appearance(model, dataset, dataset.cameras.image_pixels(index).view(-1), torch.zeros(3))
        assert start is not None
        (same,) = (appearance.vectors - start).abs().amax(-1).eq(0).nonzero().squeeze(-1).tolist()
        assert factors[same] == factors[index]


@pytest.mark.medium
def test_normals_are_learnt_and_shown(shared_tiny: Path, tmp_path: Path) -> None:
    """The ball has its normals as colours: pictures of the two agree."""
    trainer = captured(shared_tiny, tmp_path, {}, predict_normals=True, max_num_iterations=90)
    trainer.train()
    assert {"normals", "orientation"} <= trainer.train_step().losses.keys()
    image = trainer.model.render_view(trainer.train_set.view(0), torch.ones(3))
    assert [output.name for output in image.outputs] == ["normals"]
    middle = image.accumulation > 0.95
    agreement = (image.extras["normals"] * (2 * image.rgb - 1)).sum(-1)[middle]
    assert agreement.mean() > 0.7


def test_appearances_of_many_samples_learn_the_same_bits_each_time() -> None:
    """Gradients of looked-up rows that torch adds up by atomics differ from run to run."""
    torch.manual_seed(0)
    indices, weights = torch.randint(3, (50_000,)), torch.randn(50_000, 2)

    def gradient() -> torch.Tensor:
        appearance = Appearance(2, 3)
        (weights * appearance(indices, len(indices))).sum().backward()
        assert appearance.vectors.grad is not None
        return appearance.vectors.grad

    first = gradient()
    assert all(torch.equal(gradient(), first) for _ in range(5))
    exact = torch.zeros(3, 2, dtype=torch.float64).index_add_(0, indices, weights.double())
    torch.testing.assert_close(first.double(), exact, rtol=1e-4, atol=1e-3)
