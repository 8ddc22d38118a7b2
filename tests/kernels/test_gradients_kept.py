"""No compiled operation drops a gradient that its reference has: each float input of each of them is asked for one."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import nerfloom
from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.data.pixels.batch import gather_colors, gather_colors_reference, view_colors, view_colors_reference
from nerfloom.fields.base import Field
from nerfloom.geometry.multisamples import Pattern
from nerfloom.geometry.points import Frustums, Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.density import composite, composite_reference, distortion
from nerfloom.kernels.encodings.contraction import contract_to_unit, contract_to_unit_reference
from nerfloom.kernels.encodings.frequency import frequency_encoding, frequency_encoding_reference
from nerfloom.kernels.encodings.integrated_directional import directional_encoding, directional_encoding_reference
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics, spherical_harmonics_reference
from nerfloom.kernels.grids.hash_grid import hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.multisampled_grid import multisampled_grid, multisampled_grid_reference
from nerfloom.kernels.grids.multisamples import (
    frustum_balls,
    frustum_balls_reference,
    unit_multisamples,
    unit_multisamples_reference,
)
from nerfloom.kernels.grids.plane_bands import Band, band_variation
from nerfloom.kernels.grids.planes import PlanesGradient, planes, planes_reference
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.intervals import (
    interval_weights,
    interval_weights_reference,
    proposal_excess,
    proposal_excess_reference,
)
from nerfloom.kernels.histograms.step_functions import blurred_excess, blurred_excess_reference
from nerfloom.kernels.images.ssim import photometric_loss, photometric_reference
from nerfloom.kernels.networks.grouped import (
    grouped_density_mlp,
    grouped_density_mlp_reference,
    grouped_mlp,
    grouped_mlp_reference,
)
from nerfloom.kernels.networks.mlp import density_mlp, density_mlp_reference, mlp, mlp_reference
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.trace import trace_octree, trace_octree_reference
from nerfloom.kernels.splats.blend import blend, blend_reference
from nerfloom.kernels.splats.project import RECORD, Record, SplatCamera, project_gaussians, project_reference
from nerfloom.kernels.splats.tiles import tile_lists
from nerfloom.kernels.surfaces.distance import distance_network, distance_network_reference
from nerfloom.kernels.surfaces.samples import (
    FirstShape,
    Intervals,
    surface_samples,
    surface_samples_reference,
    unit_normals,
    unit_normals_reference,
)
from nerfloom.samplers.occupancy import OccupancySampler
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.distortion_by_pairs import distortion_by_pairs

pytestmark = needs_kernels
GRID = HashGridLayout.build(3, 4, 20, 8)
PLANES = PlanesLayout.build(((5, 6, 7), (8, 9, 10)))
BANDS: tuple[Band, ...] = ((0, 0, 1, 3), (0, 2, 0, 7), (1, 1, 9, 1), (1, 1, 8, 2))
OFFSETS = torch.tensor([0, 3, 3, 8, 12])
OWNERS = torch.arange(40) % 7 % 5  # network 5 has no rows
TREE = OctreeLayout.build(torch.zeros(3), 0.1, (1, 1, 1), torch.cartesian_prod(*[torch.arange(1, 8, 2)] * 3))[0]
Function = Callable[..., Tensor]


@dataclass(frozen=True)
class Operation:
    """A compiled form, its reference, and inputs with gradients to compare."""

    compiled: Function
    reference: Function
    inputs: Callable[[], dict[str, Tensor]]
    kernels: tuple[str, ...]
    without: frozenset[str] = frozenset()
    """Inputs that are documented to have no gradient, in the reference either."""


class DeferredVariation(torch.autograd.Function):
    """The variation of bands with a deferred gradient, which is then taken."""

    @staticmethod
    def forward(ctx: Any, table: Tensor) -> Tensor:
        ctx.deferred, ctx.table = PlanesGradient(PLANES), table.detach().requires_grad_()
        with torch.enable_grad():
            ctx.found = band_variation(ctx.table, PLANES, BANDS, ctx.deferred)
        return ctx.found.detach()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        ctx.found.backward(grad)
        found: Tensor = ctx.deferred.summed(ctx.table.detach())
        return found


def rays_through_tree() -> Rays:
    random = torch.Generator().manual_seed(0)
    targets, origins = 0.8 * torch.rand(40, 3, generator=random), torch.randn(40, 3, generator=random)
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1), fars=torch.full((40,), 9.0))


def rand(*shape: int) -> Tensor:
    return torch.rand(shape) + 0.1


def edges(rays: int, bins: int) -> Tensor:
    return torch.linspace(0, 1, bins + 1) + 0.01 * torch.rand(rays, bins + 1).cumsum(-1)


def sampled(starts: Tensor, ends: Tensor, points: Tensor | None = None) -> Samples:
    return Samples(starts, ends, OFFSETS, points)


def composited(form: Function) -> Function:
    def run(sigma: Tensor, rgb: Tensor, starts: Tensor, lengths: Tensor, background: Tensor, fars: Tensor) -> Tensor:
        found = form(sampled(starts, starts + lengths), sigma, rgb, background, fars)
        return torch.cat([found.color.reshape(-1), found.opacity, found.weights])

    return run


def in_frustums(form: Callable[..., Tensor]) -> Function:
    def run(
        origins: Tensor, directions: Tensor, starts: Tensor, lengths: Tensor, radii: Tensor, turns: Tensor, box: Tensor
    ) -> Tensor:
        frustums = Frustums(origins, directions, starts, starts + lengths, radii)
        return form(frustums, Pattern(turns, torch.ones_like(turns)), box, True)

    return run


def cameras(poses: Tensor, fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor) -> Cameras:
    size = torch.full((2,), 6)
    return Cameras(poses, fx, fy, cx, cy, size, size)


def rays_of(name: str) -> Function:
    def run(**numbers: Tensor) -> Tensor:
        places = numbers.pop("places")
        found = getattr(cameras(**numbers), name)(torch.arange(0, 72, 5), 0.0, 1.0, None, places)
        assert found.pixel_radii is not None
        return torch.cat([found.origins, found.directions, found.pixel_radii[:, None]], dim=-1)

    return run


def network(form: Function) -> Function:
    def run(one: Tensor, two: Tensor, first: Tensor, second: Tensor, bias: Tensor, other: Tensor) -> Tensor:
        return form([one, two], [first, second], "sigmoid", [bias, other])

    return run


def grouped_network(form: Function) -> Function:
    def run(one: Tensor, two: Tensor, table: Tensor) -> Tensor:
        return form([one, two], OWNERS, table, (7, 8, 3), "sigmoid")

    return run


def grouped_density_network(form: Callable[..., tuple[Tensor, Tensor]]) -> Function:
    def run(one: Tensor, two: Tensor, table: Tensor) -> Tensor:
        density, features = form([one, two], OWNERS, table, (7, 8, 3))
        return torch.cat([density[:, None], features], dim=-1)

    return run


def density_network(form: Callable[..., tuple[Tensor, Tensor]]) -> Function:
    def run(one: Tensor, two: Tensor, first: Tensor, second: Tensor, bias: Tensor, other: Tensor) -> Tensor:
        density, out = form([one, two], [first, second], [bias, other])
        return torch.cat([density[:, None], out], -1)

    return run


def around_a_shape(form: Callable[..., tuple[Tensor, Tensor]]) -> Function:
    floor = torch.tensor([0.0, 0.6, 0.8, 0.4])
    shape = FirstShape(torch.tensor([0.5, 0.4, 0.6]), torch.tensor([1.0, 0.8, 0.9]), 0.5, 0.3, 1e-3, floor)

    def run(network: Tensor, sharpness: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor) -> Tensor:
        stopping, features = form(network, sharpness, positions, shape, Intervals(directions, lengths))
        return torch.cat([stopping[:, None], features], -1)

    return run


def gaussians() -> dict[str, Tensor]:
    return {
        "means": torch.rand(20, 3) + torch.tensor([-0.5, -0.5, 3.0]), "log_scales": rand(20, 3) - 2,
        "rotations": rand(20, 4), "logits": rand(20), "colors": rand(20, 3), "harmonics": rand(20, 3, 3) / 5,
        "pose": torch.eye(3, 4),
    }  # fmt: skip


def on_image(form: Function) -> Function:
    def run(pose: Tensor, **rows: Tensor) -> Tensor:
        camera = SplatCamera(pose, (20.0, 22.0, 10.0, 8.0), 20, 17, antialiased=True)
        records = form(*rows.values(), camera, 3)[0]
        # The columns with gradients.
        return torch.cat([records[:, : Record.CUT], records[:, Record.RED : Record.NORMAL_X]], -1)

    return run


def blended(form: Function) -> Function:
    def run(records: Tensor) -> Tensor:
        # The bounds of a Gaussian have no gradient; the compiled form uses their place for other values.
        shape, bounds, rest = records.split([Record.CUT, Record.RED - Record.CUT, RECORD - Record.RED], -1)
        records = torch.cat([shape, bounds.detach(), rest], -1)
        found = form(records, tile_lists(records, 20, 17), 20, 17, torch.ones(3), 4, False)
        return torch.cat([found.image.flatten(), found.transmittance.flatten()])

    return run


def some_records() -> dict[str, Tensor]:
    *rows, pose = gaussians().values()
    records, _ = project_gaussians(*rows, SplatCamera(pose, (20.0, 22.0, 10.0, 8.0), 20, 17))
    return {"records": records}


BACKWARD_BF16 = ("mlp_forward_bf16", "mlp_backward_bf16")
OPERATIONS = {
    "hash grid": Operation(
        lambda positions, table: hash_grid(positions, table, GRID),
        lambda positions, table: hash_grid_reference(positions, table, GRID),
        lambda: {"positions": torch.rand(20, 3), "table": rand(GRID.num_entries, 2)},
        ("hash_grid_forward", "hash_grid_backward_table", "hash_grid_backward_positions"),
    ),
    "distance network": Operation(
        lambda positions, table, first, second: distance_network(positions, table, first, second, GRID),
        lambda positions, table, first, second: distance_network_reference(positions, table, first, second, GRID),
        lambda: {
            "positions": torch.rand(20, 3),
            "table": rand(GRID.num_entries, 2),
            "first": rand(8, 6) - 0.6,
            "second": rand(3, 8) - 0.6,
        },
        ("distance_network_forward", "distance_network_backward", "hash_grid_tangent_backward_table"),
    ),
    "surface samples": Operation(
        around_a_shape(surface_samples),
        around_a_shape(surface_samples_reference),
        lambda: {
            "network": rand(20, 8),
            "sharpness": rand(1)[0] + 3,
            "positions": torch.rand(20, 3),
            "directions": torch.nn.functional.normalize(torch.randn(20, 3), dim=-1),
            "lengths": torch.rand(20),
        },
        ("surface_samples", "surface_samples_backward"),
    ),
    "unit normals": Operation(
        unit_normals,
        unit_normals_reference,
        lambda: {"features": rand(20, 7)},
        ("unit_normals", "unit_normals_backward"),
    ),
    "multisampled grid": Operation(
        lambda points, table: multisampled_grid(points, table, GRID),
        lambda points, table: multisampled_grid_reference(points, table, GRID),
        lambda: {"points": torch.rand(20, 6, 4), "table": rand(GRID.num_entries, 2)},
        ("multisampled_grid_forward", "multisampled_grid_backward_table", "multisampled_grid_backward_points"),
    ),
    "multisamples": Operation(
        in_frustums(unit_multisamples),
        in_frustums(unit_multisamples_reference),
        lambda: {
            "origins": torch.randn(20, 3), "directions": torch.nn.functional.normalize(torch.randn(20, 3), dim=-1),
            "starts": rand(20), "lengths": rand(20), "radii": rand(20), "turns": rand(20),
            "box": torch.tensor([[-1.0] * 3, [1.0, 2.0, 1.5]]),
        },
        ("multisamples", "multisamples_backward"),
    ),
    "frustum balls": Operation(
        lambda origins, directions, starts, lengths, box: frustum_balls(
            Frustums(origins, directions, starts, starts + lengths, torch.full_like(starts, 0.1)), box, True
        ),
        lambda origins, directions, starts, lengths, box: frustum_balls_reference(
            Frustums(origins, directions, starts, starts + lengths, torch.full_like(starts, 0.1)), box, True
        ),
        lambda: {
            "origins": torch.randn(20, 3), "directions": torch.nn.functional.normalize(torch.randn(20, 3), dim=-1),
            "starts": torch.rand(20), "lengths": 0.1 + torch.rand(20),
            "box": torch.tensor([[-1.0] * 3, [1.0, 2.0, 1.5]]),
        },
        ("frustum_balls", "frustum_balls_backward"),
    ),
    "planes": Operation(
        lambda positions, table: planes(positions, table, PLANES),
        lambda positions, table: planes_reference(positions, table, PLANES),
        lambda: {"positions": torch.rand(20, 3), "table": rand(PLANES.num_entries, 4)},
        ("planes_forward", "planes_backward_table", "planes_backward_positions"),
    ),
    "band_variation": Operation(
        lambda table: DeferredVariation.apply(table),
        lambda table: band_variation(table, PLANES, BANDS),
        lambda: {"table": rand(PLANES.num_entries, 4)},
        ("band_variation", "band_variation_backward"),
    ),
    "mlp": Operation(
        network(mlp),
        network(mlp_reference),
        lambda: {
            "one": rand(9, 5), "two": rand(9, 2), "first": rand(8, 7), "second": rand(3, 8), "bias": rand(8),
            "other": rand(3),
        },
        ("mlp_forward", "mlp_backward", *BACKWARD_BF16),
    ),
    "mlp with density": Operation(
        density_network(density_mlp),
        density_network(density_mlp_reference),
        lambda: {
            "one": rand(40, 5), "two": rand(40, 2), "first": rand(8, 7), "second": rand(3, 8) - 0.5, "bias": rand(8),
            "other": rand(3),
        },
        ("mlp_forward", "mlp_backward", *BACKWARD_BF16),
    ),
    "grouped mlp": Operation(
        grouped_network(grouped_mlp),
        grouped_network(grouped_mlp_reference),
        lambda: {"one": rand(40, 5), "two": rand(40, 2), "table": rand(6, 91) - 0.6},
        ("grouped_mlp_forward", "grouped_mlp_backward"),
    ),
    "grouped mlp with density": Operation(
        grouped_density_network(grouped_density_mlp),
        grouped_density_network(grouped_density_mlp_reference),
        lambda: {"one": rand(40, 5), "two": rand(40, 2), "table": rand(6, 91) - 0.6},
        ("grouped_mlp_forward", "grouped_mlp_backward"),
    ),
    "composite": Operation(
        composited(composite),
        composited(composite_reference),
        lambda: {
            "sigma": rand(12), "rgb": rand(12, 3), "starts": rand(12), "lengths": rand(12), "background": rand(4, 3),
            "fars": rand(4) + 9,
        },
        ("composite_forward", "composite_backward"),
    ),
    "distortion": Operation(
        lambda weights, starts, ends: distortion(weights, sampled(starts, ends)),
        lambda weights, starts, ends: distortion_by_pairs(weights, sampled(starts, ends)),
        lambda: {"weights": rand(12), "starts": torch.arange(12) + rand(12), "ends": torch.arange(12) + 1 + rand(12)},
        ("distortion",),
    ),
    "contraction": Operation(
        contract_to_unit,
        contract_to_unit_reference,
        lambda: {"positions": 4 * torch.randn(20, 3), "box": torch.tensor([[-1.0] * 3, [1.0, 2.0, 1.5]])},
        ("contract_positions", "contract_positions_backward"),
    ),
    "frequencies": Operation(
        lambda x: frequency_encoding(x, 4),
        lambda x: frequency_encoding_reference(x, 4),
        lambda: {"x": rand(9, 3)},
        ("frequency_encoding", "frequency_encoding_backward"),
    ),
    "spherical harmonics": Operation(
        spherical_harmonics,
        spherical_harmonics_reference,
        lambda: {"directions": rand(9, 3)},
        ("spherical_harmonics", "spherical_harmonics_backward"),
    ),
    "directional encoding": Operation(
        directional_encoding,
        directional_encoding_reference,
        lambda: {"directions": rand(9, 3), "roughness": rand(9)},
        ("directional_encoding", "directional_encoding_backward"),
    ),
    "interval weights": Operation(
        interval_weights,
        lambda sigma, t: interval_weights_reference(sigma, t.detach()),
        lambda: {"sigma": rand(4, 6), "t": edges(4, 6)},
        ("interval_weights", "interval_weights_backward"),
        frozenset({"t"}),
    ),
    "proposals' excess": Operation(
        proposal_excess,
        lambda edges, weights, proposed, proposed_weights: proposal_excess_reference(
            edges.detach(), weights.detach(), proposed.detach(), proposed_weights
        ),
        lambda: {
            "edges": edges(4, 6), "weights": 3 * rand(4, 6), "proposed": edges(4, 9), "proposed_weights": rand(4, 9),
        },
        ("proposal_excess",),
        frozenset({"edges", "weights", "proposed"}),
    ),
    "proposals' excess over blurred weights": Operation(
        partial(blurred_excess, radius=0.03),
        lambda edges, weights, proposed, proposed_weights: blurred_excess_reference(
            edges.detach(), weights.detach(), proposed.detach(), proposed_weights, 0.03
        ),
        lambda: {
            "edges": edges(4, 6), "weights": 3 * rand(4, 6), "proposed": edges(4, 9), "proposed_weights": rand(4, 9),
        },
        ("blurred_excess",),
        frozenset({"edges", "weights", "proposed"}),
    ),
    "projected Gaussians": Operation(
        on_image(lambda *given: project_gaussians(*given[:-1], degree=1)),
        on_image(project_reference),
        gaussians,
        ("splat_project", "splat_project_backward"),
    ),
    "blended Gaussians": Operation(
        blended(blend), blended(blend_reference), some_records, ("splat_blend", "splat_blend_backward", "splat_gather")
    ),
    "photometric loss": Operation(
        partial(photometric_loss, ssim_weight=0.2),
        partial(photometric_reference, ssim_weight=0.2),
        lambda: {"image": rand(13, 15, 3), "target": rand(13, 15, 3)},
        ("photometric",),
    ),
    "camera rays": Operation(
        rays_of("pixel_rays"),
        rays_of("pixel_rays_reference"),
        lambda: {
            "poses": torch.randn(2, 3, 4), "fx": rand(2) + 5, "fy": rand(2) + 5, "cx": rand(2) + 3, "cy": rand(2) + 3,
            "places": subpixels(4),
        },
        ("camera_rays",),
    ),
    "octree": Operation(
        lambda raw, coefficients: trace_octree(TREE, raw, coefficients, rays_through_tree(), torch.ones(3)).color,
        lambda raw, coefficients: trace_octree_reference(
            TREE, raw, coefficients, rays_through_tree(), torch.ones(40, 3)
        ).color,
        lambda: {"raw": rand(TREE.num_leaves, 1), "coefficients": rand(TREE.num_leaves, 12)},
        ("octree_trace", "octree_trace_backward"),
    ),
    "colours": Operation(
        lambda behind: gather_colors(COLORS, torch.arange(9), behind)[0],
        lambda behind: gather_colors_reference(COLORS, torch.arange(9), behind)[0],
        lambda: {"behind": rand(9, 3)},
        ("gather_colors",),
    ),
    "colours of a view": Operation(
        lambda behind: view_colors(COLORS[None], behind)[0],
        lambda behind: view_colors_reference(COLORS[None], behind)[0],
        lambda: {"behind": rand(3)},
        ("view_colors",),
    ),
}  # fmt: skip
COLORS = torch.randint(256, (9, 4), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
WITHOUT_A_GRADIENT = {
    "pack_occupancy", "refresh_occupancy", "march_begin", "march_wave", "march_advance",  # refused, as tested below
    "trace_rays", "trace_take",  # operations with the gradient receive their values (test_trace.py)
    "spaced_distances", "first_covisible",  # of inputs without gradients
    "proposal_weights",  # likewise (test_proposals.py)
    "traced_error", "traced_error_take",  # compared in test_traced_error.py
    "traced_colors",  # for pictures alone, and refused where a gradient is asked for
    "sort_by_ray", "gather_rows", "resample_intervals",  # documented to have none
    "adam_sparse", "adam_dense", "all_finite", "hash_grid_adam", "hash_grid_tangent_adam", "multisampled_grid_adam",
    "hash_grid_tangent_forward",  # of the optimiser; and refused where a gradient is asked for
    "signed_distances", "crossings_find", "crossings_take",  # without one, for occupancy and pictures
    "opaque_sums", "hold_balls", "pixels_near_balls",  # with counts or booleans as results
    "splat_sort", "splat_bound", "splat_bin", "group_rows",  # with indices as results
    "octree_weights", "adam_rows", "octree_trace_packed",  # documented to have none; of the optimiser; of bytes
    "splat_project_packed",  # for pictures alone, and refused where a gradient is asked for
}  # fmt: skip


def test_every_kernel_is_asked() -> None:
    sources = "".join(file.read_text() for file in Path(nerfloom.__file__).parent.rglob("*.py"))
    declared = set(re.findall(r'native\.Function\("(\w+)"', sources))
    covered = {kernel for operation in OPERATIONS.values() for kernel in operation.kernels}
    assert declared == covered | WITHOUT_A_GRADIENT


CASES = [(name, given) for name, operation in OPERATIONS.items() for given in (*operation.inputs(), "all")]


@pytest.mark.parametrize(("name", "given"), CASES, ids=[f"{name}-{given}" for name, given in CASES])
def test_the_gradient_is_the_references(name: str, given: str) -> None:
    """Gradients of an input alone, and of all together, equal the reference's."""
    operation, found = OPERATIONS[name], []
    torch.manual_seed(0)
    inputs = operation.inputs()
    asked = sorted(inputs) if given == "all" else [given]
    for form in (operation.compiled, operation.reference):
        ready = {key: value.clone().requires_grad_(key in asked) for key, value in inputs.items()}
        out = form(**ready)
        if out.requires_grad:
            (out * torch.linspace(0.5, 1.5, out.numel()).view_as(out)).sum().backward()
        found.append((out.detach(), [ready[key].grad for key in asked]))
    (value, grads), (truth, true_grads) = found
    assert relative_error(value, truth) < 1e-4
    for key, grad, true in zip(asked, grads, true_grads, strict=True):
        assert (true is None) == (key in operation.without or key == "fars"), key
        assert (grad is None or not grad.any()) if true is None else grad is not None, key
        if true is not None and grad is not None:
            assert relative_error(grad, true) < 1e-3, key


class Fog(Field):
    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return points.positions.square().sum(-1), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


@pytest.mark.parametrize("which", ["origins", "directions"])
def test_marching_refuses_rays_that_are_learnt(which: str) -> None:
    sampler = OccupancySampler(torch.tensor([[-1.0] * 3, [1.0] * 3]), 8, 16)
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    rays = Rays(torch.zeros(4, 3) - 2 * directions, directions, torch.zeros(4), torch.full((4,), 9.0))
    assert len(sampler.sample(rays, Fog(), jitter=False)) > 0
    learnt = replace(rays, **{which: getattr(rays, which).clone().requires_grad_()})
    with pytest.raises(ValueError, match="carry no gradient to rays"):
        sampler.sample(learnt, Fog(), jitter=False)
    with torch.no_grad():
        assert len(sampler.sample(learnt, Fog(), jitter=False)) > 0
