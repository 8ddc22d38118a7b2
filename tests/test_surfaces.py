"""Methods with a signed distance: their start, training on a ball, and its mesh."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import PixelBatch, draw_batch
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.export.lattice import lattice_of
from nerfloom.export.meshing import level_set_mesh
from nerfloom.export.settings import MarchingCubesSettings
from nerfloom.fields.distance import GridDistance, Shape
from nerfloom.fields.surface import NeuSField, SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.surfaces.opacity import surface_opacity
from nerfloom.losses.surfaces import (
    ANYWHERE,
    BENT,
    EVERY,
    Curvature,
    DistanceBounds,
    Eikonal,
    Silhouette,
    SurfacePoints,
    beyond_bounds,
    mean_of,
    normal_change,
    tangents,
)
from nerfloom.losses.term import RenderedBatch
from nerfloom.method import Method
from nerfloom.registry import load_method
from nerfloom.renderable import parts
from nerfloom.rendering.background import SphereRenderer
from nerfloom.rendering.rendered import Rendered
from nerfloom.samplers.background import foreground_sphere
from nerfloom.samplers.cells import places as places_of
from nerfloom.samplers.evaluated_again import EvaluatedAgain
from nerfloom.samplers.first_crossing import FirstCrossing
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.testing import assert_method
from nerfloom.testing.ball import RADIUS
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.skipping import skip_report
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY, chosen, said_otherwise

METHODS = "neus", "volsdf"


def trainer_of(name: str, size: int = 24, **settings: object) -> Trainer:
    """A trainer on images of a ball, without a folder."""
    return trainer_on(ball_in_a_box(size), name, **settings)


def trainer_on(data: Dataset, name: str, **settings: object) -> Trainer:
    """A trainer on other images."""
    method: Method = load_method(name)
    known = {**TINY[name], "vis": "none", **settings}
    return Trainer(method, dataclasses.replace(method.config, **known), data)


def grid_of(field: SurfaceField) -> HashGrid:
    """The hash grid of a field that has one."""
    assert isinstance(field.distance, GridDistance)
    return field.distance.grid


def places(count: int = 500) -> Tensor:
    torch.manual_seed(0)
    return torch.rand(count, 3) * 1.8 - 0.9


@pytest.mark.parametrize("name", METHODS)
def test_training_starts_as_a_ball(name: str) -> None:
    """The ball has a quarter of the box's size, up to the noise of the first weights; its gradient has length 1."""
    field = trainer_of(name).model.field
    assert isinstance(field, SurfaceField)
    shape = field.shape(places())
    truth = places().norm(dim=-1) - 0.25
    assert (shape.distances - truth).abs().max() < 0.01
    assert (shape.gradients.norm(dim=-1) - 1).abs().max() < 0.05
    assert bool(field.shape(torch.zeros(1, 3)).gradients.isfinite().all())


@pytest.mark.parametrize("opened", [16.0, 2.5])
def test_gradients_are_those_of_the_distance(opened: float) -> None:
    """Central differences, with all levels of the grid and with some of them open; in a box that is not a cube."""
    scene = dataclasses.replace(ball_in_a_box().scene, box=torch.tensor([[-1.0, -1.5, -0.8], [1.0, 1.0, 1.2]]))
    method = load_method("neus")
    config = dataclasses.replace(method.config, **TINY["neus"], sparse_updates=False)
    config, _ = method.decided(config, scene)
    field = method.field(config, scene).double()  # type: ignore[misc]
    assert isinstance(field, SurfaceField)
    grid = grid_of(field)
    torch.nn.init.normal_(grid.table)
    assert grid.opening is not None
    grid.opening.opened.fill_(min(opened, 4.0))
    where, step = places(60).double(), 1e-6
    found = field.shape(where)
    for axis in range(3):
        by = torch.zeros(3, dtype=torch.float64)
        by[axis] = step
        difference = (field.shape(where + by).distances - field.shape(where - by).distances) / (2 * step)
        error = (difference - found.gradients[:, axis]).abs()
        assert error.quantile(0.9) < 1e-4  # a few steps cross a cell's face or switch a unit


@pytest.mark.parametrize("opened", [4.0, 2.5])
def test_distances_alone_are_those_with_gradients(opened: float) -> None:
    """All levels of the grid are open, or some of them; the papers' network has no form for compiled calls."""
    field = trainer_of("neus").model.field
    assert isinstance(field, SurfaceField)
    grid = grid_of(field)
    torch.nn.init.normal_(grid.table, std=0.05)
    assert grid.opening is not None
    grid.opening.opened.fill_(opened)
    with torch.no_grad():
        truth = field.shape(places()).distances
        torch.testing.assert_close(field.signed_distance(Points(places())), truth, atol=1e-5, rtol=0)
        known = field.distance.known()
        assert known is not None
        torch.testing.assert_close(known.with_gradients(places())[0], truth, atol=1e-5, rtol=0)
    large = trainer_of("neus", **TINY["neus+frequency"]).model.field
    assert isinstance(large, SurfaceField)
    assert large.distance.known() is None
    with torch.no_grad():
        torch.testing.assert_close(large.signed_distance(Points(places())), large.shape(places()).distances)


def test_pictures_have_the_mean_normals_of_rays() -> None:
    """Sums of weight times unit normal, of opacities and of densities."""
    for name in METHODS:
        trainer = trainer_of(name, start_radius=0.5)
        model, batch = trainer.model.eval(), draw_batch(trainer.train_set, 64, "white")
        with torch.no_grad():
            shown = model.render(batch.rays, batch.background)
        assert shown.samples is not None
        assert shown.samples.features is not None
        assert shown.weights is not None
        normals = torch.nn.functional.normalize(shown.samples.features[:, :3], dim=-1)
        truth = torch.zeros(64, 3).index_add(0, shown.samples.ray_indices, shown.weights[:, None] * normals)
        torch.testing.assert_close(shown.extras["normals"], truth, atol=1e-5, rtol=0)
        assert float(truth.norm(dim=-1).max()) > 0.5


def test_distance_and_features_follow_the_position() -> None:
    """Their gradients by positions that require one, against central differences."""
    method = load_method("neus")
    config, _ = method.decided(
        dataclasses.replace(method.config, **TINY["neus"], sparse_updates=False), ball_in_a_box().scene
    )
    field = method.field(config, ball_in_a_box().scene).double()  # type: ignore[misc]
    assert isinstance(field, SurfaceField)
    torch.nn.init.normal_(grid_of(field).table)
    where, step = places(60).double().requires_grad_(), 1e-6
    weights = torch.randn(60, 16, dtype=torch.float64)

    def seen(positions: Tensor) -> Tensor:
        shape = field.shape(positions)
        return (weights * torch.cat([shape.distances[:, None], shape.features], dim=-1)).sum(-1)

    (found,) = torch.autograd.grad(seen(where).sum(), where)
    for axis in range(3):
        by = torch.zeros(3, dtype=torch.float64)
        by[axis] = step
        difference = (seen(where + by) - seen(where - by)).detach() / (2 * step)
        error = (difference - found[:, axis]).abs() / difference.abs().clamp(min=1)
        assert error.quantile(0.9) < 1e-4  # a few steps cross a cell's face or switch a unit


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("neus", {}),
        ("volsdf", {}),
        ("volsdf", {"sampler": "error-bounded", "num_rays_per_batch": 128}),
        ("neus", TINY["neus+frequency"]),
    ],
)
def test_poses_are_refined(name: str, settings: dict[str, object]) -> None:
    trainer = trainer_of(name, **settings, camera_optimizer="SO3xR3")
    for _ in range(3):
        trainer.train_step()
    assert trainer.state.skipped == 0
    tangents = trainer.model.poses.tangents
    assert bool(tangents.isfinite().all())
    assert float((tangents != 0).any(-1).float().mean()) > 0.5


def test_samples_of_refined_rays_are_those_of_others() -> None:
    """The same samples and pictures; and each ray's colour has a gradient by where its camera stands."""
    trainer = trainer_of("neus", camera_optimizer="SE3", start_radius=0.7)
    model, background = trainer.model, torch.ones(3)
    assert isinstance(model.sampler, EvaluatedAgain)
    given = draw_batch(trainer.train_set, 64, "white").rays
    origins = given.origins.clone().requires_grad_()
    rays = dataclasses.replace(given, origins=origins)
    plain = model.sampler.sample(given, model.field, False)
    followed = model.sampler.sample(rays, model.field, False)
    assert plain.alpha is not None
    assert followed.alpha is None
    assert torch.equal(followed.t_starts, plain.t_starts)
    expected = model.renderer.render(given, plain, model.field, background)
    found = model.renderer.render(rays, followed, model.field, background)
    torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-4, rtol=0)
    found.rgb.square().sum().backward()
    assert origins.grad is not None
    assert bool(origins.grad.isfinite().all())
    hit = found.accumulation > 0.5
    assert int(hit.sum()) > 3
    assert bool((origins.grad[hit] != 0).any(-1).all())


def test_poses_of_a_device_are_refined_by_themselves(shared_tiny: Path, tmp_path: Path) -> None:
    for number, (poses, choice) in enumerate({"device": "SO3xR3", "exact": "off"}.items()):
        (tmp_path / str(number)).mkdir()
        trainer = said_otherwise("neus", shared_tiny, tmp_path / str(number), {"poses": poses})
        assert chosen(trainer)["pose refinement"] == choice
        assert (trainer.model.poses is None) == (choice == "off")


@pytest.mark.medium
@pytest.mark.parametrize("name", METHODS)
def test_the_papers_networks_pass_every_check(name: str) -> None:
    method = load_method(name)
    assert_method(method, name, dataclasses.replace(method.config, **TINY[f"{name}+frequency"]))


def test_opacity_is_that_of_the_distance_and_its_slope() -> None:
    field = trainer_of("neus").model.field
    assert isinstance(field, NeuSField)
    field.sharpness.anneal(1.0)
    where, lengths = places(), torch.full((500,), 0.02)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    opacity, _ = field.alpha(Points(where), directions, lengths)
    shape = field.shape(where)
    cosines = (shape.gradients * directions).sum(-1)
    torch.testing.assert_close(opacity, surface_opacity(shape.distances, cosines, lengths, field.sharpness()))
    assert float(field.sharpness()) == pytest.approx(20.0)


@pytest.mark.parametrize("name", METHODS)
def test_cells_that_hold_a_surface_are_occupied(name: str) -> None:
    """The bound is at least the density anywhere in a cell."""
    field = trainer_of(name).model.field
    assert isinstance(field, SurfaceField)
    around = field.density_around(Points(places()))[0]
    moved = places() + field.cell * torch.nn.functional.normalize(torch.randn(500, 3), dim=-1) * 0.99
    assert bool((field.density(Points(moved))[0] <= around * 1.1).all())


def test_the_report_says_what_tracing_saves() -> None:
    trainer = trainer_of("neus", max_num_iterations=5, eval_rendering="surface")
    for _ in trainer.steps():
        pass
    rungs = {rung.name: rung for rung in skip_report(trainer)}
    assert rungs["samples, traced"].switch == "--eval-rendering volume"
    assert 0 <= rungs["samples, traced"].skipped < 1
    assert "instead of" in rungs["samples, traced"].says
    assert all(tracer.traces for tracer in parts(trainer.model, FirstCrossing))


@pytest.mark.parametrize("name", METHODS)
def test_a_grid_of_one_cell_skips_nothing(name: str) -> None:
    """The flag that the report names for empty space switches it off: for ablations."""
    trainer = trainer_of(name, max_num_iterations=20, grid_resolution=1)
    for _ in trainer.steps():
        pass
    rungs = {rung.name: rung for rung in skip_report(trainer)}
    for kind in ("cells, empty", "steps along a ray, in empty cells"):
        assert rungs[kind].switch == "--grid-resolution 1"
        assert rungs[kind].skipped == 0
    assert "cells, outside the visual hull" not in rungs
    assert trainer.train_set.drawn is None or len(trainer.train_set.drawn) == len(trainer.train_set.pixels)


@pytest.mark.parametrize(("sharpness", "widths", "scale"), [(0.25, 2.0, 4.0), (0.25, 0.75, 3.0), (8.0, 2.0, 1.0)])
def test_steps_are_as_long_as_the_surface_is_wide(sharpness: float, widths: float, scale: float) -> None:
    """`sharpness` is in inverse steps; the length lies between one and four steps, and pictures keep theirs."""
    trainer = trainer_of("neus", step_widths=widths)
    (sampler,) = parts(trainer.model, OccupancySampler)
    field = trainer.model.field
    assert isinstance(field, SurfaceField)
    field.sharpness.first = sharpness / sampler.step_size  # the least value
    with torch.no_grad():
        field.sharpness.exponent.fill_(math.log(sharpness / sampler.step_size) / field.sharpness.SPEED)
    trainer.model.before_step(0, 1.0)
    assert trainer.model.step_scale.item() == pytest.approx(scale, abs=0.02)
    rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
    lengths = []
    for training in (True, False):
        samples = sampler.train(training).sample(rays, field, jitter=False)
        lengths.append(samples.deltas.median().item() / sampler.step_size)
    assert lengths == pytest.approx([scale, 1.0], rel=0.02)
    trainer.model.before_step(1, 1.0)  # the same until it is asked again, as after a checkpoint
    assert trainer.model.step_scale.item() == pytest.approx(scale, abs=0.02)


@pytest.mark.medium
@pytest.mark.parametrize("name", METHODS)
def test_a_ball_is_learnt_and_meshed(name: str) -> None:
    """Radius and normals of an exact ball after some hundred steps; vertices on the zero level set."""
    torch.manual_seed(0)
    trainer = trainer_of(name, 48, max_num_iterations=250, num_rays_per_batch=512, start_radius=0.8)
    for _ in trainer.steps():
        pass
    model = trainer.model.eval()
    settings = MarchingCubesSettings(num_components=1)
    mesh = level_set_mesh(model, lattice_of(model.scene.box, 48), trainer.train_set.cameras, settings)
    assert mesh.normals is not None
    radii = mesh.vertices.norm(dim=-1)
    print(name, radii.mean(), radii.std(), len(mesh.faces))
    assert radii.mean().item() == pytest.approx(RADIUS, rel=0.05)
    assert radii.std() < 0.05 * RADIUS
    distances, _ = model.signed_distance(Points(mesh.vertices.float()))
    assert distances.abs().median() < 1e-5
    outward = (mesh.normals * mesh.vertices.float() / radii.float()[:, None]).sum(-1)
    assert outward.median() > 0.95


def ring(positions: Tensor) -> Tensor:
    """A ring around the x axis, through which two of the cameras look."""
    across = positions[..., 1:].norm(dim=-1) - 0.55
    return (across.square() + positions[..., 0].square()).sqrt() - 0.2


def plate(positions: Tensor) -> Tensor:
    """A square plate 0.12 thick, with a round hole."""
    outside = positions.abs() - torch.tensor([0.06, 0.7, 0.7])
    square = outside.clamp(min=0).norm(dim=-1) + outside.amax(-1).clamp(max=0)
    return torch.maximum(square, 0.35 - positions[..., 1:].norm(dim=-1))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "shape"), [("neus", plate), ("volsdf", ring)])
def test_a_hole_is_learnt(name: str, shape: Callable[[Tensor], Tensor]) -> None:
    """The first ball lies in the hole, and no silhouette removes its cells: the colours of pixels do."""
    torch.manual_seed(0)
    data = ball_in_a_box(64)
    rays = data.cameras.pixel_rays(torch.arange(len(data.pixels)), 0.0, 6.0)
    t = torch.full((len(data.pixels), 1), 1.0)
    for _ in range(80):
        t = t + shape(rays.origins + t * rays.directions)[:, None].clamp(max=0.5)
    where = (rays.origins + t * rays.directions).requires_grad_()
    (normals,) = torch.autograd.grad(shape(where).sum(), where)
    met = (shape(where) < 1e-3)[:, None].float()
    colors = torch.cat([0.5 + 0.4 * torch.nn.functional.normalize(normals, dim=-1), met], dim=-1)
    shown = dataclasses.replace(data, pixels=(255 * colors.detach()).round().to(torch.uint8))
    finer = {"num_levels": 8, "max_resolution": 128, "log2_table_size": 14, "grid_resolution": 32, "num_steps": 128}
    settings = {"max_num_iterations": 400, "samples_per_batch": 8192, "silhouette_cells": False, **finer}
    trainer = trainer_on(shown, name, **settings)
    for _ in trainer.steps():
        pass
    model = trainer.model.eval()
    settings = MarchingCubesSettings(num_components=1)
    mesh = level_set_mesh(model, lattice_of(model.scene.box, 64), data.cameras, settings)
    errors = shape(mesh.vertices.float()).abs()
    angle = torch.arange(64) * (2 * math.pi / 64)
    circle = torch.stack([0 * angle, angle.cos(), angle.sin()], dim=-1)
    inside, hole = (model.signed_distance(Points(radius * circle))[0] for radius in (0.55, 0.15))
    print(name, shape.__name__, float(errors.mean()), float(errors.max()), float(inside.max()), float(hole.min()))
    assert errors.mean() < 0.025
    assert bool((inside < 0).all())
    assert bool((hole > 0.02).all())


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("level", [0, 255])
def test_plain_pictures_have_nothing_to_learn_from_and_break_nothing(level: int, name: str) -> None:
    """All pixels are black, or white, and opaque: distances, pictures and all parameters stay finite."""
    data = ball_in_a_box()
    plain = torch.full_like(data.pixels, level)
    plain[:, 3] = 255
    trainer = trainer_on(dataclasses.replace(data, pixels=plain), name, max_num_iterations=40)
    for _ in trainer.steps():
        pass
    assert trainer.state.skipped == 0
    assert all(bool(each.isfinite().all()) for each in trainer.model.parameters())
    distances, gradients = trainer.model.eval().signed_distance(Points(places()))
    assert bool(distances.isfinite().all())
    assert bool(gradients.isfinite().all())
    batch = draw_batch(trainer.train_set, 200, "black")
    with torch.no_grad():
        shown = trainer.model.render(batch.rays, batch.background)
    through = shown.rgb[shown.accumulation > 0.99]
    assert len(through) > 20
    assert (through - level / 255).abs().mean() < 0.1


@pytest.mark.parametrize("name", METHODS)
def test_captures_get_a_background_on_a_sphere(name: str, shared_tiny: Path, tmp_path: Path) -> None:
    captured = partial(said_otherwise, name, shared_tiny)
    trainer = captured(tmp_path, {"unbounded": True, "has_alpha": False}, max_num_iterations=3)
    assert chosen(trainer)["background model"] == "sphere"
    assert isinstance(trainer.model.renderer, SphereRenderer)
    assert chosen(trainer)["radius of the first ball"] == "0.5"
    trainer.train()
    assert trainer.state.skipped == 0


def test_distances_of_captures_are_known_inside_the_sphere(shared_tiny: Path, tmp_path: Path) -> None:
    """Outside, the background shows the scene; meshes cover the sphere's cube, and the first ball is inside."""
    trainer = said_otherwise(
        "neus", shared_tiny, tmp_path, {"unbounded": True, "has_alpha": False}, max_num_iterations=3
    )
    model = trainer.model
    sphere = foreground_sphere(model.config, trainer.train_set.scene)
    directions = torch.nn.functional.normalize(torch.randn(100, 3), dim=-1)
    for share, known in ((0.99, True), (1.01, False)):
        distances, gradients = model.signed_distance(Points(sphere[:3] + share * sphere[3] * directions))
        assert bool((distances.isfinite() == known).all())
        assert bool(gradients.isfinite().all())
    assert float(model.signed_distance(Points(sphere[None, :3]))[0]) < 0
    low, high = model.scene.box
    torch.testing.assert_close((low + high) / 2, sphere[:3])
    torch.testing.assert_close((high - low) / 2, sphere[3].expand(3))


@pytest.mark.parametrize("seen", [True, False])
def test_a_floor_of_a_capture_belongs_to_the_first_shape(seen: bool, shared_tiny: Path, tmp_path: Path) -> None:
    """Points of a reconstruction lie on a plane below the cameras, or nowhere in particular."""
    trainer = said_otherwise(
        "neus", shared_tiny, tmp_path, {"unbounded": True, "has_alpha": False}, max_num_iterations=3
    )
    sphere = foreground_sphere(trainer.model.config, trainer.train_set.scene)
    height = min(float(trainer.train_set.cameras.camera_to_worlds[:, 2, 3].min()), float(sphere[2])) - sphere[3] / 2
    points = sphere[:3] + sphere[3] * (torch.rand(2000, 3) - 0.5)
    if seen:
        points[:400, 2] = height
        points[400:, 2] += height + 0.6 * sphere[3] - sphere[2]  # all above
    trainer.model.start(dataclasses.replace(trainer.train_set, points=points))
    below = torch.cat([sphere[:2], torch.as_tensor(height)[None] - 0.1 * sphere[3]])
    aside = below + torch.tensor([0.7, 0.0, 0.0]) * sphere[3]
    shape = trainer.model.field.shape(torch.stack([below, aside]))
    if seen:
        torch.testing.assert_close(shape.distances, -0.1 * sphere[3].expand(2), atol=0.02 * float(sphere[3]), rtol=0)
        torch.testing.assert_close(shape.gradients[:, 2], torch.ones(2), atol=0.1, rtol=0)
    else:
        assert bool((shape.distances > 0).all())


def test_the_inverse_width_stays_between_bounds() -> None:
    """It cannot leave its first value at first; halfway to the end of the bound it may be some 7 times as large."""
    trainer = trainer_of("neus", sharpen_until=0.8)
    sharpness = trainer.model.field.sharpness
    for progress, upper in ((0.0, 20.0), (0.4, 20 * 50**0.5), (0.9, 1e4)):
        for value in (1e4, 1.0):
            with torch.no_grad():
                sharpness.exponent.fill_(math.log(value) / 10)
            trainer.model.before_step(1, progress)
            assert float(sharpness()) == pytest.approx(min(max(value, 20.0), upper), rel=1e-3)


def test_images_that_are_lit_differently_have_appearances(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = said_otherwise("neus", shared_tiny, tmp_path, {"appearance_varies": True}, max_num_iterations=3)
    assert chosen(trainer)["appearance"] == "vector"
    trainer.train()
    assert bool((trainer.model.appearance.vectors != 0).any())


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"background_model": "contraction"}, "is not contracted"), ({"sampler": "proposal"}, "take --sampler occupancy")],
)
def test_what_surfaces_cannot_do_is_refused(settings: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        trainer_of("neus", **settings)


def test_normals_of_a_ball_change_with_its_curvature() -> None:
    """One step e along the tangent plane of a ball of radius r turns the normal by atan(e / r)."""
    torch.manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    along = tangents(normals)
    assert (along * normals).sum(-1).abs().max() < 1e-6
    assert (along.norm(dim=-1) - 1).abs().max() < 1e-6
    for radius, step in ((0.5, 0.1), (2.0, 0.1)):
        moved = torch.nn.functional.normalize(radius * normals + step * along, dim=-1)
        truth = (2 - 2 / (1 + (step / radius) ** 2) ** 0.5) ** 0.5
        torch.testing.assert_close(normal_change(normals, moved), torch.full((200,), truth), rtol=1e-3, atol=0)


def exact_ball() -> tuple[Trainer, SurfaceField]:
    """A trainer with a ball of radius 0.5 without noise as field."""
    trainer = trainer_of("neus", start_radius=0.5)
    field = trainer.model.field
    assert isinstance(field, SurfaceField)
    with torch.no_grad():
        field.distance.second[0] = 0
    return trainer, field


def shown_by(trainer: Trainer, batch: PixelBatch) -> RenderedBatch:
    return RenderedBatch(batch, trainer.model.render(batch.rays, batch.background), trainer.model, 0)


def test_the_curvature_term_is_that_of_level_sets() -> None:
    """The truth is the mean over the samples of the term, for a field that is a ball."""
    trainer, field = exact_ball()
    shown = shown_by(trainer, draw_batch(trainer.train_set, 64, "white"))
    samples = shown.rendered.samples
    assert samples is not None
    radii = samples.positions(shown.batch.rays).norm(dim=-1)
    truth = (2 - 2 / (1 + (samples.deltas / radii).square()).sqrt()).sqrt()
    found = Curvature()(shown)
    field.progress = 0.5
    assert Curvature()(shown) is None  # details come last
    assert found is not None
    nearest = min(abs(float(truth[first::BENT].mean()) / float(found) - 1) for first in range(BENT))
    assert nearest < 0.02
    found.backward()
    assert float(field.distance.second.grad.abs().max()) > 0  # type: ignore[union-attr]


def test_the_eikonal_term_counts_samples_and_all_that_silhouettes_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients of length 2 at samples and of length 1 elsewhere: the mean is the share of the samples."""
    torch.manual_seed(0)
    trainer, field = exact_ball()
    grid = parts(trainer.model, OccupancySampler)[0]
    hull = torch.ones(len(grid.carved), dtype=torch.bool)
    hull[: len(hull) // 4] = False  # z is the last axis, so the first quarter along x
    grid.carve(hull)
    shown = shown_by(trainer, draw_batch(trainer.train_set, 64, "white"))
    samples = shown.rendered.samples
    assert samples is not None
    assert samples.features is not None
    unit = torch.nn.functional.normalize(samples.features[:, :3], dim=-1)
    longer = dataclasses.replace(samples, features=torch.cat([2 * unit, samples.features[:, 3:]], dim=-1))
    asked, shape = list[Tensor](), field.shape

    def recorded(where: Tensor) -> Shape:
        asked.append(where)
        return shape(where)

    monkeypatch.setattr(field, "shape", recorded)
    found = Eikonal()(dataclasses.replace(shown, rendered=dataclasses.replace(shown.rendered, samples=longer)))
    at_samples, elsewhere = len(samples) / EVERY, len(samples) // ANYWHERE
    assert elsewhere > 50
    assert [len(where) for where in asked] == [elsewhere]
    assert found is not None
    assert found.item() == pytest.approx(at_samples / (at_samples + elsewhere), rel=0.01)
    cells = grid.occupancy.cells(asked[0])
    assert not grid.carved[cells].any()
    left = places_of((~grid.carved).nonzero()[:, 0], grid.resolution)[:, 1:] / grid.resolution
    low, high = field.box
    middle = torch.lerp(low, high, left.mean(0) + 0.5 / grid.resolution)
    torch.testing.assert_close(asked[0].mean(0), middle, atol=0.1, rtol=0)  # everywhere else


def test_slots_without_a_sample_do_not_count() -> None:
    values = torch.tensor([1.0, 5.0, torch.nan], requires_grad=True)
    mean = mean_of(values, torch.tensor([True, True, False]))
    assert mean.item() == 3
    mean.backward()
    assert values.grad is not None
    assert values.grad.tolist() == [0.5, 0.5, 0]
    assert mean_of(values, torch.zeros(3, dtype=torch.bool)).item() == 0


def test_a_single_sample_has_a_curvature() -> None:
    """Whichever of the samples the term begins with."""
    trainer, _ = exact_ball()
    batch, at = points_on_axes(0.5)[torch.tensor([0])], torch.tensor([1.5])
    _, features = trainer.model.field.density(Points(batch.rays.points(torch.tensor([0]), at)))
    samples = Samples(at - 0.01, at + 0.01, torch.tensor([0, 1]), features=features)
    nothing = torch.zeros(1)
    shown = RenderedBatch(
        batch, Rendered(torch.zeros(1, 3), nothing, nothing, nothing, 1, samples=samples), trainer.model, 0
    )
    truth = (2 - 2 / (1 + (0.02 / 0.5) ** 2) ** 0.5) ** 0.5
    for _ in range(20):
        assert float(Curvature()(shown)) == pytest.approx(truth, rel=0.01)  # type: ignore[arg-type]


def test_silhouettes_are_weighted_as_the_pixels_are() -> None:
    torch.manual_seed(0)
    trainer, _ = exact_ball()
    batch, weights = draw_batch(trainer.train_set, 64, "white"), torch.rand(64)
    assert batch.alpha is not None
    shown = shown_by(trainer, dataclasses.replace(batch, weights=weights))
    wrong = (shown.pixels.accumulation - batch.alpha).tolist()
    truth = sum(weight * each**2 for weight, each in zip(weights.tolist(), wrong, strict=True)) / 64
    assert float(Silhouette()(shown)) == pytest.approx(truth, rel=1e-4)  # type: ignore[arg-type]


def points_on_axes(radius: float) -> PixelBatch:
    """Pixels of six cameras on the axes; each shows a point at `radius` before the centre."""
    towards = torch.cat([torch.eye(3), -torch.eye(3)])
    known, colors = torch.full((6,), 2 - radius), torch.ones(6, 3)
    rays = Rays(-2 * towards, towards)
    return PixelBatch(torch.arange(6), rays, colors, colors, None, known, torch.zeros(6))


def test_points_of_a_reconstruction_pull_the_surface() -> None:
    """Terms of a ball of radius 0.5: 0 for points on it, and computed by hand for others."""
    trainer, field = exact_ball()
    with torch.no_grad():
        right = shown_by(trainer, points_on_axes(0.5))
        assert float(SurfacePoints()(right)) < 1e-3  # type: ignore[arg-type]
        assert float(DistanceBounds()(right)) < 1e-3  # type: ignore[arg-type]
        wrong = shown_by(trainer, points_on_axes(0.3))
        assert float(SurfacePoints()(wrong)) == pytest.approx(0.2 / field.size, rel=0.01)  # type: ignore[arg-type]
        assert float(DistanceBounds()(wrong)) > 0.05  # type: ignore[arg-type]
        sure = dataclasses.replace(wrong.batch, deviations=torch.full((6,), 0.25))
        assert float(SurfacePoints()(shown_by(trainer, sure))) == 0  # type: ignore[arg-type]
        outside = shown_by(trainer, points_on_axes(-3.0))
        assert SurfacePoints()(outside) is None


def test_a_distance_before_a_point_has_bounds() -> None:
    left, deviations = torch.tensor([0.5, 0.5, 0.5, -0.1, -0.1, -0.1]), torch.full((6,), 0.01)
    found = beyond_bounds(torch.tensor([0.4, 0.6, -0.2, -0.05, 0.2, -0.3]), left, deviations)
    torch.testing.assert_close(found, torch.tensor([0.0, 0.09, 0.19, 0.0, 0.19, 0.19]))


@pytest.mark.parametrize(("pixels", "cells", "entries"), [(400, 512, 17), (513, 1024, 19), (800, 1024, 19)])
def test_tables_hold_the_cells_that_a_surface_meets(pixels: int, cells: int, entries: int) -> None:
    method, scene = load_method("neus"), dataclasses.replace(ball_in_a_box().scene, image_size=pixels)
    config, _ = method.decided(method.config, scene)
    assert (config.max_resolution, config.log2_table_size) == (cells, entries)  # type: ignore[attr-defined]
    asked = dataclasses.replace(method.config, log2_table_size=15)  # type: ignore[call-arg]
    assert method.decided(asked, scene)[0].log2_table_size == 15  # type: ignore[attr-defined]
