"""Methods with a signed distance: how they start, what they learn of a ball, and its mesh."""

import dataclasses
import math
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.export.lattice import lattice_of
from nerfloom.export.meshing import Cleaning, distance_mesh
from nerfloom.fields.surface import NeuSField, SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.surfaces.opacity import surface_opacity
from nerfloom.method import Method
from nerfloom.registry import load_method
from nerfloom.renderable import parts
from nerfloom.rendering.background import SphereRenderer
from nerfloom.samplers.first_crossing import FirstCrossing
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.testing.ball import RADIUS
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.skipping import skip_report
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY, chosen, said_otherwise

METHODS = "neus", "volsdf"


def trainer_of(name: str, size: int = 24, **settings: object) -> Trainer:
    """A trainer on images of a ball, without a folder."""
    method: Method = load_method(name)
    known = {**TINY[name], "vis": "none", **settings}
    return Trainer(method, dataclasses.replace(method.config, **known), ball_in_a_box(size))


def places(count: int = 500) -> Tensor:
    torch.manual_seed(0)
    return torch.rand(count, 3) * 1.8 - 0.9


@pytest.mark.parametrize("name", METHODS)
def test_training_starts_as_a_ball(name: str) -> None:
    """Of half the box's size, up to the noise of the first weights; its gradient has length 1."""
    field = trainer_of(name).model.field
    assert isinstance(field, SurfaceField)
    shape = field.shape(places())
    truth = places().norm(dim=-1) - 0.5
    assert (shape.distances - truth).abs().max() < 0.01
    assert (shape.gradients.norm(dim=-1) - 1).abs().max() < 0.05
    assert bool(field.shape(torch.zeros(1, 3)).gradients.isfinite().all())


@pytest.mark.parametrize("opened", [16.0, 2.5])
def test_gradients_are_those_of_the_distance(opened: float) -> None:
    """Central differences, with all levels of the grid and with some of them open; in a box that is no cube."""
    scene = dataclasses.replace(ball_in_a_box().scene, box=torch.tensor([[-1.0, -1.5, -0.8], [1.0, 1.0, 1.2]]))
    method = load_method("neus")
    config = dataclasses.replace(method.config, **TINY["neus"], sparse_updates=False)
    config, _ = method.decided(config, scene)
    field = method.field(config, scene).double()  # type: ignore[misc]
    assert isinstance(field, SurfaceField)
    torch.nn.init.normal_(field.grid.table)
    assert field.grid.opening is not None
    field.grid.opening.opened.fill_(min(opened, 4.0))
    where, step = places(60).double(), 1e-6
    found = field.shape(where)
    for axis in range(3):
        by = torch.zeros(3, dtype=torch.float64)
        by[axis] = step
        difference = (field.shape(where + by).distances - field.shape(where - by).distances) / (2 * step)
        error = (difference - found.gradients[:, axis]).abs()
        assert error.quantile(0.9) < 1e-4  # a few steps cross a cell's face or switch a unit


def test_opacity_is_that_of_the_distance_and_its_slope() -> None:
    field = trainer_of("neus").model.field
    assert isinstance(field, NeuSField)
    field.anneal(1.0)
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


@pytest.mark.parametrize(("sharpness", "widths", "scale"), [(0.25, 2.0, 4.0), (0.25, 0.75, 3.0), (8.0, 2.0, 1.0)])
def test_steps_are_as_long_as_the_surface_is_wide(sharpness: float, widths: float, scale: float) -> None:
    """`sharpness` is in inverse steps; the length lies between one and four steps, and pictures keep theirs."""
    trainer = trainer_of("neus", step_widths=widths)
    (sampler,) = parts(trainer.model, OccupancySampler)
    field = trainer.model.field
    assert isinstance(field, SurfaceField)
    with torch.no_grad():
        field.sharpness.exponent.fill_(math.log(sharpness / sampler.step_size) / field.sharpness.SPEED)
    trainer.model.before_step(0, 0.0)
    assert trainer.model.step_scale.item() == pytest.approx(scale, abs=0.02)
    rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
    lengths = []
    for training in (True, False):
        samples = sampler.train(training).sample(rays, field, jitter=False)
        lengths.append(samples.deltas.median().item() / sampler.step_size)
    assert lengths == pytest.approx([scale, 1.0], rel=0.02)
    trainer.model.before_step(1, 0.0)  # the same until it is asked again, as after a checkpoint
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
    mesh = distance_mesh(model, lattice_of(model.scene.box, 48), trainer.train_set.cameras, Cleaning(num_components=1))
    assert mesh.normals is not None
    radii = mesh.vertices.norm(dim=-1)
    print(name, radii.mean(), radii.std(), len(mesh.faces))
    assert radii.mean().item() == pytest.approx(RADIUS, rel=0.05)
    assert radii.std() < 0.05 * RADIUS
    distances, _ = model.signed_distance(Points(mesh.vertices.float()))
    assert distances.abs().median() < 1e-5
    outward = (mesh.normals * mesh.vertices.float() / radii.float()[:, None]).sum(-1)
    assert outward.median() > 0.95


@pytest.mark.parametrize("name", METHODS)
def test_captures_get_a_background_on_a_sphere(name: str, shared_tiny: Path, tmp_path: Path) -> None:
    captured = partial(said_otherwise, name, shared_tiny)
    trainer = captured(tmp_path, {"unbounded": True, "has_alpha": False}, max_num_iterations=3)
    assert chosen(trainer)["background model"] == "sphere"
    assert isinstance(trainer.model.renderer, SphereRenderer)
    trainer.train()
    assert trainer.state.skipped == 0


def test_images_that_are_lit_differently_have_appearances(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = said_otherwise("neus", shared_tiny, tmp_path, {"appearance_varies": True}, max_num_iterations=3)
    assert chosen(trainer)["appearance features"] == "16"
    trainer.train()
    assert bool((trainer.model.appearance.vectors != 0).any())


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"background_model": "contraction"}, "is not contracted"), ({"sampler": "proposal"}, "--sampler occupancy")],
)
def test_what_surfaces_cannot_do_is_refused(settings: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        trainer_of("neus", **settings)
