"""Total variation of bands of planes: compiled against float64, in value and gradient, for any sides and threads."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.kernels.grids.plane_bands import Band, band_variation
from nerfloom.kernels.grids.planes import PlanesGradient
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from tests.kernels.compiled import needs_kernels, relative_error

pytestmark = needs_kernels


def derived(table: Tensor, layout: PlanesLayout, bands: list[Band], weight: Tensor) -> tuple[Tensor, Tensor]:
    """Value, and the gradient that waits."""
    leaf, deferred = table.clone().requires_grad_(), PlanesGradient(layout)
    value = band_variation(leaf, layout, bands, deferred)
    (value * weight).sum().backward()
    assert leaf.grad is None
    assert len(deferred.variations) == 1
    return value.detach(), deferred.summed(leaf.detach())


def truth(table: Tensor, layout: PlanesLayout, bands: list[Band], weight: Tensor) -> tuple[Tensor, Tensor]:
    """The same in float64, difference by difference."""
    leaf, values = table.double().requires_grad_(), []
    for group, index, first, rows in bands:
        band = layout.factor(leaf, group, index)[first : first + rows]
        value = leaf.new_zeros(())
        if band.shape[1] > 1:
            value = value + (band[:, 1:] - band[:, :-1]).square().mean()
        if rows > 1:
            value = value + (band[1:] - band[:-1]).square().mean()
        values.append(value)
    found = torch.stack(values)
    (found * weight.double()).sum().backward()
    assert leaf.grad is not None
    return found.detach(), leaf.grad


@settings(max_examples=60)
@given(
    sides=st.tuples(*[st.integers(2, 40)] * 3),
    features=st.sampled_from([1, 2, 3, 4, 16, 32]),
    seed=st.integers(0, 2**31),
)
def test_value_and_gradient_are_those_of_float64(sides: tuple[int, int, int], features: int, seed: int) -> None:
    torch.manual_seed(seed)
    axes = (((0, 1), (1, 2), (2,)), ((0, 2), (1, 2), (0,)))
    layout = PlanesLayout.build((sides, sides[::-1]), axes)
    bands: list[Band] = []
    for group, factors in enumerate(axes):
        for index in range(len(factors)):
            height = layout.shape(group, index)[0]
            first = int(torch.randint(height, ()))
            bands.append((group, index, first, 1 + int(torch.randint(height - first, ()))))
    table, weight = torch.randn(layout.num_entries, features), torch.randn(len(bands))
    for mine, exact in zip(derived(table, layout, bands, weight), truth(table, layout, bands, weight), strict=True):
        assert relative_error(mine, exact) < 2e-6


def test_overlapping_bands_add_up_and_what_is_outside_of_all_stays() -> None:
    layout = PlanesLayout.build(((5, 9, 7),))
    table, weight = torch.randn(layout.num_entries, 8), torch.tensor([1.0, -2.0])
    bands = [(0, 0, 1, 4), (0, 0, 3, 4)]
    value, slope = derived(table, layout, bands, weight)
    expected = truth(table, layout, bands, weight)
    assert relative_error(value, expected[0]) < 2e-6
    assert relative_error(slope, expected[1]) < 2e-6
    across = layout.shape(0, 0)[1]
    assert not slope[:across].any()
    assert not slope[7 * across :].any()


def test_any_number_of_threads_gives_the_same_bits() -> None:
    layout = PlanesLayout.build(((65, 130, 33), (128, 9, 64)))
    table, bands = torch.randn(layout.num_entries, 32), [(group, index, 0, 9) for group in (0, 1) for index in range(3)]
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(derived(table, layout, bands, torch.rand(6, generator=torch.Generator().manual_seed(0))))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_no_bands_and_values_that_are_not_numbers() -> None:
    layout = PlanesLayout.build(((4, 5, 6),))
    table = torch.zeros(layout.num_entries, 4)
    value, slope = derived(table, layout, [], torch.zeros(0))
    assert value.shape == (0,)
    assert not slope.any()
    layout.factor(table, 0, 0)[2, 1, 3] = float("nan")
    value, _ = derived(table, layout, [(0, 0, 0, 2), (0, 0, 2, 2)], torch.ones(2))
    assert value[0] == 0
    assert value[1].isnan()


@pytest.mark.parametrize("asked", ["table", "other"])
def test_it_waits_only_when_the_table_is_asked_for(asked: str) -> None:
    layout = PlanesLayout.build(((4, 5, 6),))
    table, weight = torch.rand(layout.num_entries, 4, requires_grad=True), torch.ones((), requires_grad=True)
    deferred = PlanesGradient(layout)
    loss = (band_variation(table, layout, [(0, 0, 0, 3)], deferred) * weight).sum()
    loss.backward(inputs=[table if asked == "table" else weight])
    assert deferred.pending == (asked == "table")
