"""Choosing rows: compiled against torch, and its gradient."""

import pytest
import torch

from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics, spherical_harmonics_reference
from nerfloom.kernels.rows import gather_rows, take_rows
from tests.kernels.compiled import needs_kernels, relative_error


@pytest.mark.parametrize("lengths", [(7,), (3, 0, 5, 1), (0,)])
def test_rows_of_parts(lengths: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    columns = [
        [torch.rand(n) for n in lengths],
        [torch.randint(9, (n,)) for n in lengths],
        [torch.rand(n, 33) for n in lengths],
        [torch.rand(5, n).t() for n in lengths],  # not contiguous
    ]
    order = torch.randperm(sum(lengths))[: sum(lengths) // 2]
    for column, found in zip(columns, gather_rows(columns, order), strict=True):
        assert torch.equal(found, torch.cat(column)[order])


def test_the_gradient_of_taken_rows() -> None:
    values = torch.rand(10, 4, dtype=torch.float64, requires_grad=True)
    rows = torch.tensor([3, 9, 0])
    assert torch.equal(take_rows(values, rows), values[rows])
    assert torch.autograd.gradcheck(lambda v: take_rows(v, rows), values)
    assert take_rows(values, rows[:0]).shape == (0, 4)


@needs_kernels
@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_compiled_spherical_harmonics(levels: int) -> None:
    directions = torch.nn.functional.normalize(torch.randn(5000, 3), dim=-1)
    weights = torch.randn(5000, levels**2, dtype=torch.float64)
    found = []
    for form, given in ((spherical_harmonics, directions), (spherical_harmonics_reference, directions.double())):
        leaf = given.clone().requires_grad_()
        out = form(leaf, levels)
        by_directions = torch.autograd.grad((out * weights).sum(), leaf) if levels > 1 else ()
        found.append((out, *by_directions))
    for value, truth in zip(*found, strict=True):
        assert relative_error(value, truth) < 1e-6
    assert spherical_harmonics(directions[:0], levels).shape == (0, levels**2)
