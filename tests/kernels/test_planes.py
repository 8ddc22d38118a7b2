"""Feature planes against torch's grid_sample, float64 and finite differences."""

import pytest
import torch
from torch.nn.functional import grid_sample

from nerfloom.kernels.grids.planes import planes, planes_reference
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from tests.kernels.compiled import needs_kernels, relative_error

STILL = PlanesLayout.build(((8, 9, 10), (16, 5, 32)))
MOVING = PlanesLayout.build(((8, 9, 10, 4), (16, 18, 20, 4)))
VM = PlanesLayout.build(((8, 9, 10),) * 3, (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,))))
CP = PlanesLayout.build(((8, 9, 10),), (((0,), (1,), (2,)),))
LAYOUTS = {"k-planes": STILL, "k-planes with time": MOVING, "vm": VM, "cp": CP}


def inputs(layout: PlanesLayout, features: int, count: int = 301) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions, some on edges and some outside, and a table away from zero."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(count, layout.dims, generator=generator) * 1.2 - 0.1
    positions[: min(count, 4)] = torch.tensor([0.0, 1.0, 0.5, 1.0])[: min(count, 4), None]
    return positions, torch.rand(layout.num_entries, features, generator=generator) + 0.5


def sampled(positions: torch.Tensor, table: torch.Tensor, layout: PlanesLayout) -> torch.Tensor:
    """The same by grid_sample, plane by plane."""
    scales = []
    for group, factors in enumerate(layout.axes):
        product = torch.ones((), dtype=table.dtype)
        for index, axes in enumerate(factors):
            plane = layout.factor(table, group, index).permute(2, 0, 1)[None]
            where = positions[None, None, :, list(axes)] * 2 - 1
            if len(axes) == 1:  # a line is a plane of one row
                where = torch.cat([where, torch.zeros_like(where)], dim=-1)
            product = product * grid_sample(plane, where, align_corners=True, padding_mode="border")[0, :, 0].t()
        scales.append(product)
    return torch.cat(scales, dim=-1)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_the_reference_is_what_grid_sample_finds(layout: PlanesLayout) -> None:
    positions, table = (x.double() for x in inputs(layout, 3))
    assert relative_error(planes_reference(positions, table, layout), sampled(positions, table, layout)) < 1e-14


@needs_kernels
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())
@pytest.mark.parametrize("features", [1, 3, 4, 8, 16, 32])
def test_compiled_value_and_gradients(layout: PlanesLayout, features: int) -> None:
    positions, table = inputs(layout, features)
    found = [x.clone().requires_grad_() for x in (positions, table)]
    truth = [x.double().requires_grad_() for x in (positions, table)]
    value, expected = planes(*found, layout), planes_reference(*truth, layout)
    assert relative_error(value, expected) < 1e-5
    weight = torch.randn_like(expected)
    value.backward(weight.float())
    expected.backward(weight)
    for mine, theirs in zip(found, truth, strict=True):
        assert mine.grad is not None
        assert theirs.grad is not None
        assert relative_error(mine.grad[4:], theirs.grad[4:]) < 1e-5  # on a vertex either side's slope is right
    assert found[1].grad is not None
    assert truth[1].grad is not None
    assert relative_error(found[1].grad, truth[1].grad) < 1e-5


@pytest.mark.medium
def test_gradcheck_of_the_reference() -> None:
    layout = PlanesLayout.build(((3, 4, 5), (5, 6, 7)))
    positions, table = inputs(layout, 2, count=9)
    positions = positions[4:].clamp(0.05, 0.95).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, t: planes_reference(x, t, layout), (positions, table.double().requires_grad_())
    )


@needs_kernels
def test_compiled_derivatives_are_those_of_the_compiled_value() -> None:
    """Finite differences in float32: bilinear, so exact in each table entry and nearly so along each axis."""
    layout = PlanesLayout.build(((3, 4, 5),))
    positions, table = inputs(layout, 4, count=6)
    positions = positions[4:].clamp(0.05, 0.95).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: planes(x, table, layout).double(), positions, eps=1e-3, atol=2e-2, rtol=1e-2, nondet_tol=0
    )
    assert torch.autograd.gradcheck(
        lambda t: planes(positions.detach(), t, layout).double(), table.requires_grad_(), eps=1e-2, atol=2e-3
    )


@needs_kernels
@pytest.mark.parametrize("features", [4, 32])
def test_threads_give_the_same_bits_and_empty_input_is_harmless(features: int) -> None:
    positions, table = inputs(MOVING, features, count=2000)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            x, t = positions.clone().requires_grad_(), table.clone().requires_grad_()
            value = planes(x, t, MOVING)
            value.square().sum().backward()
            results.append((value.detach(), x.grad, t.grad))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    nothing = planes(positions[:0], table.requires_grad_(), MOVING)
    nothing.sum().backward()
    assert nothing.shape == (0, 2 * features)
    assert not table.grad.any()


def test_nan_positions_are_seen() -> None:
    positions, table = inputs(STILL, 16)
    positions[7, 1] = float("nan")
    found = planes(positions, table, STILL)
    assert bool(found[7].isnan().any())
    assert not bool(found[8].isnan().any())


@pytest.mark.parametrize("resolutions", [((1, 4, 4),), ((4, 4, 4), (4, 4)), ((4,),)])
def test_layouts_that_cannot_be_are_refused(resolutions: tuple[tuple[int, ...], ...]) -> None:
    with pytest.raises(ValueError, match="planes need"):
        PlanesLayout.build(resolutions)


def test_wrong_shapes_are_named() -> None:
    positions, table = inputs(STILL, 4)
    with pytest.raises(ValueError, match=r"positions have shape \(301, 2\), not \(N, 3\)"):
        planes(positions[:, :2], table, STILL)
    with pytest.raises(ValueError, match="the table has shape"):
        planes(positions, table[1:], STILL)
