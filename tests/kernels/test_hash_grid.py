"""The hash grid: fast path against reference, and both against the paper's words."""

import pytest
import torch

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.kernels.grids.hash_grid import PRIMES, corners, hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout

MIXED = HashGridLayout.build(num_levels=4, base_resolution=4, max_resolution=40, log2_table_size=9)


def test_the_mixed_layout_has_dense_and_hashed_levels() -> None:
    assert [MIXED.is_dense(level) for level in range(4)] == [True, False, False, False]
    assert MIXED.resolutions[0] == 4
    assert MIXED.resolutions[-1] == 40


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_and_gradients_equal_the_reference(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    positions = torch.cat([torch.rand(2000, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [-1, 2, 0.3]])])
    table = torch.randn(MIXED.num_entries, 2, dtype=torch.float64)
    direction = torch.randn(len(positions), 8, dtype=torch.float64)
    direction[::3] = 0  # such rows are skipped
    found = []
    for encode, kind in ((hash_grid_reference, torch.float64), (hash_grid, dtype)):
        x = positions.to(kind).requires_grad_()
        t = table.to(kind).requires_grad_()
        out = encode(x, t, MIXED)
        grads = torch.autograd.grad((out * direction.to(kind)).sum(), (x, t))
        found.append([v.double() for v in (out, *grads)])
    for name, truth, value in zip(("value", "positions' gradient", "table's gradient"), *found, strict=True):
        error = ((truth - value).abs().max() / truth.abs().max()).item()
        print(f"hash grid {dtype}: {name} off by {error:.1e} of the largest")
        assert error < (1e-14 if dtype == torch.float64 else 2e-5)


@pytest.mark.medium
def test_gradcheck() -> None:
    torch.manual_seed(1)
    layout = HashGridLayout.build(2, 2, 9, 6)  # one dense level, one hashed
    positions = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)
    table = torch.randn(layout.num_entries, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, t: hash_grid(x, t, layout), (positions, table))
    reference = lambda x, t: hash_grid_reference(x, t, layout)  # noqa: E731
    assert torch.autograd.gradgradcheck(reference, (positions, table), fast_mode=True)


def test_a_dense_level_reproduces_a_linear_function() -> None:
    layout = HashGridLayout.build(1, 7, 7, 12)
    lattice = torch.cartesian_prod(*[torch.arange(8, dtype=torch.float64)] * 3) / 7
    coefficients = torch.tensor([0.3, -2.0, 1.1], dtype=torch.float64)
    table = torch.zeros(layout.num_entries, 1, dtype=torch.float64)
    table[:512, 0] = lattice @ coefficients + 0.5
    positions = torch.rand(100, 3, dtype=torch.float64)
    out = hash_grid(positions, table, layout)[:, 0]
    torch.testing.assert_close(out, positions @ coefficients + 0.5, rtol=1e-13, atol=1e-13)


def test_the_hash_is_equation_4() -> None:
    """Recomputed with Python's unbounded integers."""
    level = 3
    resolution, size = MIXED.resolutions[level], MIXED.offsets[level + 1] - MIXED.offsets[level]
    positions = torch.rand(20, 3, dtype=torch.float64)
    entries, weights, _ = corners(positions, MIXED, level)
    for index, position in enumerate(positions.tolist()):
        cell = [int(x * resolution) for x in position]
        for corner in range(8):
            vertex = [c + (corner >> (2 - axis) & 1) for axis, c in enumerate(cell)]
            hashed = 0
            for coordinate, prime in zip(vertex, PRIMES, strict=True):
                hashed ^= coordinate * prime % 2**32
            assert entries[corner, index].item() == hashed % size
    torch.testing.assert_close(weights.sum(0), torch.ones(20, dtype=torch.float64))


def test_the_far_face_and_beyond_stay_inside_the_table() -> None:
    positions = torch.tensor([[1.0, 1, 1], [1 + 1e-7, 1, 1], [5, -5, 1], [0, 0, 0]])
    for level in range(len(MIXED.resolutions)):
        entries, _, _ = corners(positions, MIXED, level)
        assert int(entries.min()) >= 0
        assert int(entries.max()) < MIXED.offsets[level + 1] - MIXED.offsets[level]


def test_empty_input() -> None:
    grid = HashGrid(num_levels=3, base_resolution=4, max_resolution=16, log2_table_size=8)
    out = grid(torch.zeros(0, 3))
    assert out.shape == (0, 6)
    out.sum().backward()
    assert grid.table.grad is not None
    assert not grid.table.grad.any()


@pytest.mark.parametrize(("positions", "rows"), [((5, 2), MIXED.num_entries), ((5,), MIXED.num_entries), ((5, 3), 7)])
def test_wrong_shapes_are_named(positions: tuple[int, ...], rows: int) -> None:
    with pytest.raises(ValueError, match=r"hash_grid: .* shape"):
        hash_grid(torch.zeros(positions), torch.zeros(rows, 2), MIXED)
