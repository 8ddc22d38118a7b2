"""KiloNeRF: its decisions, learning from a teacher at points, and the teacher afterwards."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.poses import Placement
from nerfloom.data.scene import Scene
from nerfloom.data.sources import Request, make_source
from nerfloom.fields.network_grid import NetworkGrid
from nerfloom.geometry.points import Points
from nerfloom.kernels.networks.grouped import layers_of
from nerfloom.methods.kilo_nerf import METHOD, KiloNeRF
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training import distillation
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.distillation import MatterPoints, SeenPoints, distil, length_in, point_errors, random_directions
from nerfloom.training.teacher import Teacher
from tests.other_device import OTHER, other_device
from tests.training.helpers import TINY, tiny_trainer
from tests.training.taught import BOX, SHARP, THICK, marble

SCENE = Scene(BOX, 1.0, 5.0, num_cameras=8, has_alpha=True, moving=False, image_size=24)
IDENTITY = Placement.of(None, 1.0)
SMALL: dict[str, Any] = {**TINY["kilo-nerf"], "vis": "none", "machine": MachineConfig(device_type="cpu")}


def pupil(**settings: Any) -> KiloNeRF:
    torch.manual_seed(0)
    model = METHOD.build(replace(METHOD.config, **{**SMALL, **settings}), SCENE)
    assert isinstance(model, KiloNeRF)
    return model


def test_the_grid_follows_the_box() -> None:
    config, made = METHOD.decided(METHOD.config, SCENE)
    assert config.sampler == "occupancy"
    assert [decision.option for decision in made] == ["sampler", "samples a step", "frequencies of positions"]
    flat = replace(SCENE, box=torch.tensor([[-1.0, -1.0, -0.25], [1.0, 1.0, 0.25]]))
    field = METHOD.build(METHOD.config, flat).field
    assert isinstance(field, NetworkGrid)
    assert field.cells == (8, 8, 2)
    assert METHOD.build(replace(METHOD.config, network_resolution=2), replace(SCENE, unbounded=True)).field.unbounded


@pytest.mark.parametrize(
    ("pixels", "cells", "count"), [(400, 8, 7), (400, 16, 6), (800, 16, 7), (9, 64, 1), (9999, 1, 10)]
)
def test_waves_are_two_pixels_long_or_longer(pixels: int, cells: int, count: int) -> None:
    config = replace(METHOD.config, network_resolution=cells)
    decided, _ = METHOD.decided(config, replace(SCENE, image_size=pixels))
    assert decided.position_frequencies == count  # type: ignore[attr-defined]
    shortest = 2 * math.pi / 2 ** (count - 1) * pixels / cells / 2  # pixels
    assert shortest >= 2 or count == 1
    assert shortest < 4 or count == 10


def test_what_knows_the_direction_is_kept_small() -> None:
    """All networks are small: at first the whole box is occupied, and a model of one network uses it."""
    model = pupil(view_dependence_mult=0.5, network_resolution=1)
    batch = make_source("pixels", ball_in_a_box(), model.config).draw(Request(0, 64))
    loss = model.train().loss(batch, 0)
    head = model.field.color_head
    parts = [part.detach().double() for part in itertools.chain(*layers_of(head.table, head.widths))]
    lengths = [float(part.square().sum().sqrt()) for part in parts]
    assert float(loss.terms["view_dependence"]) == pytest.approx(0.5 * sum(lengths), rel=1e-4)
    assert "view_dependence" not in pupil(view_dependence_mult=0.0).train().loss(batch, 0).terms


# -- points ---------------------------------------------------------------------------------------------------------


def test_errors_of_points() -> None:
    density, rgb = torch.tensor([0.0, 5.0, 1e9]), torch.rand(3, 3)
    assert point_errors(density, rgb, density, rgb, 0.1) == (0, 0)
    black, white = torch.zeros(3, 3), torch.ones(3, 3)
    opacity, color = point_errors(torch.zeros(3), black, density, white, 0.1)
    half = 1 - math.exp(-0.5)
    assert float(opacity) == pytest.approx((half**2 + 1) / 3)
    assert float(color) == pytest.approx((0.01 + half + 1) / 3)


def test_directions_are_spread_evenly() -> None:
    directions = random_directions(20_000, BOX)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(20_000))
    assert float(directions.mean(0).abs().max()) < 0.02
    assert float((directions.square().mean(0) - 1 / 3).abs().max()) < 0.02


def test_points_are_where_the_matter_is() -> None:
    """The marble's opacity is above a hundredth within 0.47 of its centre, in cells of 1/16."""
    torch.manual_seed(0)
    length = 2 * 3**0.5 * distillation.LENGTH_SHARE
    points = MatterPoints(Teacher(marble(), IDENTITY, IDENTITY), BOX, length).draw(20_000)
    assert bool(((points >= -1) & (points <= 1)).all())
    near = 4 / 3 * math.pi * 0.6**3 / 8
    expected = distillation.MATTER_SHARE + (1 - distillation.MATTER_SHARE) * near
    assert float((points.norm(dim=-1) < 0.6).float().mean()) == pytest.approx(expected, abs=0.02)


def test_without_matter_points_are_anywhere() -> None:
    torch.manual_seed(0)
    nothing = marble()
    nothing.field.thickness.data.zero_()
    points = MatterPoints(Teacher(nothing, IDENTITY, IDENTITY), BOX, 0.03).draw(20_000)
    assert float(points.mean(0).abs().max()) < 0.03
    assert float((points.square().mean(0) - 1 / 3).abs().max()) < 0.02


def test_points_are_where_photographs_look() -> None:
    """A ray through the marble has half of its light left at a distance that the closed form knows."""
    torch.manual_seed(0)
    dataset, length = ball_in_a_box(), length_in(BOX)
    seen = SeenPoints(Teacher(marble(), IDENTITY, IDENTITY), dataset, BOX)
    origins, directions, ends = (each[seen.surfaces].double() for each in (seen.origins, seen.directions, seen.ends))
    # The density is Gaussian along a ray: the error function integrates it.
    nearest = -(origins * directions).sum(-1)
    away = (origins + nearest[:, None] * directions).square().sum(-1)
    depth = THICK * torch.exp(-SHARP * away) * math.sqrt(math.pi / SHARP) / 2
    passed = depth * (1 + torch.erf(math.sqrt(SHARP) * (ends - nearest)))
    assert float((torch.exp(-passed) - 0.5).abs().mean()) < 0.1  # the teacher has 64 samples on a ray
    positions, ahead = seen.draw(20_000, length)
    torch.testing.assert_close(ahead.norm(dim=-1), torch.ones(20_000))
    assert bool((positions.abs() < 1 + 2 * length).all())
    # No point is far behind the surface that its ray meets first.
    marble_ahead = -(positions * ahead).sum(-1)
    assert float((marble_ahead > -length).float().mean()) > 0.7
    from_camera = positions - dataset.cameras.camera_to_worlds[:, None, :, 3]
    cosines = torch.nn.functional.cosine_similarity(from_camera, ahead.expand_as(from_camera), dim=-1)
    assert float(cosines.amax(0).min()) > 1 - 1e-5
    toward = seen.toward(positions)
    cosines = torch.nn.functional.cosine_similarity(from_camera, toward.expand_as(from_camera), dim=-1)
    assert float(cosines.amax(0).min()) > 1 - 1e-5


def test_networks_share_the_box_of_the_matter() -> None:
    """The marble's opacity over the length is above a hundredth within 0.45 of its centre."""
    torch.manual_seed(0)
    model = pupil(distill_steps=1)
    model.take_teacher(Teacher(marble(), IDENTITY, IDENTITY))
    model.start(ball_in_a_box())
    edge = 2 / distillation.CELLS
    box = model.field.box
    assert bool((box[1] >= 0.45).all())
    assert bool((box[0] <= -0.45).all())
    assert float(box.abs().max()) <= 0.47 + 2 * edge
    model.eval()
    _, places = model.field.located(box)
    torch.testing.assert_close(places, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    rays = ball_in_a_box().cameras.pixel_rays(torch.arange(500), 0.0, 9.0)
    samples = model.sampler.sample(rays, model.field, jitter=False)
    positions = rays.origins[samples.ray_indices] + samples.t[:, None] * rays.directions[samples.ray_indices]
    assert len(positions)
    cell = 2 / model.config.grid_resolution
    assert bool(((positions > box[0] - cell) & (positions < box[1] + cell)).all())


@pytest.mark.medium
def test_a_pupil_learns_the_teachers_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pupil has another frame than the teacher, and is compared with the closed form."""
    monkeypatch.setattr(distillation, "POINTS", 2048)
    model, own = pupil(), Placement.of(torch.tensor([[0.0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0]]), 1.25)
    teacher, dataset = Teacher(marble(), own, IDENTITY), ball_in_a_box()
    seen = SeenPoints(teacher, dataset, BOX)
    assert len(seen.surfaces)
    positions, directions = seen.draw(4000, length_in(BOX))
    true = teacher.at_points(positions, directions, 0.03)

    def errors() -> float:
        with torch.no_grad():
            density, features = model.field.density(Points(positions))
            found = point_errors(density, model.field.color(features, directions), *true, 0.03)
        return float(sum(found))

    before = errors()
    distil(model, teacher, dataset, BOX, 200, math.inf)
    print(f"errors at points {before:.4f} -> {errors():.4f}")
    assert errors() < before / 3


def test_learning_at_points_ends_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distillation, "POINTS", 64)
    monkeypatch.setattr(distillation, "CELLS", 8)
    model = pupil()
    before = [parameter.detach().clone() for parameter in model.field.parameters()]
    distil(model, Teacher(marble(), IDENTITY, IDENTITY), ball_in_a_box(), BOX, 10**6, 0.0)
    moved = [not torch.equal(a, b) for a, b in zip(before, model.field.parameters(), strict=True)]
    assert all(moved)


@pytest.mark.medium
def test_a_field_is_learnt_on_another_device_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The box of a scene is on the CPU, wherever its model is."""
    monkeypatch.setattr(distillation, "POINTS", 64)
    monkeypatch.setattr(distillation, "CELLS", 4)
    with other_device():
        model = pupil().to(OTHER)
        before = [parameter.detach().clone() for parameter in model.field.parameters()]
        distil(
            model,
            Teacher(marble().to(OTHER), IDENTITY, IDENTITY),
            ball_in_a_box().to(OTHER),
            BOX.to(OTHER),
            2,
            math.inf,
        )
        moved = [bool((a != b).any()) for a, b in zip(before, model.field.parameters(), strict=True)]
    assert all(moved)


# -- a run ----------------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_run_is_distilled_once(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distillation, "POINTS", 512)
    tiny_trainer("instant-ngp", shared_tiny, tmp_path / "teacher", max_num_iterations=30).train()
    settings: dict[str, Any] = {"teacher": tmp_path / "teacher", "distill_steps": 5, "max_num_iterations": 4}
    plain = tiny_trainer("kilo-nerf", shared_tiny, tmp_path / "plain", max_num_iterations=4)
    plain.prepare()
    trainer = tiny_trainer("kilo-nerf", shared_tiny, tmp_path / "pupil", **settings)
    model = trainer.model
    assert isinstance(model, KiloNeRF)
    assert model.teacher is not None
    assert all("teacher" not in name for name in model.state_dict())
    trainer.prepare()
    pairs = zip(model.field.parameters(), plain.model.field.parameters(), strict=True)
    assert not any(torch.equal(one, other) for one, other in pairs)
    trainer.train_step()
    assert model.teacher is None
    checkpoint = trainer.save()
    assert checkpoint is not None
    trainer.train()
    assert (trainer.state.step, trainer.state.skipped) == (4, 0)

    resumed = tiny_trainer("kilo-nerf", shared_tiny, tmp_path / "resumed", **settings)
    resumed.restore(load_checkpoint(checkpoint))
    monkeypatch.setattr("nerfloom.methods.kilo_nerf.distil", lambda *_: pytest.fail("distilled again"))
    resumed.train()
    assert isinstance(resumed.model, KiloNeRF)
    assert resumed.model.teacher is None
    for one, other in zip(resumed.model.parameters(), model.parameters(), strict=True):
        assert torch.equal(one, other)
