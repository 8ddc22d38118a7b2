"""Light through octrees: values and gradients of leaves, of one grid and of grids around one another."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import CODES, PackedLeaves, trace_packed
from nerfloom.kernels.octree.trace import trace_octree, trace_octree_reference
from nerfloom.kernels.octree.weights import raise_weights
from tests.kernels.test_octree import CELL, layout_of, scattered, values
from tests.kernels.test_octree_levels import nested
from tests.kernels.triton.compared import DEVICE, backends, compare

TOLERANCE = 5e-4
"""Largest relative error. Rounding may cut off a corner of a leaf, as in the compiled kernel."""
LAYOUTS = {"one": lambda: layout_of(scattered(0.3)), "three": nested}


def some_rays(count: int) -> dict[str, Tensor]:
    """Rays from inside and outside."""
    targets = torch.rand(count, 3) - 0.5
    origins = targets + torch.randn(count, 3) * torch.rand(count, 1) * 3
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return {"origins": origins, "directions": directions, "nears": torch.rand(count) / 2, "fars": 3 + torch.rand(count)}


@pytest.mark.parametrize(
    ("grids", "degree", "stop"),
    [("one", 0, 0.0), ("three", 1, 0.0), pytest.param("one", 3, 0.02, marks=pytest.mark.slow)],
)
def test_learnt_leaves(grids: str, degree: int, stop: float) -> None:
    torch.manual_seed(degree)
    layout = LAYOUTS[grids]()
    count = layout.num_leaves
    given = {"raw": torch.randn(count, 1), "coefficients": torch.randn(count, 3 * (degree + 1) ** 2), **some_rays(40)}

    def light(raw: Tensor, coefficients: Tensor, background: Tensor, **rays: Tensor) -> tuple[Tensor, ...]:
        found = trace_octree(layout.to(raw.device), raw, coefficients, Rays(**rays), background, stop)
        return found.color, found.opacity, found.moment

    # Rounding may end a ray one leaf earlier or later if there is a stop.
    tolerance = 3e-3 if stop else TOLERANCE
    compare(light, {**given, "background": torch.rand(40, 3)}, "raw coefficients", tolerance)


@pytest.mark.parametrize(("grids", "width"), [("one", 0.0), ("three", 0.1)])
def test_leaves_of_bytes(grids: str, width: float) -> None:
    torch.manual_seed(3)
    layout = LAYOUTS[grids]()
    count, levels = layout.num_leaves, len(layout.levels)
    codes, colors = (torch.randint(CODES, shape, dtype=torch.uint8) for shape in ((count,), (count, 27)))
    table = torch.linspace(0, 2, CODES * levels)
    leaves, found = PackedLeaves(codes, table, colors, torch.rand(27) / 255, torch.rand(27) - 0.5), []

    def light(background: Tensor, radii: Tensor, **rays: Tensor) -> tuple[Tensor, ...]:
        there = layout.to(radii.device), leaves.to(radii.device)
        found.append(trace_packed(*there, Rays(**rays, pixel_radii=radii), background))
        return found[-1].color, found[-1].opacity, found[-1].moment

    compare(light, {**some_rays(40), "background": torch.rand(40, 3), "radii": width * torch.rand(40)}, "", TOLERANCE)
    one, two = (each.median.double().cpu() for each in found)
    assert ((one - two).abs() > 0.01).sum() <= 1  # a transmittance of 0.5 between two leaves
    # With several grids, rays also meet leaves over lengths of rounding, at the borders of grids.
    apart = (found[0].visits.cpu().long() - found[1].visits.cpu().long()).abs()
    assert (apart > 0).sum() <= (1 if levels == 1 else 8)
    assert apart.max() <= 2


def test_weights_and_peaks() -> None:
    torch.manual_seed(4)
    layout = nested()
    raw, count = torch.randn(layout.num_leaves, 1), layout.num_leaves

    def largest(raw: Tensor, **rays: Tensor) -> tuple[Tensor, ...]:
        weights = torch.zeros_like(raw[:, 0])
        return raise_weights(layout.to(raw.device), raw, Rays(**rays), weights, 0.01), weights

    given = some_rays(40)
    _, weights = compare(largest, {"raw": raw, **given}, "", 3e-3)
    peaks, black = torch.zeros(count, device=DEVICE), torch.zeros(3, device=DEVICE)
    rays = Rays(**{name: values.to(DEVICE) for name, values in given.items()})
    with backends() as names:
        trace_octree(
            layout.to(DEVICE), raw.to(DEVICE), torch.zeros(count, 3, device=DEVICE), rays, black, 0.01, None, peaks
        )
    assert names == ["triton"]
    torch.testing.assert_close(peaks, weights)


@pytest.mark.slow
def test_opaque_empty_and_bright_leaves() -> None:
    """Optical depths from 0 to 10,000, and colours far above 1."""
    torch.manual_seed(11)
    layout = layout_of(scattered(0.3))
    raw, coefficients = values(layout, 1)
    raw[::4], raw[1::4], raw[2::4] = 1e4, -1e4, 80.0
    coefficients[::3] *= 1e4

    def light(raw: Tensor, coefficients: Tensor, background: Tensor, **rays: Tensor) -> tuple[Tensor, ...]:
        found = trace_octree(layout.to(raw.device), raw, coefficients, Rays(**rays), background)
        return found.color, found.opacity

    given = {"raw": raw, "coefficients": coefficients, **some_rays(40)}
    compare(light, {**given, "background": torch.rand(40, 3)}, "raw coefficients", 1e-3)


def test_rays_that_meet_nothing() -> None:
    """Rays past the box, from too far away, without a number, and no rays; an octree without leaves."""
    layout = layout_of(torch.tensor([[1, 2, 3], [9, 9, 9]])).to(DEVICE)
    raw, colors = torch.full((2, 1), 1e4, device=DEVICE), torch.ones(2, 3, device=DEVICE)
    center = layout.centers()[0]
    up = torch.tensor([0.0, 0.0, 1.0], device=DEVICE)
    distances = CELL * torch.tensor([10.0, 2.0**21, math.nan, math.inf], device=DEVICE)
    past = center + torch.tensor([9.0, 0.0, 0.0], device=DEVICE)
    origins = torch.cat([center - distances[:, None] * up, past[None]])
    rays = Rays(origins, up.expand(5, 3))
    black = torch.zeros(3, device=DEVICE)
    found = trace_octree(layout, raw, colors, rays, black)
    assert found.opacity.tolist() == [1, 0, 0, 0, 0]
    assert found.visits.tolist() == [1, 0, 0, 0, 0]
    assert trace_octree(layout, raw, colors, rays[:0], black).color.shape == (0, 3)
    nothing = layout_of(torch.zeros(0, 3, dtype=torch.int64)).to(DEVICE)
    empty = torch.zeros(0, 1, device=DEVICE), torch.zeros(0, 3, device=DEVICE)
    assert not trace_octree(nothing, *empty, rays[:1], black).opacity.any()


def test_every_bit_of_an_octant_counts() -> None:
    """Full octants: leaves are numbered by the bits before theirs, up to the sign bit."""
    cells = torch.cartesian_prod(*[torch.arange(8)] * 3)
    layout, _ = OctreeLayout.build(torch.zeros(3), 1.0, (1, 1, 1), cells)
    order = layout.cells()
    colors = torch.arange(512.0)[:, None].expand(-1, 3)
    columns = torch.cartesian_prod(torch.arange(8), torch.arange(8)) + 0.5
    origins = torch.cat([columns, torch.full((64, 1), -1.0)], 1)
    rays = Rays(origins, torch.tensor([0.0, 0.0, 1.0]).expand(64, 3))
    there = Rays(rays.origins.to(DEVICE), rays.directions.to(DEVICE).contiguous())
    arguments = torch.full((512, 1), -1.0), colors.contiguous()
    found = trace_octree(
        layout.to(DEVICE), *(each.to(DEVICE) for each in arguments), there, torch.zeros(3, device=DEVICE)
    )
    truth = trace_octree_reference(layout, *(each.double() for each in arguments), Rays(
        rays.origins.double(), rays.directions.double()), torch.zeros(64, 3).double())  # fmt: skip
    assert len(order) == 512
    assert found.visits.tolist() == [8] * 64
    torch.testing.assert_close(found.color.cpu().double(), truth.color, rtol=1e-5, atol=1e-3)
