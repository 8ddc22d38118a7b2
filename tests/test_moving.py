"""Methods that learn motion: on scenes that move, and on scenes that do not."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.cameras.view import View
from nerfloom.data.pixels.batch import composite
from nerfloom.data.scene import Scene
from nerfloom.fields.deformed import DeformedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.registry import load_method
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run, tiny_trainer

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "kplanes hybrid": ("kplanes", {}),
    "kplanes explicit": ("kplanes", {"decoder": "explicit"}),
    "dnerf": ("dnerf", {}),
    "dnerf occupancy": ("dnerf", {"sampler": "occupancy", "samples_per_batch": 4096, "from_first_image": True}),
    "t-nerf": ("dnerf", {"variant": "t-nerf", "sampler": "occupancy", "samples_per_batch": 4096}),
    "dnerf hash": (
        "dnerf",
        {"sampler": "occupancy", "canonical": "hash-grid", "log2_table_size": 10, "samples_per_batch": 4096},
    ),
}


def moving_trainer(name: str, data: Path, folder: Path, **changes: Any) -> Trainer:
    """A trainer on the tiny data set with each photograph twice: red at time 0, and blue at time 1."""
    method, settings = VARIANTS[name]
    still = tiny_trainer("instant-ngp", data, folder / "still").train_set
    count = len(still)
    red, blue = still.pixels.clone(), still.pixels.clone()
    red[:, :3], blue[:, :3] = torch.tensor([255, 0, 0]), torch.tensor([0, 0, 255])
    moving = dataclasses.replace(
        still,
        pixels=torch.cat([red, blue]),
        cameras=still.cameras[torch.arange(count).repeat(2)],
        times=torch.tensor([0.0, 1.0]).repeat_interleave(count),
        paths=still.paths * 2,
        scene=dataclasses.replace(still.scene, moving=True, num_cameras=2 * count),
    )
    (folder / "run").mkdir()
    settings = {"max_num_iterations": 80, "max_eval_images": 0, **settings, **changes}
    return Trainer.of(tiny_run(method, data, folder / "run", **settings), moving)


def mean_squared_error(trainer: Trainer) -> float:
    """Error of the first camera's pictures at both times over white: fixed, unlike a batch's over random colours."""
    photographs, white = trainer.train_set, torch.ones(3)
    errors = []
    for index in (0, len(photographs) // 2):
        image = trainer.model.render_view(photographs.view(index), white)
        photograph = composite(photographs.image(index).float() / 255, white)
        errors.append((image.rgb - photograph).square().mean())
    return float(torch.stack(errors).mean())


@pytest.mark.medium
@pytest.mark.parametrize("name", [name for name in VARIANTS if not name.startswith("dnerf")])
def test_colours_follow_time(name: str, shared_tiny: Path, tmp_path: Path) -> None:
    """The same camera at both ends of time: the ball is redder in the one and bluer in the other."""
    trainer = moving_trainer(name, shared_tiny, tmp_path)
    trainer.train()
    assert trainer.state.skipped == 0
    cameras, white = trainer.train_set.cameras, torch.ones(3)
    found = []
    for time in (0.0, 1.0):
        image = trainer.model.render_view(dataclasses.replace(View.of(cameras, 0), time=time), white)
        ball = image.accumulation > 0.5  # over white, light through the ball changes neither difference
        assert ball.float().mean() > 0.05
        found.append(image.rgb[ball].mean(0))
    assert found[0][0] - found[0][2] > 0.3
    assert found[1][2] - found[1][0] > 0.3


@pytest.mark.medium
@pytest.mark.parametrize("name", ["dnerf", "dnerf occupancy", pytest.param("dnerf hash", marks=pytest.mark.slow)])
def test_what_is_deformed_learns_to_move(name: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Deformed points keep their colours, as in the paper: so a change of colour is learnt as displacement."""
    trainer = moving_trainer(name, shared_tiny, tmp_path, max_num_iterations=60)
    field, positions = trainer.model.field, torch.rand(100, 3)
    small = field.deformation(positions, torch.ones(100))[0].abs().max()
    before = mean_squared_error(trainer)
    trainer.train()
    assert trainer.state.skipped == 0
    assert mean_squared_error(trainer) < 0.8 * before
    assert field.deformation(positions, torch.ones(100))[0].abs().max() > 10 * small
    fixed = bool((field.deformation(positions, torch.zeros(100))[0] == 0).all())
    assert fixed == trainer.config.from_first_image


@pytest.mark.parametrize(("name", "what"), [("kplanes hybrid", "planes of time"), ("dnerf", "deformation")])
def test_without_times_what_they_need_is_left_out(name: str, what: str, shared_tiny: Path, tmp_path: Path) -> None:
    method, settings = VARIANTS[name]
    still = tiny_trainer(method, shared_tiny, tmp_path / "alone", **settings)
    moving = moving_trainer(name, shared_tiny, tmp_path)
    said = {decision.option: decision.choice for decision in still.profile.decisions}
    assert said[what] == "left out"
    assert what not in {decision.option for decision in moving.profile.decisions}
    assert still.model.size() < moving.model.size()


def test_the_first_image_is_like_the_others() -> None:
    """Displacements are continuous at time 0, unless they are fixed there."""
    torch.manual_seed(0)
    positions, times = torch.rand(9, 3), torch.tensor([0.0, 1e-6])
    for fixed in (False, True):
        field = DeformedField(NeRFField(32, 3, 2), 32, 3, fixed_start=fixed)
        torch.nn.init.normal_(field.after_skip[-1].weight)  # type: ignore[arg-type]
        at_start, soon = (field.deformation(positions, time.expand(9))[0] for time in times)
        assert soon.norm(dim=-1).min() > 0.1
        assert torch.allclose(at_start, soon, atol=1e-3) != fixed


def times_decided(method: str, count: int, **settings: Any) -> dict[str, str]:
    """Decisions of `method` for a scene with `count` times of images, by the option's words."""
    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 4.0, count, True, True, 64, num_times=count)
    found = load_method(method)
    _, made = found.decided(dataclasses.replace(found.config, **settings), scene)
    return {decision.option: decision.choice for decision in made}


def test_the_number_of_times_decides_about_time() -> None:
    """A sixth as many vertices, three at least; cells are larger where each slice of time has its own."""
    assert times_decided("kplanes", 150)["vertices along time"] == "25"
    assert times_decided("kplanes", 8)["vertices along time"] == "3"
    assert times_decided("kplanes", 150)["grid resolution"] == "64"
    assert times_decided("kplanes", 150)["slices of time in the occupancy grid"] == "16"
    assert times_decided("dnerf", 27, canonical="hash-grid")["slices of time in the occupancy grid"] == "3"
    for few in (times_decided("kplanes", 8), times_decided("kplanes", 150, sampler="proposal")):
        assert not {"grid resolution", "slices of time in the occupancy grid"} & set(few)


def test_proposals_of_a_method_that_learns_motion_see_time() -> None:
    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 4.0, 9, False, True, 64, unbounded=True, num_times=9)
    found = load_method("kplanes")
    config, _ = found.decided(dataclasses.replace(found.config, base_resolution=8), scene)
    model = found.build(config, scene)
    sampler = model.sampler
    assert isinstance(sampler, ProposalSampler)
    torch.manual_seed(0)
    rays = Rays(torch.zeros(4, 3), torch.eye(3)[[0, 1, 2, 0]], torch.full((4,), 0.1), torch.full((4,), 4.0))
    for proposal in sampler.proposals:
        with torch.no_grad():
            proposal.encoding.table.uniform_(0, 2)  # planes of time start at 1, where nothing moves
    starts = [
        sampler.sample(dataclasses.replace(rays, times=torch.full((4,), time)), model.field, jitter=False).t_starts
        for time in (0.1, 0.1, 0.6)
    ]
    assert torch.equal(starts[0], starts[1])
    assert (starts[0] - starts[2]).abs().max() > 1e-3


def test_nothing_is_displaced_at_time_zero() -> None:
    torch.manual_seed(0)
    canonical = NeRFField(32, 3, 2)
    field = DeformedField(canonical, 32, 3)
    torch.nn.init.normal_(field.after_skip[-1].weight)  # type: ignore[arg-type]
    positions = torch.rand(9, 3)
    times = torch.tensor([0.0, 0.5, 1.0]).repeat(3)
    moved = field.deformation(positions, times)[0]
    assert bool((moved[times == 0] == 0).all())
    assert bool((moved[times > 0] != 0).all())
    sigma, features = field.density(Points(positions, times))
    expected, known = canonical.density(Points(positions + moved))
    torch.testing.assert_close(sigma, expected)
    torch.testing.assert_close(features, known)
    with pytest.raises(ValueError, match="needs the times"):
        field.density(Points(positions))
