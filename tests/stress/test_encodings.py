"""Encodings at the far face, with coordinates of any type, at large positions, and given shapes they do not take."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.encoded import EncodedField
from nerfloom.geometry.bounds import contract
from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import composite
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding, frequency_encoding_reference
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.grids.hash_grid import hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.planes import planes, planes_reference
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.intervals import interval_weights, resample
from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf
from nerfloom.kernels.histograms.spacing import from_disparity, to_disparity
from nerfloom.kernels.math import cross_matrix, safe_normalize, truncated_exp
from nerfloom.kernels.networks.mlp import mlp
from tests.kernels.compiled import relative_error
from tests.stress.backends import COMPILED, FEW, backends

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
HASH = HashGridLayout.build(num_levels=3, base_resolution=16, max_resolution=2048, log2_table_size=13)
"""A dense level and two hashed ones."""
PLANES = PlanesLayout.build(((5, 9, 17), (64, 128, 3)))


def hash_table(features: int = 2) -> Tensor:
    return torch.randn(HASH.num_entries, features, generator=torch.Generator().manual_seed(0))


def plane_table(features: int = 4) -> Tensor:
    return torch.rand(PLANES.num_entries, features, generator=torch.Generator().manual_seed(0)) + 0.5


ENCODINGS: dict[str, tuple[Callable[..., Tensor], Callable[..., Tensor], Tensor]] = {
    "hash grid": (lambda x, t: hash_grid(x, t, HASH), lambda x, t: hash_grid_reference(x, t, HASH), hash_table()),
    "planes": (lambda x, t: planes(x, t, PLANES), lambda x, t: planes_reference(x, t, PLANES), plane_table()),
}
"""An encoding of positions in [0, 1]^3, its truth in float64, and a table."""
each_encoding = pytest.mark.parametrize("encoding", ENCODINGS)


# -- positions on faces and of any type ---------------------------------------------------------------------------


@pytest.mark.entry(19)
@backends()
@each_encoding
@FEW
@given(
    positions=st.lists(st.tuples(*[st.sampled_from([0.0, 1e-30, 2.0**-24, 0.3, 1 - 2.0**-24, 1.0])] * 3), max_size=6),
    strided=st.booleans(),
)
def test_positions_on_faces(
    backend: str, encoding: str, positions: list[tuple[float, float, float]], strided: bool
) -> None:
    """x = 1 belongs to the last cell, in value and gradient; no positions, and such that do not stand side by side."""
    encode, reference, table = ENCODINGS[encoding]
    x = torch.tensor(positions).view(-1, 3)
    x = (x.t().contiguous().t() if strided else x).requires_grad_()
    true_x = x.detach().double().requires_grad_()
    found, truth = encode(x, table), reference(true_x, table.double())
    assert relative_error(found, truth) < 1e-4
    factors = torch.linspace(0.5, 2, truth.shape[1], dtype=torch.float64)
    (slope,) = torch.autograd.grad((found * factors.float()).sum(), x)
    (true_slope,) = torch.autograd.grad((truth * factors).sum(), true_x)
    assert relative_error(slope, true_slope) < 1e-3


@pytest.mark.entry(19)
@backends()
@each_encoding
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_coordinates_mean_what_they_say(backend: str, encoding: str, dtype: torch.dtype) -> None:
    """They are widened, not computed with: half precision has one step a cell next to 1 at 2048 cells."""
    encode, _, table = ENCODINGS[encoding]
    torch.manual_seed(0)
    coarse = torch.cat([torch.rand(50, 3), torch.ones(1, 3)]).to(dtype).requires_grad_()
    found = encode(coarse, table * 1e-2)
    assert found.dtype == torch.float32
    assert torch.equal(found, encode(coarse.detach().float(), table * 1e-2))
    (slope,) = torch.autograd.grad(found.sum(), coarse)
    assert slope.dtype == dtype
    assert bool(slope.isfinite().all())


@pytest.mark.entry(19)
@backends()
@pytest.mark.parametrize("unbounded", [False, True])
def test_autocast_does_not_round_coordinates(backend: str, unbounded: bool) -> None:
    field = EncodedField(BOX, HashGrid(3, 2, 16, 2048, 12), width=16, unbounded=unbounded)
    torch.nn.init.normal_(field.encoding.table)
    positions = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.autocast("cpu", torch.bfloat16):
        rounded = field.encode(positions, None)
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, field.encode(positions, None))


@pytest.mark.entry(12, 19)
@backends()
def test_a_nan_position_is_seen_and_leaves_the_next_one_alone(backend: str) -> None:
    found = hash_grid(torch.tensor([[math.nan, 0.5, 0.5], [0.5, 0.5, 0.5]]), hash_table(), HASH)
    assert bool(found[0].isnan().all())
    assert bool(found[1].isfinite().all())


# -- second derivatives -------------------------------------------------------------------------------------------


def colors_of(sigma: Tensor) -> Tensor:
    """Through compositing: densities (N, 1) along one ray."""
    count = len(sigma)
    samples = Samples(torch.arange(float(count)), torch.arange(float(count)) + 1, torch.tensor([0, count]))
    rgb = torch.linspace(0.9, 0.1, 3 * count).view(count, 3)
    return composite(samples, sigma[:, 0], rgb, torch.zeros(1, 3), torch.full((1,), 9.0)).color


TWICE: dict[str, tuple[Callable[[Tensor], Tensor], tuple[int, int]]] = {
    "hash grid": (lambda x: hash_grid(x, hash_table().to(x.dtype), HASH), (4, 3)),
    "planes": (lambda x: planes(x, plane_table().to(x.dtype), PLANES), (4, 3)),
    "frequencies": (lambda x: frequency_encoding(x, 3), (4, 3)),
    "network": (lambda x: mlp([x], [torch.ones(5, 3).to(x.dtype), torch.ones(2, 5).to(x.dtype)]), (4, 3)),
    "contraction": (lambda x: contract_to_unit(x, BOX), (4, 3)),
    "compositing": (colors_of, (4, 1)),
    "interval weights": (lambda x: interval_weights(x, torch.arange(4.0).expand(len(x), 4)), (4, 3)),
}


def slope_of_slope(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The gradient of the sum of the gradient of the sum of squares, of the shape of x, as training has it."""
    x = x.detach().requires_grad_()
    (first,) = torch.autograd.grad(function(x).square().sum(), x, create_graph=True)
    first.sum().backward()
    assert x.grad is not None
    return x.grad


@pytest.mark.entry(19)
@backends()
@pytest.mark.parametrize("name", TWICE)
def test_second_derivatives_are_right_or_refused(backend: str, name: str) -> None:
    """Compiled kernels have first derivatives only, and say so: a loss on normals must not learn from silent zeros."""
    function, shape = TWICE[name]
    x = torch.rand(*shape, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1
    if backend == COMPILED:
        with pytest.raises(RuntimeError, match="differentiate twice"):
            slope_of_slope(function, x)
        return
    truth = slope_of_slope(function, x.double())
    assert bool((truth != 0).any())
    assert relative_error(slope_of_slope(function, x), truth) < 1e-2


# -- frequencies --------------------------------------------------------------------------------------------------


@pytest.mark.entry(20)
@backends()
@FEW
@given(
    values=st.lists(
        st.one_of(st.sampled_from([1000.0, -1000.0, 8.0]), st.floats(-1e5, 1e5, width=32, allow_subnormal=False)),
        max_size=6,
    ),
    include_input=st.booleans(),
)
def test_high_frequencies_of_large_positions(backend: str, values: list[float], include_input: bool) -> None:
    """Angles are 512,000 at x = 1000: 2^k x is exact in float32, and so must be its sine and cosine."""
    x = torch.tensor(values).view(-1, 1).requires_grad_()
    true_x = x.detach().double().requires_grad_()
    found = frequency_encoding(x, 10, include_input)
    truth = frequency_encoding_reference(true_x, 10, include_input)
    assert found.shape == truth.shape
    waves = slice(int(include_input), None)
    assert bool(((found - truth).abs()[:, waves] <= 2e-6).all())
    assert torch.equal(found[:, : int(include_input)], x[:, : int(include_input)])
    factors = torch.linspace(-1, 1, truth.shape[1], dtype=torch.float64)
    (slope,) = torch.autograd.grad((found * factors.float()).sum(), x)
    (true_slope,) = torch.autograd.grad((truth * factors).sum(), true_x)
    assert bool(((slope - true_slope).abs() <= 5e-3).all())  # of up to 2^10


@pytest.mark.entry(20)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_frequencies_of_half_precision_positions(dtype: torch.dtype) -> None:
    x = torch.tensor([[1000.0, -8.0, 0.5]], dtype=dtype)
    truth = frequency_encoding_reference(x.double(), 10)
    assert bool(((frequency_encoding(x, 10).double() - truth).abs() <= 2e-2).all())


# -- shapes -------------------------------------------------------------------------------------------------------

ANY_SHAPE: dict[str, Callable[[Tensor], Tensor]] = {
    "contract": contract,
    "cross matrix": cross_matrix,
    "safe normalize": safe_normalize,
    "truncated exp": truncated_exp,
    "to disparity": to_disparity,
    "from disparity": from_disparity,
}
"""Functions documented to take (..., 3)."""
ROWS: dict[str, Callable[[Tensor], Tensor]] = {
    "hash grid": lambda x: hash_grid(x, hash_table(), HASH),
    "planes": lambda x: planes(x, plane_table(), PLANES),
    "contraction": lambda x: contract_to_unit(x, BOX),
    "spherical harmonics": spherical_harmonics,
    "network": lambda x: mlp([x], [torch.ones(5, 3)]),
    "interval weights": lambda x: interval_weights(x, torch.arange(4.0).expand(*x.shape[:-1], 4)),
    "new intervals": lambda x: resample(
        torch.arange(4.0).expand(*x.shape[:-1], 4), x, torch.full(x.shape[:-1], 0.5), 4, 1.0, 0.01
    ),
    "inverse CDF": lambda x: inverse_cdf(
        torch.arange(4.0).expand(*x.shape[:-1], 4), x, torch.full((*x.shape[:-1], 2), 0.4)
    ),
}
"""Functions documented to take (N, 3)."""


def flattened(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a function to rows, and restore the shape."""
    return function(x.reshape(-1, x.shape[-1])).unflatten(0, x.shape[:-1])


@pytest.mark.entry(12)
@FEW
@given(name=st.sampled_from(list(ANY_SHAPE)), shape=st.lists(st.integers(0, 4), max_size=3))
def test_any_batch_dimensions_are_rows(name: str, shape: list[int]) -> None:
    x = torch.rand(*shape, 3, generator=torch.Generator().manual_seed(0)) * 4 - 1
    found = ANY_SHAPE[name](x)
    torch.testing.assert_close(found, ANY_SHAPE[name](x.reshape(-1, 3)).reshape(found.shape))
    assert found.shape[: len(shape)] == tuple(shape)


@pytest.mark.entry(12)
@backends()
@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("shape", [(2, 4, 3), (3, 3, 3), (4, 1, 3), (0, 2, 3)])
def test_two_batch_dimensions_are_rows_or_refused(backend: str, name: str, shape: tuple[int, ...]) -> None:
    """A function of rows alone refuses more dimensions, or treats them as rows; it never mixes them up."""
    x = torch.rand(*shape, generator=torch.Generator().manual_seed(0))
    try:
        found = ROWS[name](x)
    except (ValueError, RuntimeError, IndexError):
        return
    torch.testing.assert_close(found, flattened(ROWS[name], x))


@pytest.mark.entry(12)
@backends()
def test_two_batch_dimensions_of_frequencies_are_rows_or_refused(backend: str) -> None:
    x = torch.rand(2, 4, 3, generator=torch.Generator().manual_seed(0))
    try:
        found = frequency_encoding(x, 4, include_input=False)
    except (ValueError, RuntimeError, IndexError):
        return
    assert torch.equal(found, flattened(lambda rows: frequency_encoding(rows, 4, include_input=False), x))
