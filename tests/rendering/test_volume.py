"""The volume renderer: its calls of a field, without repetition, and equal pictures of density and opacity."""

from dataclasses import replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Footprint, Points
from nerfloom.geometry.rays import Rays
from nerfloom.ray_model import RayModel
from nerfloom.registry import load_method, registered
from nerfloom.rendering.background import SphereRenderer
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.samplers.uniform import UniformSampler
from tests.training.helpers import TINY

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
CAPTURE = Scene(0.5 * BOX, 0.05, 100.0, num_cameras=3, has_alpha=False, moving=False, image_size=32)
BUILT_IN = [name for name, entry in registered("methods").items() if entry.module.startswith("nerfloom.methods.")]
RAY_METHODS = [name for name in BUILT_IN if name not in ("gaussian-splatting", "moving-gaussians", "voxels")]


class Cloud(Field):
    """Smooth density around the origin, coloured by position; it records its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.thickness = torch.nn.Parameter(torch.tensor(8.0))
        self.asked: list[Points] = []
        self.cameras: Tensor | None = None
        self.directions: Tensor | None = None

    def sigma(self, positions: Tensor) -> Tensor:
        return self.thickness * torch.exp(-4 * positions.square().sum(-1))

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.asked.append(points)
        return self.sigma(points.positions), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        self.cameras, self.directions = camera_indices, directions
        return 0.5 + 0.25 * features + 0.25 * directions


class Opaque(Cloud):
    """The same as opacities of intervals; its density, which a grid is filled by, is twice as large."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        sigma, features = super().density(points)
        return 2 * sigma, features

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(len(points)))
        self.asked.append(points)
        return -torch.expm1(-self.sigma(points.positions) * deltas), points.positions


class Sized(Cloud):
    footprint: ClassVar[Footprint] = "gaussian"


def some_rays(count: int, near: float = 1.5, far: float = 4.5) -> Rays:
    generator = torch.Generator().manual_seed(0)
    origins = 3 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    towards = torch.rand(count, 3, generator=generator) - 0.5 - origins
    directions = torch.nn.functional.normalize(towards, dim=-1)
    ends = torch.full((count,), near), torch.full((count,), far)
    return Rays(origins, directions, *ends, torch.full((count,), 1e-2), camera_indices=torch.arange(count) % 3)


def shown(field: Field, sampler: Sampler, rays: Rays) -> Rendered:
    background = torch.tensor([0.1, 0.2, 0.3])
    return VolumeRenderer().render(rays, sampler.sample(rays, field, False), field, background)


SAMPLERS = {
    "uniform": UniformSampler(48),
    "occupancy": OccupancySampler(BOX, 8, 64, early_stop=0.0, train_early_stop=0.0),
    "early stop": OccupancySampler(BOX, 8, 64, early_stop=0.2, train_early_stop=0.2),
}


@pytest.mark.parametrize("name", SAMPLERS)
def test_opacity_is_shown_like_the_density_that_it_is_of(name: str) -> None:
    """Colours, depths, where rays end and the gradient; the density that is twice as large is not looked at."""
    rays, found = some_rays(50), []
    for field in (Cloud(), Opaque()):
        rendered = shown(field, SAMPLERS[name], rays)
        assert len(field.asked) == len({id(points) for points in field.asked})
        assert sum(map(len, field.asked)) >= rendered.num_samples
        rendered.rgb.sum().backward()
        assert field.thickness.grad is not None
        found.append((rendered, field.thickness.grad, sum(map(len, field.asked))))
    (by_density, slope, asked), (by_alpha, other_slope, also_asked) = found
    assert asked == also_asked  # nothing twice, and the same waves
    for value in ("rgb", "depth", "accumulation", "weights"):
        torch.testing.assert_close(getattr(by_alpha, value), getattr(by_density, value), rtol=1e-4, atol=1e-5)
    assert torch.equal(by_alpha.median_depth, by_density.median_depth)
    assert by_alpha.error_bound == by_density.error_bound == (0.2 if name == "early stop" else 0.0)
    torch.testing.assert_close(other_slope, slope, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("kind", [Cloud, Opaque])
def test_rays_that_meet_nothing_show_the_background(kind: type[Cloud], name: str) -> None:
    for rays in (some_rays(4, near=9.0, far=9.0), some_rays(0)):
        rendered = shown(kind(), SAMPLERS[name], rays)
        torch.testing.assert_close(rendered.rgb, torch.tensor([0.1, 0.2, 0.3]).expand(len(rays), 3))
        torch.testing.assert_close(rendered.depth, rays.fars)


def test_what_a_sampler_has_evaluated_is_not_evaluated_again() -> None:
    field, rays = Cloud(), some_rays(20)
    samples = SAMPLERS["occupancy"].sample(rays, field, False)
    asked = len(field.asked)
    VolumeRenderer().render(rays, samples, field, torch.ones(3))
    assert len(field.asked) == asked > 0


def test_opacity_is_asked_once_around_the_points_of_the_samples() -> None:
    field, rays = Opaque(), some_rays(5)
    sampler = UniformSampler(16)
    shown(field, sampler, rays)
    (points,) = field.asked
    torch.testing.assert_close(points.positions, sampler.sample(rays, field, False).positions(rays))


@pytest.mark.parametrize("sampler", [UniformSampler(16), ProposalSampler(BOX, (8, 8, 4), log2_table_size=8)])
def test_a_field_that_asks_for_sizes_is_given_them(sampler: Sampler) -> None:
    field, rays = Sized(), some_rays(5)
    rendered = shown(field, sampler.eval(), rays)
    (points,) = field.asked
    assert points.covariances is not None
    assert points.covariances.shape == (rendered.num_samples, 3)
    assert bool((points.covariances >= 0).all())


def test_each_sample_has_the_camera_of_its_ray_and_is_seen_along_it() -> None:
    field, rays = Cloud(), some_rays(4)
    shown(field, UniformSampler(2), rays)
    assert field.cameras is not None
    assert field.cameras.tolist() == [0, 0, 1, 1, 2, 2, 0, 0]
    assert field.directions is not None
    assert torch.equal(field.directions, rays.directions.repeat_interleave(2, 0))


class Listed(Cloud):
    """Density and colour of each sample are parameters of their own."""

    def __init__(self, count: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.sigmas = torch.nn.Parameter(torch.rand(count, generator=generator, dtype=torch.float64))
        self.rgbs = torch.nn.Parameter(torch.rand(count, 3, generator=generator, dtype=torch.float64))

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.sigmas, self.rgbs

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


def test_gradients_are_scaled_near_cameras_in_training_and_values_are_not() -> None:
    """The factor is the squared distance in units of `unit_length`, and 1 beyond it."""
    rays = some_rays(5, near=0.0, far=4.0)
    samples = UniformSampler(8).sample(rays, Cloud(), False)
    outcome = {}
    for unit, training in ((None, True), (2.5, True), (2.5, False)):
        field, renderer = Listed(len(samples)), VolumeRenderer(unit).train(training)
        rgb = renderer.render(rays, samples, field, torch.ones(3)).rgb
        outcome[unit, training] = rgb, *torch.autograd.grad((rgb**2).sum(), (field.sigmas, field.rgbs))
    plain, scaled, shown = outcome.values()
    factors = (samples.t / 2.5).clamp(max=1) ** 2
    assert 0 < int((factors < 1).sum()) < len(factors)
    torch.testing.assert_close(scaled[0], plain[0])
    torch.testing.assert_close(scaled[1], factors * plain[1], check_dtype=False)
    torch.testing.assert_close(scaled[2], factors[:, None] * plain[2], check_dtype=False)
    for found, expected in zip(shown, plain, strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", RAY_METHODS)
def test_every_ray_method_scales_and_thins_gradients_if_asked(name: str) -> None:
    method = load_method(name)
    for scaled in (True, False):
        changed: dict[str, Any] = {"gradient_scaling": scaled, "thin_gradients": scaled / 4}
        config = replace(method.config, **TINY.get(name, {}), **changed)
        model = method.build(config, replace(CAPTURE, unbounded=name != "pixel-nerf"))
        assert isinstance(model, RayModel)
        renderer = model.renderer.renderer if isinstance(model.renderer, SphereRenderer) else model.renderer
        assert isinstance(renderer, VolumeRenderer)
        assert (renderer.unit_length, renderer.thin) == ((0.5, 0.25) if scaled else (None, 0))


def test_samples_that_nobody_evaluated_are_refused() -> None:
    field, rays = Cloud(), some_rays(2)
    with pytest.raises(ValueError, match="samples with density and features"):
        VolumeRenderer().shade(rays, UniformSampler(4).sample(rays, field, False), field, torch.ones(3))
