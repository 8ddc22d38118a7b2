"""Contraction, boxes, directions: at zero, at infinity, on edges."""

import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.data.light_spread import QUANTILES, light_of
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.evaluation.images import to_uint8
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.normals import NormalHead, density_normals
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.color import to_linear, to_srgb
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.histograms.spacing import from_disparity, to_disparity
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import CompiledMarch
from nerfloom.kernels.math import safe_normalize
from tests.stress.backends import COMPILED, FEW, backends

CUBE = torch.tensor([[-1.0] * 3, [1.0] * 3])
WIDE = torch.tensor([[-2.0] * 3, [2.0] * 3])
"""A box with a half edge of 2."""
AXES = st.tuples(*[st.sampled_from([-1.0, -0.3, 0.0, 0.02, 1.0])] * 3)
SOURCES = [file for name in ("framework", "methods") for file in (Path(__file__).parents[2] / name).rglob("*.py")]


def mentioned(pattern: str) -> list[str]:
    """Files of the framework and its methods that contain a pattern."""
    return [file.name for file in SOURCES if re.search(pattern, file.read_text(encoding="utf-8"), re.IGNORECASE)]


def unit(axes: tuple[float, ...]) -> list[float]:
    """A direction, or zero, as it is in float64."""
    length = math.hypot(*axes)
    return [x / length if length else 0.0 for x in axes]


# -- contraction --------------------------------------------------------------------------------------------------


def contracted_by_hand(positions: Tensor, incoming: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Value and gradient (N, 3) of contraction around `WIDE`, float64, and the largest possible gradient (N, 1).

    With n = |x| > 1 and y = x s(n), s(n) = 2 / n - 1 / n^2: J^T g = s g + x (x . g) s'(n) / n.
    """
    x = positions.double() / 2
    n = x.norm(dim=-1, keepdim=True)
    outside = n > 1
    n = n.clamp(min=1)
    scale = torch.where(outside, 2 / n - 1 / n**2, 1.0)
    along = torch.where(outside, (x * incoming).sum(-1, keepdim=True) * (2 / n**3 - 2 / n**2) / n, 0.0)
    return x * scale / 4 + 0.5, (scale * incoming + x * along) / 8, scale / 8


@pytest.mark.entry(9)
@backends()
@FEW
@given(points=st.lists(st.tuples(AXES, st.floats(-30, 12)), max_size=6), strided=st.booleans())
def test_contraction_from_next_to_nothing_to_far_away(
    backend: str, points: list[tuple[tuple[float, ...], float]], strided: bool
) -> None:
    rows = [[x * 10.0**exponent for x in unit(axes)] for axes, exponent in points]
    positions = torch.tensor(rows, dtype=torch.float64).view(-1, 3).float()
    positions = (positions.t().contiguous().t() if strided else positions).requires_grad_()
    incoming = torch.tensor([[1.0, -0.5, 0.25]], dtype=torch.float64).expand(len(rows), 3)
    value, slope, largest = contracted_by_hand(positions.detach(), incoming)
    found = contract_to_unit(positions, WIDE)
    (found_slope,) = torch.autograd.grad((found * incoming.float()).sum(), positions)
    assert bool(((found.double() - value).abs() <= 1e-6).all())
    assert bool(((found_slope.double() - slope).abs() <= 1e-5 * largest).all())


@pytest.mark.entry(9)
@backends()
@FEW
@given(axes=AXES.filter(any), exponent=st.one_of(st.floats(12, 38), st.just(math.inf)))
def test_contraction_of_what_is_beyond_all_measure(backend: str, axes: tuple[float, ...], exponent: float) -> None:
    """It goes to the sphere of radius 2, and its gradient, which is next to nothing, is finite."""
    position = torch.tensor([[x * 10.0**exponent if x else 0.0 for x in unit(axes)]], requires_grad=True)
    found = contract_to_unit(position, WIDE)
    (slope,) = torch.autograd.grad(found.sum(), position)
    assert ((found - 0.5) * 4).norm().item() == pytest.approx(2, abs=1e-5)
    assert bool((slope.abs() <= 1e-9).all())


@pytest.mark.entry(9)
@backends()
def test_contraction_keeps_the_direction_of_what_is_beyond_all_measure(backend: str) -> None:
    position = torch.tensor([[2e25, 2e24, -2e23]])
    expected = 2 * position.double() / position.double().norm()
    torch.testing.assert_close((contract_to_unit(position, WIDE).double() - 0.5) * 4, expected, rtol=0, atol=1e-3)


@pytest.mark.entry(9)
@backends()
def test_contraction_has_no_slope_along_a_ray_far_away(backend: str) -> None:
    """1 / n^2 along the ray is nothing beside 2 / n across it."""
    position = torch.tensor([[2e16, 0.0, 0.0]], requires_grad=True)
    (slope,) = torch.autograd.grad(contract_to_unit(position, WIDE)[0, 0], position)
    across = 2 / 1e16 / 8
    assert abs(slope[0, 0].item()) < 1e-3 * across


# -- functions in pieces ------------------------------------------------------------------------------------------


@pytest.mark.entry(8, 14, 15)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_disparity_has_a_slope_everywhere(dtype: torch.dtype) -> None:
    """Neither side of torch.where may be NaN: at 0, where the pieces meet, and at infinity."""
    t = torch.tensor([0.0, 1e-30, 0.5, 1.0, 3.0, 1e10, 1e30, math.inf], dtype=dtype, requires_grad=True)
    s = to_disparity(t)
    (slope,) = torch.autograd.grad(s.sum(), t)
    assert s.tolist() == pytest.approx([0, 5e-31, 0.25, 0.5, 5 / 6, 1, 1, 1], rel=1e-6, abs=0)
    assert slope.tolist() == pytest.approx([0.5, 0.5, 0.5, 0.5, 1 / 18, 0.5e-20, 0.5e-60, 0], rel=1e-6, abs=1e-37)


@pytest.mark.entry(8, 14, 15)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distance_has_a_slope_everywhere(dtype: torch.dtype) -> None:
    """Both value and slope are finite at s = 1, which is infinitely far away."""
    s = torch.tensor([0.0, 0.25, 0.5, 0.75, 1 - 2.0**-20, 1.0], dtype=dtype, requires_grad=True)
    t = from_disparity(s)
    (slope,) = torch.autograd.grad(t.sum(), s)
    assert t.tolist()[:5] == pytest.approx([0, 0.5, 1, 2, 2.0**19], rel=1e-6)
    assert slope.tolist()[:5] == pytest.approx([2, 2, 2, 8, 2.0**39], rel=1e-6)
    assert 2.0**19 < t[5].item() < math.inf
    assert math.isfinite(slope[5].item())


@pytest.mark.entry(15)
def test_srgb_curves_have_a_slope_and_a_value_at_black() -> None:
    """Colours are as stored; numpy has a curve for the light of photographs, without a gradient."""
    assert mentioned(r"\*\* *2\.4\b") == ["color.py", "light_spread.py"]
    for curve, linear in ((to_srgb, 12.92), (to_linear, 1 / 12.92)):
        x = torch.tensor([0.0, 1e-30, 1e-4, 0.5, 1.0], requires_grad=True)
        (slope,) = torch.autograd.grad(curve(x).sum(), x)
        assert slope.tolist()[:3] == pytest.approx([linear] * 3, rel=1e-6)
        assert bool(slope.isfinite().all())
        assert curve(x)[0] == 0
    black = light_of(np.zeros((16, 16, 3), np.uint8))
    assert black.tolist() == [[-9.0] * len(QUANTILES), [0.0] * len(QUANTILES), [0.0] * len(QUANTILES)]


# -- boxes --------------------------------------------------------------------------------------------------------


def crossings(backend: str, origins: Tensor, directions: Tensor) -> list[tuple[float, float] | None]:
    """Where rays enter and leave `CUBE`; None for rays that miss it."""
    count = len(origins)
    if backend == COMPILED:
        rays = Rays(origins, directions, torch.zeros(count), torch.full((count,), torch.inf))
        march = CompiledMarch(rays, Occupancy(torch.ones(8, dtype=torch.bool), CUBE, 2), 0.1, 0.0, None, 0.0)
        enter, leave, hits = march.enter, march.leave, set(march.alive.tolist())
    else:
        enter, leave = intersect_box(origins, directions, CUBE)
        hits = set((leave > enter).nonzero().flatten().tolist())
        missed = torch.tensor([index not in hits for index in range(count)], dtype=torch.bool)
        assert not torch.stack([enter, leave])[:, missed].any()  # an interval of no length, at 0
    pairs = zip(enter.tolist(), leave.tolist(), strict=True)
    return [pair if index in hits else None for index, pair in enumerate(pairs)]


def exact_crossing(origin: list[float], direction: list[float]) -> tuple[float, float] | None:
    """The same in fractions."""
    enter, leave = Fraction(0), Fraction(10**60)
    for o, d in zip(map(Fraction, origin), map(Fraction, direction), strict=True):
        if d == 0:
            if abs(o) > 1:
                return None
            continue
        one, two = sorted([(-1 - o) / d, (1 - o) / d])
        enter, leave = max(enter, one), min(leave, two)
    return (float(enter), float(leave)) if leave > enter else None


def assert_crossings(backend: str, rays: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> None:
    """Check crossings against exact ones; a ray that only grazes the box may hit or miss."""
    origins, directions = (torch.tensor([ray[i] for ray in rays]).view(-1, 3) for i in (0, 1))
    found = crossings(backend, origins, directions)
    for origin, direction, pair in zip(origins.tolist(), directions.tolist(), found, strict=True):
        truth = exact_crossing(origin, direction)
        grazing = [ends for ends in (truth, pair) if ends and ends[1] - ends[0] <= 1e-5 * (1 + ends[0])]
        if truth is None or pair is None:
            assert truth is pair or grazing, (origin, direction, truth, pair)
        else:
            assert pair == pytest.approx(truth, rel=2e-6, abs=1e-6), (origin, direction)


@pytest.mark.entry(16)
@backends()
def test_special_rays_and_a_box(backend: str) -> None:
    assert_crossings(
        backend,
        [
            ((-3, 0, 0), (1, 0, 0)),  # parallel to four faces, through the middle
            ((-3, 1, 0), (1, 0, 0)),  # in a face
            ((-3, 1, 1), (1, 0, 0)),  # along an edge
            ((-3, 1 + 2**-20, 0), (1, 0, 0)),  # beside a face
            ((-3, 2, 0), (1, -0.0, 0)),  # parallel, outside
            ((0, 0, 0), (0, 0, -1)),  # from inside
            ((0, 0, 0), (1, 1, 1)),  # from the middle to a corner
            ((1, 0, 0), (1, 0, 0)),  # on the face it leaves by
            ((-1, 0, 0), (1, 0, 0)),  # on the face it enters by
            ((1, 0, 0), (0, 1, 0)),  # in the face it starts on
            ((1, 0, 0), (-1e-6, 1, 0)),  # leaving a face next to parallel, inwards
            ((1, 0, 0), (1e-6, 1, 0)),  # and outwards
            ((0, 0, 0), (1, -1e-6, 0)),
            ((-3, 0.5, 0.5), (1, 1e-45, -1e-45)),  # the smallest number above 0
            ((1, 1, 1), (-1, -1, -1)),  # from a corner inwards
            ((1, 1, 1), (1, 1, 1)),  # and outwards
            ((-2, -2, -2), (1, 1, 1)),  # through two corners
            ((3, -1, 0), (-1, 1, 0)),  # touches an edge
            ((3, 0, 0), (1, 0, 0)),  # behind
            ((5, 5, 5), (1, 0, 0)),  # misses
        ],
    )


@pytest.mark.entry(16)
@backends()
@FEW
@given(
    rays=st.lists(
        st.tuples(
            st.tuples(*[st.sampled_from([-3.0, -1.0, -1 - 2.0**-20, -0.25, 0.0, 1.0, 1 + 2.0**-20, 7.0])] * 3),
            st.tuples(*[st.sampled_from([-1.0, -0.3, -1e-6, -0.0, 0.0, 1e-30, 1e-6, 1.0])] * 3).filter(
                lambda d: max(map(abs, d)) > 0.1
            ),
        ),
        max_size=20,
    )
)
def test_any_rays_and_a_box(backend: str, rays: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> None:
    assert_crossings(backend, rays)


# -- directions ---------------------------------------------------------------------------------------------------


@pytest.mark.entry(17)
@FEW
@given(axes=AXES.filter(any), exponent=st.floats(-11, 18))
def test_directions_are_of_length_one(axes: tuple[float, ...], exponent: float) -> None:
    """Their gradient is the part across them, over the length: J^T g = (g - n (n . g)) / |v|."""
    length = 10.0**exponent
    v = torch.tensor([[x * length for x in unit(axes)]], requires_grad=True)
    found = safe_normalize(v)
    incoming = torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64)
    (slope,) = torch.autograd.grad((found * incoming.float()).sum(), v)
    n = torch.tensor([unit(axes)], dtype=torch.float64)
    torch.testing.assert_close(found.double(), n, rtol=0, atol=1e-6)
    across = incoming - n * (n * incoming).sum()
    torch.testing.assert_close(slope.double() * length, across, rtol=0, atol=1e-4)
    assert found.abs().max().item() <= 1 + 1e-6


@pytest.mark.entry(17)
@pytest.mark.parametrize("length", [0.0, 1e-45, 1e-30, 1e-13])
def test_what_has_no_direction_becomes_zero_with_a_zero_gradient(length: float) -> None:
    v = torch.tensor([[length, 0.0, -length]], requires_grad=True)
    found = safe_normalize(v)
    (slope,) = torch.autograd.grad((found * torch.tensor([1.0, 2.0, 3.0])).sum(), v)
    assert found.tolist() == slope.tolist() == [[0, 0, 0]]


@pytest.mark.entry(17)
def test_the_direction_of_a_very_long_vector() -> None:
    assert safe_normalize(torch.tensor([[3e25, 0.0, -4e25]])).tolist() == [pytest.approx([0.6, 0.0, -0.8])]


@pytest.mark.entry(17)
@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_the_direction_of_what_is_not_finite_is_seen(broken: float) -> None:
    assert bool(safe_normalize(torch.tensor([[broken, 0.0, 1.0]])).isnan().all())


@pytest.mark.entry(17)
@backends()
def test_a_density_that_is_the_same_everywhere_has_no_normals(backend: str) -> None:
    field = EncodedField(CUBE, HashGrid(2, 2, 4, 8, 8), width=16)
    with torch.no_grad():
        field.encoding.table.zero_()
    found = density_normals(field, Points(torch.rand(5, 3) * 2 - 1))
    assert found.shape == (5, 3)
    assert not found.any()


@pytest.mark.entry(17)
@backends()
def test_a_head_that_says_nothing_has_no_normals_and_can_learn(backend: str) -> None:
    head = NormalHead(4, 16)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    found = head(torch.rand(5, 4), torch.rand(5, 3))
    (found * torch.tensor([1.0, 2.0, 3.0])).sum().backward()
    assert not found.any()
    for parameter in head.parameters():
        assert parameter.grad is not None
        assert not parameter.grad.isnan().any()


@pytest.mark.entry(17)
def test_normals_fill_the_range_of_a_picture() -> None:
    """-1, 0 and 1 as a picture stores them; rounding just beyond 1 does not wrap around."""
    normals = torch.tensor([[[-1.0, 0.0, 1.0], [-1 - 1e-6, 1e-9, 1 + 1e-6]]])
    assert to_uint8((normals + 1) / 2).tolist() == [[[0, 128, 255]] * 2]
