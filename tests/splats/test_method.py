"""gaussian-splatting as a method: choices by the budget, starts, masks, pictures, and checkpoints of other sizes."""

import dataclasses
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom import ConfigError, View
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.data.scene import Scene
from nerfloom.export.surfaces import FoundSurfaces
from nerfloom.methods.gaussian_splatting import METHOD, GaussianSplatting, GaussianSplattingConfig, decide
from nerfloom.splats.drawing import draw_colors, draw_view, splat_camera
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.training.checkpoint import load_checkpoint
from tests.cli.helpers import called
from tests.dataparsers.captures import write_capture
from tests.training.helpers import said_otherwise, tiny_trainer

SCENE = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, 6.0, 4, True, False, 32, image_pixels=400 * 400)


def camera(model: str = "pinhole", distance: float = 3.0) -> Cameras:
    """One camera on the z axis that looks at the origin."""
    pose = torch.eye(4)[None, :3].clone()
    pose[0, 2, 3] = distance
    size = torch.tensor([33])
    return Cameras(pose, *(torch.tensor([v]) for v in (40.0, 40.0, 16.5, 16.5)), size, size, model)


def ball(logit: float = 20.0, **changes: Any) -> Gaussians:
    """One opaque flat Gaussian at the origin, facing the camera."""
    flat = torch.tensor([[0.2, 0.2, 0.01]]).log()
    turn, rest = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3, 0)
    whole = Gaussians(torch.zeros(1, 3), flat, turn, torch.tensor([logit]), torch.ones(1, 3), rest)
    return dataclasses.replace(whole, **changes)


def test_cameras_that_cannot_be_drawn_are_refused_before_the_run_has_a_folder(tmp_path: Path) -> None:
    """Images of parallel rays; a method that casts rays learns from them."""
    data = write_capture(tmp_path / "plans", 8, camera_model="ORTHOPHOTO")
    words = ("--data", data, "--output-dir", tmp_path / "out", "--vis", "none", "--max-num-iterations", 1)
    done = called("ns-train", "gaussian-splatting", *words)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "error: gaussian-splatting cannot draw orthographic cameras, only pinhole, opencv, fisheye, equirectangular; "
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("less", "more"), [(20.0, 60.0), (60.0, 300.0), (300.0, 3000.0)])
def test_more_time_has_more_gaussians_and_smaller_steps(less: float, more: float) -> None:
    first, last = (decide(GaussianSplattingConfig(max_seconds=s), SCENE)[0] for s in (less, more))
    assert first.num_gaussians is not None
    assert last.num_gaussians is not None
    assert first.num_gaussians < last.num_gaussians
    assert first.rate_factor is not None
    assert last.rate_factor is not None
    assert first.rate_factor >= last.rate_factor >= 1


def test_what_is_given_stays() -> None:
    config, made = decide(GaussianSplattingConfig(num_gaussians=77, rate_factor=2.0), SCENE)
    assert (config.num_gaussians, config.rate_factor) == (77, 2.0)
    assert not [one for one in made if one.option in ("Gaussians", "factor of learning rates")]


def test_a_picture_tells_depth_opacity_and_normals() -> None:
    seen = splat_camera(camera(), near=0.1)
    picture = draw_view(ball(), seen, 1, torch.zeros(3), far=9.0)
    assert picture.size == (33, 33)
    assert float(picture.depth[16, 16]) == pytest.approx(3.0, abs=1e-4)
    assert float(picture.median_depth[16, 16]) == pytest.approx(3.0, abs=1e-4)
    assert float(picture.accumulation[16, 16]) == pytest.approx(0.999, abs=1e-5)
    torch.testing.assert_close(picture.extras["normals"][16, 16], torch.tensor([0.0, 0.0, 1.0]))
    assert float(picture.depth[0, 0]) == float(picture.median_depth[0, 0]) == 9.0
    assert float(picture.accumulation[0, 0]) == 0
    coarse = draw_view(ball(), seen, 4, torch.zeros(3), 9.0)
    torch.testing.assert_close(coarse.rgb, picture.rgb[2::4, 2::4])
    assert torch.equal(draw_colors(ball(), seen, 1, torch.zeros(3)), picture.rgb)
    assert torch.equal(draw_colors(ball(), seen, 4, torch.zeros(3)), coarse.rgb)


def test_the_image_position_is_the_cameras() -> None:
    """A small Gaussian is brightest where the framework's cameras project its centre, with and without a lens."""
    bent = dataclasses.replace(camera("opencv"), lens=torch.tensor([[0.2, -0.1, 0.01, -0.02, 0, 0, 0, 0, 0]]))
    fisheye = dataclasses.replace(camera("fisheye"), lens=torch.tensor([[0.1, -0.05, 0.02, 0.0]]))
    for one in (camera(), bent, camera("fisheye"), fisheye, camera("equirectangular")):
        center = torch.tensor([[0.4, -0.7, 0.3]])
        column, row, seen = one.project(center, 0)
        assert bool(seen)
        small = ball(means=center, log_scales=torch.full((1, 3), -4.0))
        image = draw_colors(small, splat_camera(one, near=0.1), 1, torch.zeros(3))[..., 0]
        rows, columns = torch.meshgrid(torch.arange(33.0), torch.arange(33.0), indexing="ij")
        assert float((image * rows).sum() / image.sum()) == pytest.approx(float(row), abs=0.05)
        assert float((image * columns).sum() / image.sum()) == pytest.approx(float(column), abs=0.05)


def test_a_camera_that_cannot_be_drawn_for_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"orthographic cameras, only for pinhole, opencv, fisheye, equi"):
        splat_camera(camera("orthographic"), 0.1)


@pytest.mark.parametrize(("start", "match"), [("points", "no points of a reconstruction")])
def test_a_start_that_the_data_has_not_is_refused(start: str, match: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "run", start=start)
    with pytest.raises(ConfigError, match=match):
        trainer.prepare()


def test_masked_pixels_teach_nothing() -> None:
    torch.manual_seed(3)
    config, _ = decide(GaussianSplattingConfig(num_gaussians=300, opacity_penalty=0.0, scale_penalty=0.0), SCENE)
    model = GaussianSplatting(config, SCENE)
    weights = torch.zeros(33, 33)
    weights[:, :12] = 1
    gradients = []
    for other in (0.0, 1.0):
        target = torch.full((33, 33, 3), 0.3)
        target[:, 12:] = other
        batch = ViewBatch(0, View(camera()), target, torch.zeros(3), weights=weights)
        model.zero_grad()
        model.loss(batch, 0).total.backward()
        gradients.append([p.grad.clone() for p in model.parameters() if p.grad is not None])
    assert gradients[0]
    for first, second in zip(*gradients, strict=True):
        assert torch.equal(first, second)
    assert any(float(first.abs().sum()) > 0 for first in gradients[0])


@pytest.mark.parametrize(
    ("facts", "sure"),
    [({}, True), ({"has_alpha": True}, True), ({"half": 4.0}, False), ({"unbounded": True}, False)],
)
def test_surfaces_of_a_field_are_sure_in_a_box_that_cameras_see_from_outside(facts: dict[str, Any], sure: bool) -> None:
    """The camera is 3 units from the middle of the box. Where surfaces are not sure, penalties count."""
    half = facts.get("half", 1.0)
    changes = {"has_alpha": False, **{name: value for name, value in facts.items() if name != "half"}}
    scene = dataclasses.replace(SCENE, box=torch.tensor([[-half] * 3, [half] * 3]), **changes)
    scene = dataclasses.replace(scene, num_cameras=1, camera_to_worlds=camera().camera_to_worlds)
    model = GaussianSplatting(METHOD.decided(GaussianSplattingConfig(num_gaussians=300), scene)[0], scene)
    model.found.fill_(True)
    batch = ViewBatch(0, View(camera()), torch.full((33, 33, 3), 0.3), torch.zeros(3))
    terms = model.loss(batch, 0).terms.keys()
    assert {"opacity", "scale"} & terms == (set() if sure else {"opacity", "scale"})


def test_growth_asks_for_as_much_of_images_of_half_the_size() -> None:
    """Image positions are in units of the drawn image: its size must not change a Gaussian's growth."""
    torch.manual_seed(4)
    size = torch.tensor([64])
    large = Cameras(camera().camera_to_worlds, *(torch.tensor([v]) for v in (80.0, 80.0, 32.0, 32.0)), size, size)
    batch = ViewBatch(0, View(large), torch.full((64, 64, 3), 0.9), torch.zeros(3))
    scene, means = dataclasses.replace(SCENE, image_size=64), []
    for reduced_until in (0.0, 1.0):
        config, _ = decide(GaussianSplattingConfig(reduced_until=reduced_until, ssim_weight=0.0), scene)
        model = GaussianSplatting(config, scene)
        model.set_gaussians(ball(0.0, log_scales=torch.full((1, 3), -1.0), harmonics=torch.zeros(1, 3, 15)))
        model.loss(batch, 0).total.backward()
        model.after_every_step(0, 0.0, finite=True)
        means.append(float(model.strategy.gradients.take(1)))
    assert means[1] == pytest.approx(means[0], rel=0.05)


@pytest.mark.slow
def test_a_field_shows_where_to_start(shared_tiny: Path, tmp_path: Path) -> None:
    """Without a step of its own it is better than anywhere in the box, with the same bits each time."""
    from nerfloom.evaluation.evaluator import evaluate

    psnr, bits = {}, []
    for start in ("field", "field", "random"):
        settings = {"start": start, "field_steps": 60, "start_gaussians": 2_000, "num_gaussians": 2_000}
        trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / f"{start}{len(bits)}", True, **settings)
        trainer.prepare()
        assert trainer.eval_set is not None
        found = evaluate(trainer.model, trainer.eval_set)
        psnr[start] = found.results["psnr"]
        assert found.results["num_rays_per_sec"] is None  # it casts none
        assert "images/s" in found.line()
        bits.append(torch.cat([p.detach().flatten() for p in trainer.model.parameters()]))
    print(psnr)
    assert psnr["field"] > psnr["random"] + 3
    assert torch.equal(bits[0], bits[1])


@pytest.mark.parametrize(("inside", "asked"), [(False, (200, 20.0)), (True, (1000, 40.0))])
def test_a_field_has_more_time_where_every_ray_ends_in_the_box(
    inside: bool, asked: tuple[int, float], shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 100 s: the same opaque images, with cameras in a large box or outside a small one."""
    given: list[tuple[int, float]] = []

    def found(method: Any, dataset: Any, config: Any, steps: int, seconds: float, count: int) -> FoundSurfaces:
        given.append((steps, seconds))
        places, first = torch.rand(50, 3), torch.zeros(50, dtype=torch.long)
        return FoundSurfaces(places, places, first, first, torch.ones(50), None)

    monkeypatch.setattr("nerfloom.methods.gaussian_splatting.found_surfaces", found)
    half = 9.0 if inside else 1.5
    facts = {"has_alpha": False, "unbounded": False, "box": torch.tensor([[-half] * 3, [half] * 3])}
    trainer = said_otherwise(
        "gaussian-splatting", shared_tiny, tmp_path, facts, start="field", field_steps="auto", max_seconds=100.0
    )
    trainer.prepare()
    assert given == [pytest.approx(asked)]


@pytest.mark.parametrize(
    ("group", "unbounded", "asked"),
    [("SE3", True, ("nerfacto", "SE3")), ("off", True, ("nerfacto", "off")), ("SE3", False, ("instant-ngp", None))],
)
def test_cameras_start_where_the_field_has_moved_them(
    group: str, unbounded: bool, asked: tuple[str, str | None], shared_tiny: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The field refines poses as the Gaussians do. Its surfaces are where the moved cameras see them."""
    methods: list[tuple[str, str | None]] = []
    motions = 0.01 * torch.randn(10, 6, generator=torch.Generator().manual_seed(5))

    def found(method: Any, *rest: Any) -> FoundSurfaces:
        refined = getattr(method.config, "camera_optimizer", None)
        methods.append((method.name, refined))
        places, first = torch.rand(50, 3), torch.zeros(50, dtype=torch.long)
        return FoundSurfaces(places, places, first, first, torch.ones(50), motions if refined == "SE3" else None)

    monkeypatch.setattr("nerfloom.methods.gaussian_splatting.found_surfaces", found)
    asked_for = {"start": "field", "camera_optimizer": group}
    trainer = said_otherwise("gaussian-splatting", shared_tiny, tmp_path, {"unbounded": unbounded}, **asked_for)
    trainer.prepare()
    assert methods == [asked]
    model = trainer.model
    assert isinstance(model, GaussianSplatting)
    if group == "off":
        assert model.poses is None
    else:
        assert model.poses is not None
        expected = motions if asked[1] == "SE3" else torch.zeros(10, 6)
        assert torch.equal(model.poses.tangents.detach(), expected)


def test_a_checkpoint_has_as_many_gaussians_as_it_has(shared_tiny: Path, tmp_path: Path) -> None:
    first = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "first")
    for _ in range(25):
        first.train_step()
    count = len(first.model.gaussians())  # type: ignore[operator]
    assert count > 400
    second = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "second")
    second.restore(load_checkpoint(first.save()))
    assert isinstance(second.model, HasGaussians)
    assert len(second.model.gaussians()) == count
    second.train_step()
    assert second.state.step == 26


def test_images_of_nothing_leave_nothing(tiny: Path, tmp_path: Path) -> None:
    """All Gaussians are removed, and none is added: training, pictures and a resumed run do without any."""
    for file in (tiny / "train").iterdir():
        iio.imwrite(file, np.zeros((20, 20, 4), np.uint8))
    settings: dict[str, Any] = {"start": "random", "rate_factor": 50.0}
    first = tiny_trainer("gaussian-splatting", tiny, tmp_path / "first", **settings)
    for _ in range(45):
        first.train_step()
    assert first.state.skipped == 0
    assert isinstance(first.model, HasGaussians)
    assert len(first.model.gaussians()) == 0
    view = View(camera())
    picture = first.model.render_view(view, torch.tensor([0.2, 0.4, 0.6]))
    torch.testing.assert_close(picture.rgb, torch.tensor([0.2, 0.4, 0.6]).expand(33, 33, 3))
    torch.testing.assert_close(first.model.render_rgb(view, torch.ones(3)), torch.ones(33, 33, 3))
    assert float(picture.accumulation.max()) == 0
    second = tiny_trainer("gaussian-splatting", tiny, tmp_path / "second", **settings)
    second.restore(load_checkpoint(first.save()))
    second.train_step()
    assert len(second.model.gaussians()) == 0  # type: ignore[operator]


def test_colours_may_be_the_same_from_everywhere(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "run", degree=0)
    for step in range(30):
        trainer.train_step()
        if step == 4:
            before = trainer.state.train_mse
    assert trainer.state.train_mse < 0.8 * before
    assert trainer.model.gaussians().harmonics.shape[2] == 0  # type: ignore[operator]


def test_the_method_is_declared() -> None:
    assert METHOD.model is GaussianSplatting
    assert METHOD.field is None


@pytest.mark.medium
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
def test_a_run_goes_on_with_the_same_bits_between_two_changes(strategy: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Gradients that are being counted are a part of a checkpoint, and so are all numbers of Gaussians."""
    settings = {"strategy": strategy, "steps_per_move": 10, "steps_per_reset": 20, "max_num_iterations": 60}
    whole = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "whole", **settings)
    parts = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "parts", **settings)
    for trainer, steps in ((whole, 38), (parts, 15)):
        for _ in range(steps):
            trainer.train_step()
    resumed = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "resumed", **settings)
    resumed.restore(load_checkpoint(parts.save()))
    for _ in range(23):
        resumed.train_step()
    for first, second in zip(whole.model.parameters(), resumed.model.parameters(), strict=True):
        assert torch.equal(first, second)
    assert len(whole.model.gaussians()) != len(parts.model.gaussians())  # type: ignore[operator]
