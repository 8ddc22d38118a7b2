"""The inverted sphere behind a method: compositing, the end of the inside, and decisions."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.base.errors import ConfigError
from nerfloom.data.scene import Scene
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.inverted import InvertedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.geometry.spheres import InvertedRays, distances_behind
from nerfloom.kernels.encodings.contraction import contract_to_unit_reference
from nerfloom.method import Method
from nerfloom.methods import instant_ngp, nerf_plus_plus, vanilla_nerf
from nerfloom.ray_model import RayModel
from nerfloom.rendering.background import SphereRenderer, over_background
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer, volume_render
from nerfloom.samplers.background import foreground, foreground_sphere
from nerfloom.samplers.hierarchical import HierarchicalSampler
from nerfloom.samplers.inside import InsideSphere
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.samplers.uniform import UniformSampler
from nerfloom.testing import check_method
from nerfloom.testing.method_under_test import Learner
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky
from tests.training.helpers import TINY

SPHERE = torch.tensor([0.2, -0.1, 0.0, 1.5]).double()
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
UNBOUNDED = ball_under_a_sky().scene
BOUNDED = ball_in_a_box().scene
BLACK = torch.zeros(3)
PLUS, PLUS_GRID = TINY["nerf-plus-plus"], TINY["nerf-plus-plus+hash-grid"]
VARIANTS: dict[str, tuple[Method, dict[str, Any]]] = {
    "nerf-plus-plus": (nerf_plus_plus.METHOD, PLUS),
    "nerf-plus-plus --encoding hash-grid": (nerf_plus_plus.METHOD, PLUS_GRID),
    "vanilla-nerf": (vanilla_nerf.METHOD, {**TINY["vanilla-nerf"], "background_model": "sphere"}),
    "vanilla-nerf --sampler occupancy": (
        vanilla_nerf.METHOD, {**TINY["vanilla-nerf+occupancy"], "background_model": "sphere"},
    ),
    "instant-ngp": (instant_ngp.METHOD, {**TINY["instant-ngp"], "background_model": "sphere"}),
    "instant-ngp --sampler proposal": (
        instant_ngp.METHOD, {**TINY["instant-ngp"], "background_model": "sphere", "sampler": "proposal"},
    ),
}  # fmt: skip


class Fog(Field):
    """A density, and colours that are the first three numbers of positions, or one colour."""

    def __init__(self, sigma: Tensor, color: Tensor | None = None) -> None:
        super().__init__()
        self.sigma, self.shown = sigma, color

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.sigma.expand(len(points.positions)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features[:, :3] if self.shown is None else self.shown.expand(len(features), 3)


def rays_of(count: int, far: float = 50.0) -> Rays:
    generator = torch.Generator().manual_seed(0)
    origins = 0.5 * torch.randn(count, 3, generator=generator).double()
    directions = normalize(torch.randn(count, 3, generator=generator).double(), dim=-1)
    return Rays(origins, directions, fars=torch.full((count,), far).double())


def uniform(model: InsideSphere | UniformSampler, field: Field, rays: Rays) -> Samples:
    return model.sample(rays, field, False)


# -- what is composited -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("endless", [False, True])
def test_fog_inside_and_outside_in_closed_form(endless: bool) -> None:
    """Fog of density a inside, along a chord, and of b in 1/r outside: value and gradient, however many samples."""
    rays = rays_of(40)
    a, b = (torch.tensor(value).double().requires_grad_() for value in (0.4, 0.7))
    colors = [torch.tensor(value).double() for value in ((0.9, 0.2, 0.4), (0.1, 0.5, 0.8), (0.3, 0.6, 0.2))]
    inner, outer = Fog(a, colors[0]), Fog(b, colors[1])
    sampler = InsideSphere(UniformSampler(7), SPHERE)
    renderer = SphereRenderer(VolumeRenderer(), SPHERE, outer, UniformSampler(5), endless)
    found = renderer.render(rays, sampler.sample(rays, inner, False), inner, colors[2])

    offsets = rays.origins - SPHERE[:3]
    middle = -(offsets * rays.directions).sum(-1)
    square = SPHERE[3] ** 2 - offsets.square().sum(-1) + middle**2
    half = square.clamp(min=0).sqrt()
    chord = torch.where(square > 0, (middle + half).clamp(min=0) - (middle - half).clamp(min=0), 0)
    start = torch.where(square > 0, (middle + half).clamp(min=0), middle.clamp(min=0))
    first, last = ((rays.origins + t[:, None] * rays.directions - SPHERE[:3]).norm(dim=-1) for t in (start, rays.fars))
    length = (1 / (first / SPHERE[3]).clamp(min=1) - SPHERE[3] / last).detach()
    through, behind = (-a * chord).exp(), (-b * length).exp() * (not endless)
    truth = (1 - through)[:, None] * colors[0] + (through * (1 - behind))[:, None] * colors[1]
    truth = truth + (through * behind)[:, None] * colors[2]
    torch.testing.assert_close(found.rgb, truth)
    torch.testing.assert_close(found.accumulation, 1 - through * behind)
    weights = torch.rand(40, 3).double()
    gradients = [torch.autograd.grad((rgb * weights).sum(), (a, b), retain_graph=True) for rgb in (found.rgb, truth)]
    for mine, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-9, rtol=1e-6)


def test_colours_and_depths_are_those_of_all_samples_in_one_row() -> None:
    """The truth is one compositing of inner and outer samples together, with arbitrary densities and lengths."""
    torch.manual_seed(0)
    count, inner, outer = 30, 6, 5
    rays = Rays(torch.zeros(count, 3).double(), normalize(torch.randn(count, 3).double(), dim=-1))
    rays = dataclasses.replace(rays, fars=torch.ones(count).double())
    t = torch.rand(count, inner + outer + 1).double().cumsum(-1) / 20
    sigma = 60 * torch.rand(count, inner + outer).double() * torch.rand(count, 1).double()
    rgb = torch.rand(count, inner + outer, 3).double()

    def part(chosen: slice, background: Tensor) -> Rendered:
        ends = t[:, chosen.start : chosen.stop + 1]
        samples = Samples.regular(ends[:, :-1], ends[:, 1:])
        flat = sigma[:, chosen].reshape(-1), rgb[:, chosen].reshape(-1, 3)
        return volume_render(rays, samples, *flat, background)

    background = torch.rand(count, 3).double()
    truth = part(slice(0, inner + outer), background)
    inside = part(slice(0, inner), torch.zeros_like(background))
    outside = part(slice(inner, inner + outer), background)
    found = over_background(inside, outside, lambda places: places)
    torch.testing.assert_close(found.rgb, truth.rgb)
    torch.testing.assert_close(found.accumulation, truth.accumulation)
    torch.testing.assert_close(found.depth, truth.depth)
    opaque = (truth.accumulation > 0.5) & ((truth.accumulation - 0.5).abs() > 1e-6)
    assert int(opaque.sum()) > 5
    torch.testing.assert_close(found.median_depth[opaque], truth.median_depth[opaque])
    assert found.num_samples == truth.num_samples
    assert found.samples is inside.samples


def test_each_level_is_behind_its_own() -> None:
    levels = []
    for value in (0.2, 0.6):
        rgb, half = torch.full((4, 3), value), torch.full((4,), 0.5)
        samples = Samples.regular(torch.zeros(4, 1), torch.ones(4, 1))
        level = Rendered(rgb, half, half, half, 4, weights=half, samples=samples)
        levels.append(level.over(dataclasses.replace(level, rgb=rgb + 0.1)))
    found = over_background(*levels, lambda places: places)
    assert found.coarse is not None
    torch.testing.assert_close(found.rgb, torch.full((4, 3), 0.2 + 0.5 * 0.6))
    torch.testing.assert_close(found.coarse.rgb, torch.full((4, 3), 0.3 + 0.5 * 0.7))
    torch.testing.assert_close(found.accumulation, torch.full((4,), 0.75))
    assert found.num_samples == 16


def test_a_ray_that_ends_inside_sees_nothing_outside() -> None:
    """Rays of a viewer's crop box do so."""
    rays = dataclasses.replace(rays_of(20), fars=torch.full((20,), 0.05).double())
    rays = dataclasses.replace(rays, origins=SPHERE[:3].expand(20, 3))
    clear, solid = Fog(torch.zeros(()).double()), Fog(torch.full((), 9.0).double())
    renderer = SphereRenderer(VolumeRenderer(), SPHERE, solid, UniformSampler(4), endless=True)
    found = renderer.render(rays, InsideSphere(UniformSampler(4), SPHERE).sample(rays, clear, False), clear, BLACK)
    assert not found.accumulation.any()


def ended(bound: float, training: bool, copies: int = 1) -> tuple[Rendered, Tensor, Tensor]:
    """Fog before fog, said to have ended at a transmittance; and the densities inside and outside."""
    rays = rays_of(12)[torch.arange(12).repeat(copies)]
    a, b = (torch.tensor(value).double().requires_grad_() for value in (1.0, 0.7))
    inner, outer = Fog(a, torch.tensor([0.9, 0.2, 0.4]).double()), Fog(b, torch.tensor([0.1, 0.5, 0.8]).double())
    renderer = SphereRenderer(VolumeRenderer(), SPHERE, outer, UniformSampler(5), endless=False).train(training)
    samples = dataclasses.replace(uniform(InsideSphere(UniformSampler(7), SPHERE), inner, rays), early_stop=bound)
    behind = torch.full((len(rays), 3), 0.6, dtype=torch.float64)
    return renderer.render(rays, samples, inner, behind), a, b


def left_inside(rendered: Rendered) -> Tensor:
    """The transmittance (R,) of the inside alone."""
    assert rendered.weights is not None
    assert rendered.samples is not None
    return 1 - rendered.samples.padded(rendered.weights).sum(-1).detach()


def test_pictures_leave_out_what_is_behind_opaque_rays() -> None:
    """Within the bound of the early stop, of the more opaque half; the other rays stay as they are."""
    whole, *_ = ended(0.0, training=False)
    left = left_inside(whole)
    bound = float(left.median()) * (1 + 1e-6)
    opaque = left <= bound
    found, *_ = ended(bound, training=False)
    assert int(opaque.sum()) == 6
    for name in ("rgb", "accumulation", "depth", "median_depth"):
        torch.testing.assert_close(getattr(found, name)[~opaque], getattr(whole, name)[~opaque])
    apart = (found.rgb - whole.rgb).abs().amax(-1)
    assert bool((apart <= left + 1e-9).all())
    assert float(apart[opaque].max()) > 1e-3
    torch.testing.assert_close(found.accumulation[opaque], (1 - left)[opaque])
    assert found.num_samples == whole.num_samples - 5 * 6
    assert found.error_bound == bound


@pytest.mark.medium
def test_training_draws_the_outside_of_opaque_rays_without_bias() -> None:
    """Means over many draws of colours and of their gradients, against all of the outside."""
    torch.manual_seed(0)
    copies = 4_000
    whole, *densities = ended(0.0, training=True)
    truth = torch.autograd.grad(whole.rgb.square().sum() + whole.rgb[:, 0].sum(), densities)
    found, *drawn = ended(float(left_inside(whole).max()), training=True, copies=copies)
    assert int(found.num_samples) < 0.95 * copies * int(whole.num_samples)
    mean = found.rgb.view(copies, -1, 3).mean(0)
    torch.testing.assert_close(mean, whole.rgb, atol=0.01, rtol=0)
    gradients = torch.autograd.grad(mean.square().sum() + mean[:, 0].sum(), drawn)
    for value, true in zip(gradients, truth, strict=True):
        assert float(value) == pytest.approx(float(true), rel=0.05)


# -- where the inside ends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("name", ["uniform", "hierarchical", "occupancy", "proposal"])
def test_samples_end_with_the_sphere(name: str, jitter: bool) -> None:
    torch.manual_seed(0)
    sphere = SPHERE.float()
    box = torch.stack([sphere[:3] - sphere[3], sphere[:3] + sphere[3]])
    fog = Fog(torch.full((), 0.2))
    sampler = InsideSphere(
        {
            "uniform": UniformSampler(9),
            "hierarchical": HierarchicalSampler(Fog(torch.full((), 0.2)), 5, 6),
            "occupancy": OccupancySampler(box, 8, 64),
            "proposal": ProposalSampler(box, (8, 6), (16,)),
        }[name],
        sphere,
    ).eval()
    wide = rays_of(60)
    rays = Rays(3 * wide.origins.float(), wide.directions.float(), fars=wide.fars.float())
    samples = sampler.sample(rays, fog, jitter)
    levels = [samples] if samples.coarse is None else [samples, samples.coarse.samples]
    for level in levels:
        for t in (level.t_starts, level.t_ends):
            inside = (rays.points(level.ray_indices, t) - sphere[:3]).norm(dim=-1) <= sphere[3] * (1 + 1e-4)
            assert bool((inside | (level.deltas <= 1e-5)).all())
        assert float(level.deltas.min()) >= 0
    shown = VolumeRenderer().render(rays, samples, fog, BLACK)
    offsets = rays.origins - sphere[:3]
    missed = torch.linalg.cross(offsets, rays.directions).norm(dim=-1) > sphere[3]
    assert 5 < int(missed.sum()) < 55
    assert float(shown.accumulation[missed].max()) < 1e-5


# -- what is decided ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "scene", "asked", "background", "sampler"),
    [
        (vanilla_nerf, BOUNDED, {}, "none", "hierarchical"),
        (vanilla_nerf, UNBOUNDED, {}, "contraction", "proposal"),
        (vanilla_nerf, UNBOUNDED, {"sampler": "occupancy"}, "contraction", "occupancy"),
        (vanilla_nerf, UNBOUNDED, {"sampler": "hierarchical"}, "none", "hierarchical"),
        (vanilla_nerf, UNBOUNDED, {"background_model": "sphere"}, "sphere", "hierarchical"),
        (vanilla_nerf, UNBOUNDED, {"background_model": "none"}, "none", "hierarchical"),
        (instant_ngp, BOUNDED, {}, "none", "occupancy"),
        (instant_ngp, UNBOUNDED, {}, "contraction", "proposal"),
        (instant_ngp, UNBOUNDED, {"background_model": "sphere"}, "sphere", "occupancy"),
        (instant_ngp, UNBOUNDED, {"background_model": "sphere", "sampler": "proposal"}, "sphere", "proposal"),
        (instant_ngp, BOUNDED, {"background_model": "contraction"}, "contraction", "proposal"),
        (nerf_plus_plus, BOUNDED, {}, "none", "hierarchical"),
        (nerf_plus_plus, UNBOUNDED, {}, "sphere", "hierarchical"),
        (nerf_plus_plus, UNBOUNDED, {"encoding": "hash-grid"}, "sphere", "occupancy"),
        (nerf_plus_plus, BOUNDED, {"encoding": "hash-grid"}, "none", "occupancy"),
        (nerf_plus_plus, UNBOUNDED, {"background_model": "contraction"}, "contraction", "proposal"),
    ],
)
def test_backgrounds_and_samplers(method: Any, scene: Scene, asked: dict, background: str, sampler: str) -> None:
    config, made = method.METHOD.decided(dataclasses.replace(method.METHOD.config, **asked), scene)
    assert (config.background_model, config.sampler) == (background, sampler)
    said = {decision.option for decision in made}
    assert said & {"background model", "sampler"} == {"background model", "sampler"} - {
        name.replace("_", " ") for name in asked
    }


def test_what_cannot_be_is_refused() -> None:
    config = dataclasses.replace(vanilla_nerf.METHOD.config, background_model="contraction", sampler="hierarchical")
    with pytest.raises(ConfigError, match="contraction needs --sampler proposal or occupancy"):
        vanilla_nerf.METHOD.decided(config, UNBOUNDED)
    config = dataclasses.replace(instant_ngp.METHOD.config, background_model="sphere")
    with pytest.raises(ConfigError, match="normalised device coordinates have no outside"):
        instant_ngp.METHOD.decided(config, dataclasses.replace(UNBOUNDED, warped=True))


def test_the_sphere_contains_box_and_cameras() -> None:
    assert UNBOUNDED.camera_to_worlds is not None
    config = dataclasses.replace(instant_ngp.METHOD.config, background_model="sphere")
    sphere = foreground_sphere(config, UNBOUNDED)
    assert sphere.tolist() == pytest.approx([0, 0, 0, 1.1 * 3])
    near = dataclasses.replace(UNBOUNDED, camera_to_worlds=UNBOUNDED.camera_to_worlds * 0.1)
    assert float(foreground_sphere(config, near)[3]) == 1
    alone = dataclasses.replace(UNBOUNDED, camera_to_worlds=None)
    assert float(foreground_sphere(config, alone)[3]) == pytest.approx(3**0.5)
    inner = foreground(config, UNBOUNDED)
    assert not inner.unbounded
    assert inner.box.flatten().tolist() == pytest.approx([-3.3] * 3 + [3.3] * 3)


def test_a_sphere_around_the_object_is_centred_where_cameras_look() -> None:
    """Cameras on two axes through a point, at the distances 2 and 3; cameras that look apart get the other sphere."""
    config = dataclasses.replace(instant_ngp.METHOD.config, background_model="sphere", sphere_around="object")
    point = torch.tensor([0.3, -0.2, 0.1])
    first = torch.cat([torch.eye(3), (point + torch.tensor([0.0, 0.0, 2.0]))[:, None]], dim=-1)
    turned = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    second = torch.cat([turned, (point + torch.tensor([3.0, 0.0, 0.0]))[:, None]], dim=-1)
    scene = dataclasses.replace(UNBOUNDED, num_cameras=2, camera_to_worlds=torch.stack([first, second]))
    assert foreground_sphere(config, scene).tolist() == pytest.approx([0.3, -0.2, 0.1, 2.0])
    apart = torch.stack([first, second]) * torch.tensor([-1.0, 1.0, -1.0, 1.0])
    scene = dataclasses.replace(scene, camera_to_worlds=apart)
    around = dataclasses.replace(config, sphere_around="cameras")
    assert foreground_sphere(config, scene).tolist() == foreground_sphere(around, scene).tolist()


def test_a_grid_outside_is_laid_out_as_contraction_does() -> None:
    rays = rays_of(50, far=1e9)
    rays = dataclasses.replace(rays, origins=0.3 * rays.origins)
    unit = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    u = torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = InvertedRays.of(rays, unit).points(torch.arange(50), u)
    truth = contract_to_unit_reference(rays.points(torch.arange(50), distances_behind(u, rays, unit)), BOX.double())
    found = InvertedField(HashGrid(2, 2, 4, 8, 8)).unit(points)
    assert 5 < float(1 / points[:, 3].min()) < 1e4
    torch.testing.assert_close(found, truth)


def test_a_background_is_made_of_the_methods_own_parts() -> None:
    kinds = {
        "nerf-plus-plus": (NeRFField, NeRFField, HierarchicalSampler, HierarchicalSampler),
        "nerf-plus-plus --encoding hash-grid": (EncodedField, InvertedField, OccupancySampler, UniformSampler),
        "instant-ngp": (EncodedField, InvertedField, OccupancySampler, UniformSampler),
        "vanilla-nerf --sampler occupancy": (NeRFField, NeRFField, OccupancySampler, UniformSampler),
    }
    for name, expected in kinds.items():
        method, settings = VARIANTS[name]
        model = method.build(dataclasses.replace(method.config, **settings), UNBOUNDED)
        assert isinstance(model, RayModel)
        assert isinstance(model.sampler, InsideSphere)
        assert isinstance(model.renderer, SphereRenderer)
        found = model.field, model.renderer.field, model.sampler.sampler, model.renderer.sampler
        assert tuple(map(type, found)) == expected
        assert model.samples_per_step == model.config.samples_per_batch


def test_without_a_sphere_methods_are_what_they_were() -> None:
    for module, scene, kind in (
        (vanilla_nerf, BOUNDED, HierarchicalSampler),
        (vanilla_nerf, UNBOUNDED, ProposalSampler),
        (instant_ngp, BOUNDED, OccupancySampler),
        (instant_ngp, UNBOUNDED, ProposalSampler),
    ):
        small = dataclasses.replace(module.METHOD.config, **TINY[module.__name__.split(".")[-1].replace("_", "-")])
        model = module.METHOD.build(small, scene)
        assert isinstance(model, RayModel)
        assert (type(model.sampler), type(model.renderer)) == (kind, VolumeRenderer)


# -- methods with a background ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_each_keeps_what_every_method_must(name: str) -> None:
    """nerf-plus-plus is checked beside all built-in methods in tests/test_check_method.py too."""
    method, settings = VARIANTS[name]
    findings = check_method(method, name, dataclasses.replace(method.config, **settings))
    wrong = [finding.line() for finding in findings if not finding.ok]
    if "background_model" in settings:  # asked for where rays end before the sphere, so that nothing outside is learnt
        assert BOUNDED.far < 3 + 3.3
        wrong = [line for line in wrong if "unused parameters: on a still scene in a box: renderer." not in line]
    assert wrong == []
    assert len(findings) > 15


@pytest.mark.medium
@pytest.mark.parametrize("name", ["nerf-plus-plus --encoding hash-grid", "instant-ngp"])
def test_a_ball_before_a_sky_is_learnt(name: str) -> None:
    method, settings = VARIANTS[name]
    learner = Learner(method, dataclasses.replace(method.config, **settings), ball_under_a_sky(), 0)
    for _ in range(90):
        learner.step()
    assert learner.history[-1] < learner.history[0] / 5
    view = learner.view()
    shown = learner.show(view.rays, view.background)
    assert float(shown.accumulation.min()) > 0.99  # the sky is opaque, at the end of every ray
    nearest = torch.linalg.cross(view.rays.origins, view.rays.directions).norm(dim=-1)
    sky = nearest > 0.9
    assert 10 < int(sky.sum()) < len(sky)
    assert float((shown.rgb - view.rgb)[sky].abs().mean()) < 0.1


@pytest.mark.medium
@pytest.mark.parametrize("name", ["nerf-plus-plus", "instant-ngp"])
def test_with_nothing_inside_the_sky_is_learnt_outside(name: str) -> None:
    method, settings = VARIANTS[name]
    learner = Learner(method, dataclasses.replace(method.config, **settings), ball_under_a_sky(), 0)
    model = learner.rays_model
    clear = Fog(torch.zeros(()))
    model.field = clear
    for sampler in model.sampler.modules():
        if isinstance(sampler, HierarchicalSampler):
            sampler.coarse = clear
    for _ in range(60):
        learner.step()
    view = learner.view()
    shown = learner.show(view.rays, view.background)
    sky = torch.linalg.cross(view.rays.origins, view.rays.directions).norm(dim=-1) > 0.9
    assert 10 < int(sky.sum()) < len(sky)
    assert float((shown.rgb - view.rgb)[sky].abs().mean()) < 0.1
    assert float(shown.accumulation.mean()) > 0.9
    assert float(shown.median_depth.min()) > 5  # behind the sphere


def test_the_method_is_a_file_of_at_most_250_lines() -> None:
    import inspect

    assert len(inspect.getsource(nerf_plus_plus).splitlines()) <= 250
