"""Light through octrees: against every leaf's box tested by hand in float64, and compiled against the reference."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.adam.adam import sparse_adam_reference
from nerfloom.kernels.adam.row_gradient import RowGradient
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.kernels.octree.light import OctreeLight, error_bound
from nerfloom.kernels.octree.packed import PackedLeaves, trace_packed, trace_packed_reference
from nerfloom.kernels.octree.trace import trace_octree, trace_octree_reference
from nerfloom.kernels.octree.weights import raise_weights, raise_weights_reference
from tests.kernels.compiled import needs_kernels, relative_error

SIZE = (3, 2, 4)
ORIGIN = torch.tensor([-1.0, -0.7, -1.3])
CELL = 0.08


def layout_of(cells: Tensor, size: tuple[int, int, int] = SIZE) -> OctreeLayout:
    return OctreeLayout.build(ORIGIN, CELL, size, cells)[0]


def scattered(share: float) -> Tensor:
    """Some cells of some bricks; other bricks stay empty."""
    grid = torch.cartesian_prod(*[torch.arange(BRICK * count) for count in SIZE])
    there = torch.rand(SIZE) < 0.5
    brick = grid // BRICK
    return grid[(torch.rand(len(grid)) < share) & there[brick[:, 0], brick[:, 1], brick[:, 2]]]


def values(layout: OctreeLayout, degree: int) -> tuple[Tensor, Tensor]:
    count = layout.num_leaves
    return 3 * torch.randn(count, 1), torch.randn(count, 3 * (degree + 1) ** 2)


def rays_at(layout: OctreeLayout, count: int) -> Rays:
    """Rays from outside and from inside of the box, a few along axes, through faces and edges of cells, and past it."""
    low, high = layout.box
    targets = low + torch.rand(count, 3) * (high - low)
    origins = targets + torch.randn(count, 3) * torch.rand(count, 1) * 3
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    axes = torch.eye(3).repeat(count // 12 + 1, 1)[: count // 4]
    directions[: len(axes)] = axes * torch.where(torch.rand(len(axes), 1) < 0.5, -1.0, 1.0)
    edges = (torch.rand(len(axes) // 2, 3) * BRICK).floor() * CELL
    origins[: len(edges)] = low + edges - 3 * directions[: len(edges)]
    nears = torch.where(torch.rand(count) < 0.5, 0.0, torch.rand(count))
    fars = torch.where(torch.rand(count) < 0.2, 1 + torch.rand(count), 20.0)
    return Rays(origins, directions, nears, fars)


def in_float64(rays: Rays) -> Rays:
    return Rays(*(part.double() for part in (rays.origins, rays.directions, rays.nears, rays.fars)))


def by_hand(layout: OctreeLayout, raw: Tensor, coefficients: Tensor, rays: Rays, background: Tensor) -> OctreeLight:
    """Each leaf's cube cut by each ray, sorted by distance and integrated one after the other, in float64."""
    low = layout.origin.double() + layout.cell * layout.cells().double()
    out = []
    for origin, direction, near, far, behind in zip(
        rays.origins.double(), rays.directions.double(), rays.nears.double(), rays.fars.double(), background.double(),
        strict=True,
    ):  # fmt: skip
        along = torch.where(direction.abs() < 1e-14, torch.full_like(direction, 1e-14), direction)
        sides = torch.stack([(low - origin) / along, (low + layout.cell - origin) / along])
        start = sides.amin(0).amax(-1).clamp(min=float(near))
        end = sides.amax(0).amin(-1).clamp(max=float(far))
        met = (end > start + 1e-12).nonzero()[:, 0]
        met = met[start[met].argsort()]
        through, color, moment, median = 1.0, torch.zeros(3, dtype=torch.float64), 0.0, float(far)
        basis = spherical_harmonics_reference(direction[None], math.isqrt(coefficients.shape[1] // 3))[0]
        for leaf in met.tolist():
            sigma = depth_of(float(raw[leaf])) / layout.cell
            depth = sigma * float(end[leaf] - start[leaf])
            weight = through * -math.expm1(-depth)
            color = color + weight * (coefficients[leaf].double().view(3, -1) @ basis)
            moment += weight * float(start[leaf] + end[leaf]) / 2
            if through > 0.5 >= through * math.exp(-depth):
                median = float(start[leaf]) + math.log(2 * through) / sigma
            through *= math.exp(-depth)
        color = color + through * behind
        numbers = (torch.tensor(number) for number in (1 - through, moment, median, len(met)))
        out.append((color, *numbers))
    return OctreeLight(*(torch.stack([row[i] for row in out]).double() for i in range(5)))


def depth_of(raw: float) -> float:
    return raw if raw > 1 else math.exp(raw - 1)


def same(found: OctreeLight, truth: OctreeLight, tolerance: float, medians: float = 0.0) -> None:
    """A share of medians may differ: a transmittance of 0.5 between two leaves may be in front or behind."""
    for name in ("color", "opacity", "moment"):
        error = relative_error(getattr(found, name), getattr(truth, name))
        print(f"{name}: {error:.2g}")
        assert error < tolerance, name
    off = (found.median.double() - truth.median.double()).abs() > 100 * tolerance
    assert off.double().mean() <= medians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_reference_is_the_integral_over_every_leaf(degree: int) -> None:
    torch.manual_seed(degree)
    layout = layout_of(scattered(0.3))
    raw, coefficients = values(layout, degree)
    rays, background = rays_at(layout, 60), torch.rand(60, 3)
    exact = in_float64(rays)
    found = trace_octree_reference(layout, raw.double(), coefficients.double(), exact, background.double())
    # A ray in a face of cells is in the cells on either side, or in none: such rays are left out of the comparison.
    slow = rays.directions.abs().amin(-1) > 1e-6
    truth = by_hand(layout, raw, coefficients, rays, background)
    pick = lambda light: OctreeLight(*(part[slow] for part in light))  # noqa: E731
    same(pick(found), pick(truth), 1e-6)
    assert torch.equal(pick(found).visits.double(), pick(truth).visits)


def test_leaves_and_their_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr("nerfloom.kernels.octree.layout.BRICKS_AT_ONCE", 5)
    cells = scattered(0.2)
    cells = cells[torch.randperm(len(cells))]
    layout, rows = OctreeLayout.build(ORIGIN, CELL, SIZE, torch.cat([cells, cells[:50]]))
    assert layout.num_leaves == len(cells) == len(rows)
    assert torch.equal(layout.cells(), cells[rows % len(cells)])
    assert int(layout.firsts[0, 0]) == 0


def test_distances_between_bricks_are_those_by_brute_force() -> None:
    size = (20, 3, 5)
    layout = layout_of(torch.tensor([[2, 1, 3], [33, 20, 30]]), size)
    filled = (layout.bricks >= 0).nonzero()
    everywhere = torch.cartesian_prod(*[torch.arange(count) for count in size])
    distance = (everywhere[:, None] - filled).abs().amax(-1).amin(-1).view(size)
    found = torch.where(layout.bricks >= 0, 0, -layout.bricks)
    assert torch.equal(found, distance.clamp(max=16).int())


def test_a_closed_form() -> None:
    """A row of leaves of one density has the opacity of its length, for cells of any size."""
    cells = torch.stack([torch.arange(16), torch.full((16,), 3), torch.full((16,), 5)], -1)
    layout = layout_of(cells)
    raw = torch.full((16, 1), 0.3)
    start = layout.origin + layout.cell * torch.tensor([-5.0, 3.5, 5.5])
    rays = Rays(start[None], torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1), torch.full((1,), 20.0))
    found = trace_octree(layout, raw, torch.zeros(16, 3), rays, torch.ones(1, 3))
    depth = 16 * depth_of(0.3)
    assert float(found.opacity) == pytest.approx(1 - math.exp(-depth), abs=1e-6)
    half = math.log(2) / depth_of(0.3) * layout.cell
    assert float(found.median) == pytest.approx(5 * layout.cell + half, abs=1e-5)
    assert found.visits.tolist() == [16]
    ended = trace_octree(layout, raw, torch.zeros(16, 3), rays, torch.ones(1, 3), stop=math.exp(-2.5 * depth_of(0.3)))
    assert ended.visits.tolist() == [3]


@needs_kernels
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compiled_against_float64(degree: int) -> None:
    torch.manual_seed(10 + degree)
    layout = layout_of(scattered(0.3))
    raw, coefficients = values(layout, degree)
    rays, background = rays_at(layout, 3000), torch.rand(3000, 3)
    found = trace_octree(layout, raw, coefficients, rays, background)
    # The reference's own type puts rays in faces of cells on the same side of them.
    truth = trace_octree_reference(layout, raw.double(), coefficients.double(), in_float64(rays), background.double())
    slow = rays.directions.abs().amin(-1) > 1e-6
    pick = lambda light: OctreeLight(*(part[slow] for part in light))  # noqa: E731
    same(pick(found), pick(truth), 5e-4, medians=0.01)
    assert (pick(found).visits != pick(truth).visits).double().mean() < 0.01  # rounding may cut off a corner
    close = trace_octree_reference(layout, raw, coefficients, rays, background)
    same(found, close, 5e-4, medians=0.01)


@needs_kernels
@pytest.mark.parametrize("stop", [0.0, 0.02])
@pytest.mark.parametrize("degree", [0, 2])
def test_gradients_against_float64(degree: int, stop: float) -> None:
    torch.manual_seed(20 + degree)
    layout = layout_of(scattered(0.3))
    rays, background = rays_at(layout, 2000), torch.rand(2000, 3)
    rays = rays[rays.directions.abs().amin(-1) > 1e-6]
    background = background[: len(rays)]
    aims, opacities = torch.randn(len(rays), 3), torch.randn(len(rays))
    found = []
    for kind in (torch.float32, torch.float64):
        torch.manual_seed(1)
        raw, coefficients = (part.to(kind).requires_grad_() for part in values(layout, degree))
        cast = rays if kind == torch.float32 else in_float64(rays)
        light = trace_octree(layout, raw, coefficients, cast, background.to(kind), stop)
        ((light.color * aims).sum() + (light.opacity * opacities).sum()).backward()
        found.append((raw.grad, coefficients.grad))
    for ours, truth in zip(*found, strict=True):
        error = relative_error(ours, truth)
        print(f"gradient: {error:.2g}")
        # Rounding may end a ray one leaf earlier or later if there is a stop.
        assert error < (1e-4 if stop == 0 else 3e-3)


@needs_kernels
def test_the_deferred_gradient_is_the_gradient() -> None:
    torch.manual_seed(3)
    layout = layout_of(scattered(0.2))
    rays, background = rays_at(layout, 500), torch.rand(500, 3)
    raw, coefficients = (part.requires_grad_() for part in values(layout, 1))
    kept = RowGradient(), RowGradient()
    trace_octree(layout, raw, coefficients, rays, background).color.square().sum().backward()
    trace_octree(layout, raw, coefficients, rays, background, deferred=kept).color.square().sum().backward()
    leaves, rows = kept[1].parts[0]
    assert bool((leaves.diff() > 0).all())
    assert torch.equal(rows, coefficients.grad[leaves.long()])
    assert torch.equal(kept[0].summed(raw), raw.grad)
    assert not kept[0].pending


@needs_kernels
@pytest.mark.parametrize("width", [1, 3, 12, 27, 48, 5, 1000])
def test_adam_of_rows_is_sparse_adam(width: int) -> None:
    torch.manual_seed(width)
    tables = torch.randn(3, 500, width)
    tables[2] = tables[2].square()
    gradient, seen = torch.zeros(500, width), torch.randint(5, (500,)).float()
    leaves = torch.randperm(500)[:200].sort().values.int()
    gradient[leaves.long()] = torch.randn(200, width)
    gradient[leaves[3]] = 0  # met, and without a gradient
    truth, counts = [table.double().clone() for table in tables], seen.double()
    sparse_adam_reference(truth[0], gradient.double(), truth[1], truth[2], counts, 0.1, (0.9, 0.99), 1e-8)
    kept = RowGradient()
    kept.parts.append((leaves, gradient[leaves.long()]))
    kept.adam(tables[0], tables[1], tables[2], seen, 0.1, (0.9, 0.99), 1e-8)
    for found, exact in zip(tables, truth, strict=True):
        assert relative_error(found, exact) < 1e-5
    assert torch.equal(seen.double(), counts)
    assert not kept.pending


@needs_kernels
def test_the_same_bits_on_any_number_of_threads() -> None:
    torch.manual_seed(4)
    layout = layout_of(scattered(0.3))
    rays, background = rays_at(layout, 3000), torch.rand(3000, 3)
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        raw, coefficients = (part.requires_grad_() for part in values(layout, 1))
        light = trace_octree(layout, raw, coefficients, rays, background)
        light.color.sin().sum().backward()
        found.append((light.color, raw.grad, coefficients.grad))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


@pytest.mark.parametrize("stop", [1e-3, 0.05])
def test_the_early_stop_keeps_its_bound(stop: float) -> None:
    torch.manual_seed(5)
    layout = layout_of(scattered(0.6))
    raw, coefficients = values(layout, 2)
    rays, background = rays_at(layout, 2000), torch.rand(2000, 3)
    exact = trace_octree(layout, raw, coefficients, rays, background)
    ended = trace_octree(layout, raw, coefficients, rays, background, stop)
    worst, bound = float((exact.color - ended.color).abs().max()), error_bound(coefficients, stop)
    print(f"worst {worst:.2g} of {bound:.2g}")
    assert 0 < worst <= bound
    assert float((exact.opacity - ended.opacity).abs().max()) <= stop


def test_the_bound_of_a_channel_holds_for_its_harmonics() -> None:
    torch.manual_seed(6)
    directions = torch.nn.functional.normalize(torch.randn(2000, 3), dim=-1)
    coefficients = torch.randn(1, 48)
    largest = (coefficients.view(3, 16) @ spherical_harmonics_reference(directions, 4).T).abs().max()
    assert 0.3 * error_bound(coefficients, 1.0) < float(largest) <= error_bound(coefficients, 1.0)


def packed(layout: OctreeLayout, degree: int) -> PackedLeaves:
    count, width = layout.num_leaves, 3 * (degree + 1) ** 2
    return PackedLeaves(
        torch.randint(256, (count,), dtype=torch.uint8),
        torch.linspace(0, 8, 256),
        torch.randint(256, (count, width), dtype=torch.uint8),
        torch.rand(width) / 255,
        torch.rand(width) - 0.5,
    )


@needs_kernels
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_leaves_of_bytes(degree: int) -> None:
    torch.manual_seed(30 + degree)
    layout = layout_of(scattered(0.3))
    leaves, rays, background = packed(layout, degree), rays_at(layout, 2000), torch.rand(2000, 3)
    found = trace_packed(layout, leaves, rays, background)
    same(found, trace_packed_reference(layout, leaves, rays, background), 5e-4, medians=0.01)


@needs_kernels
def test_largest_weights() -> None:
    torch.manual_seed(7)
    layout = layout_of(scattered(0.3))
    raw, rays = values(layout, 0)[0], rays_at(layout, 1000)
    found, truth = torch.zeros(layout.num_leaves), torch.zeros(layout.num_leaves)
    opacity = raise_weights(layout, raw, rays, found)
    exact = raise_weights_reference(layout, raw, rays, truth)
    assert relative_error(opacity, exact) < 1e-4
    assert float((found - truth).abs().max()) < 1e-4
    assert float(found.max()) > 0.9
    raise_weights(layout, raw - 3, rays, found)
    assert bool((found >= truth - 1e-4).all())


@pytest.mark.parametrize("trace", [trace_octree, trace_octree_reference])
@pytest.mark.parametrize("deferred", [False, True])
def test_peaks_are_the_largest_weights(trace, deferred: bool) -> None:
    torch.manual_seed(9)
    layout = layout_of(scattered(0.3))
    raw, coefficients = (part.requires_grad_() for part in values(layout, 1))
    rays, background = rays_at(layout, 1000), torch.rand(1000, 3)
    truth, found = torch.zeros(layout.num_leaves), torch.zeros(layout.num_leaves)
    raise_weights_reference(layout, raw.detach(), rays, truth)
    kept = (RowGradient(), RowGradient()) if deferred else None
    trace(layout, raw, coefficients, rays, background, deferred=kept, peaks=found).color.square().sum().backward()
    assert float((found - truth).abs().max()) < 1e-4
    assert float(found.max()) > 0.9
    before = found.clone()
    trace(layout, raw - 3, coefficients, rays, background, deferred=kept, peaks=found).color.square().sum().backward()
    assert bool((found >= before).all())


@pytest.mark.parametrize("trace", [trace_octree, trace_octree_reference])
def test_extremes(trace) -> None:
    torch.manual_seed(8)
    cells = torch.tensor([[1, 2, 3], [9, 9, 9], [23, 15, 31], [0, 0, 0]])
    layout = layout_of(cells)
    raw = torch.tensor([[1e4], [-1e4], [80.0], [-80.0]], requires_grad=True)
    coefficients = torch.randn(4, 12)
    rays = rays_at(layout, 200)
    odd = torch.tensor([[math.nan, 0, 0], [math.inf, 0, 0], [1e30, 0, 0], [1e6, 1e6, 1e6]])
    origins = torch.cat([rays.origins, odd, torch.zeros(4, 3)])
    directions = torch.cat([rays.directions, torch.eye(3)[[0, 0, 0, 0]], torch.eye(3)[[0, 1, 2, 0]]])
    directions[-1] = math.nan
    count = len(origins)
    rays = Rays(origins, directions, torch.zeros(count), torch.full((count,), math.inf))
    light = trace(layout, raw, coefficients, rays, torch.rand(count, 3))
    usable = directions.isfinite().all(-1)
    assert light.color[usable].isfinite().all()
    assert light.opacity.isfinite().all()
    assert bool((light.opacity >= 0).all())
    assert float(light.opacity.detach().max()) == 1
    assert not light.opacity[200:204].any()
    light.color[usable].sum().backward()
    assert raw.grad.isfinite().all()


@needs_kernels
def test_compiled_at_extremes_is_the_reference() -> None:
    """Values and gradients of opaque, empty and thin leaves of colours of any size, and of a scene without leaves."""
    torch.manual_seed(11)
    layout = layout_of(scattered(0.3))
    raw, coefficients = values(layout, 1)
    raw[::4], raw[1::4], raw[2::4] = 1e4, -1e4, 80.0
    coefficients[::3] *= 1e4
    rays, background = rays_at(layout, 1000), torch.rand(1000, 3)
    rays, background = (each[rays.directions.abs().amin(-1) > 1e-6] for each in (rays, background))
    nothing = layout_of(torch.zeros(0, 3, dtype=torch.int64))
    for there, given in ((layout, (raw, coefficients)), (nothing, (raw[:0], coefficients[:0]))):
        found = []
        for trace, kind in ((trace_octree, torch.float32), (trace_octree_reference, torch.float64)):
            leaves = [part.to(kind, copy=True).requires_grad_() for part in given]
            cast = rays if kind == torch.float32 else in_float64(rays)
            light = trace(there, *leaves, cast, background.to(kind))
            (light.color.sum() + light.opacity.sum()).backward()
            grads = [torch.zeros_like(part) if part.grad is None else part.grad for part in leaves]
            found.append((light.color, light.opacity, *grads))
        for ours, truth in zip(*found, strict=True):
            assert ours.shape == truth.shape
            assert not ours.numel() or relative_error(ours, truth) < 1e-3


@pytest.mark.parametrize("trace", [trace_octree, trace_octree_reference])
def test_rays_from_where_float32_does_not_tell_cells_apart(trace) -> None:
    """Such a ray could walk in circles; it meets nothing."""
    layout = layout_of(torch.tensor([[5, 6, 7]]))
    direction = torch.tensor([0.0, 0.0, 1.0])
    distances = CELL * torch.tensor([10.0, 2.0**19, 2.0**21, 1e8])
    origins = layout.centers()[0] - distances[:, None] * direction
    rays = Rays(origins, direction.expand(4, 3))
    light = trace(layout, torch.tensor([[1e4]]), torch.zeros(1, 3), rays, torch.zeros(3))
    assert light.opacity.tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize("trace", [trace_octree, trace_octree_reference])
def test_nan_is_shown_by_the_rays_that_meet_it_alone(trace) -> None:
    layout = layout_of(torch.tensor([[1, 2, 3], [9, 9, 9]]))
    origins = layout.centers() - torch.tensor([0.0, 0.0, 3.0])
    rays = Rays(origins, torch.tensor([[0.0, 0, 1]]).repeat(2, 1))
    light = trace(layout, torch.tensor([[math.nan], [1.0]]), torch.ones(2, 3), rays, torch.zeros(2, 3))
    assert light.color.isnan().any(-1).tolist() == [True, False]
    assert light.opacity.isnan().tolist() == [True, False]


@pytest.mark.parametrize("trace", [trace_octree, trace_octree_reference])
def test_empty(trace) -> None:
    nothing = layout_of(torch.zeros(0, 3, dtype=torch.int64))
    rays = rays_at(nothing, 40)
    raw, coefficients, background = torch.zeros(0, 1), torch.zeros(0, 3), torch.rand(40, 3)
    light = trace(nothing, raw, coefficients, rays, background)
    assert torch.equal(light.color, background)
    assert not light.opacity.any()
    assert torch.equal(light.median, rays.fars)
    layout = layout_of(torch.tensor([[1, 2, 3]]))
    none = trace(layout, torch.zeros(1, 1), torch.zeros(1, 3), rays[:0], background[:0])
    assert none.color.shape == (0, 3)


def test_what_is_refused() -> None:
    layout = layout_of(torch.tensor([[1, 2, 3]]))
    rays = rays_at(layout, 4)
    with pytest.raises(ValueError, match="3, 12, 27 or 48"):
        trace_octree(layout, torch.zeros(1, 1), torch.zeros(1, 6), rays, torch.zeros(3))
    with pytest.raises(ValueError, match="1 leaves"):
        trace_octree(layout, torch.zeros(2, 1), torch.zeros(2, 3), rays, torch.zeros(3))
    with pytest.raises(ValueError, match="outside"):
        layout_of(torch.tensor([[0, 16, 0]]))
    with pytest.raises(ValueError, match="bricks"):
        layout_of(torch.zeros(0, 3, dtype=torch.int64), (10**4, 10**4, 1))


@needs_kernels
def test_bad_arguments_never_reach_the_kernel() -> None:
    layout = layout_of(torch.tensor([[1, 2, 3]]))
    rays = rays_at(layout, 4)
    with pytest.raises(ValueError, match="near ends"):
        trace_octree(layout, torch.zeros(1, 1), torch.zeros(1, 3), replace(rays, nears=rays.nears[:3]), torch.zeros(3))
