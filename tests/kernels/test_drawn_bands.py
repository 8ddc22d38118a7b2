"""Bands at places that the device draws: rows of their factors, each about as often, with their gradient."""

import torch

from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.kernels.grids.drawn_bands import drawn_bands
from nerfloom.kernels.grids.planes_layout import PlanesLayout

LAYOUT = PlanesLayout.build(((5, 7, 9), (4, 3, 2)))
NUMBERED = torch.arange(LAYOUT.num_entries * 2.0).view(-1, 2)


def test_bands_are_consecutive_rows_and_pass_their_gradient_on() -> None:
    table = NUMBERED.clone().requires_grad_()
    bands = [(0, 1, 3), (0, 2, 9), (1, 0, 2)]
    found = drawn_bands(table, LAYOUT, bands)
    for band, (group, index, rows) in zip(found, bands, strict=True):
        factor = LAYOUT.factor(NUMBERED, group, index)
        places = [first for first in range(len(factor) - rows + 1) if torch.equal(band, factor[first : first + rows])]
        assert len(places) == 1
    sum((number + 1) * band.square().sum() for number, band in enumerate(found)).backward()  # type: ignore[union-attr]
    expected = torch.zeros_like(table)
    for number, band in enumerate(found):
        rows = (band[..., 0].detach().flatten() / 2).long()
        expected[rows] = 2 * (number + 1) * NUMBERED[rows]
    torch.testing.assert_close(table.grad, expected)


def test_no_row_is_forgotten_and_a_single_one_is_whole() -> None:
    """Bands that lie partly beyond the factor are moved into it: rows near the ends come up to twice as often."""
    torch.manual_seed(0)
    counts = torch.zeros(9)
    for _ in range(3000):
        (band,) = drawn_bands(NUMBERED, LAYOUT, [(0, 1, 3)])
        counts[((band[:, 0, 0] - LAYOUT.factor(NUMBERED, 0, 1)[0, 0, 0]) / 10).long()] += 1
    expected = torch.tensor([3, 4, 5, 3, 3, 3, 5, 4, 3]) / 11
    torch.testing.assert_close(counts / 3000, expected, atol=0.03, rtol=0)
    lines = FeaturePlanes(((6, 6, 6),), 2, (((0,), (1,), (2,)),))
    (line,) = drawn_bands(lines.table, lines.layout, [(0, 1, 1)])
    assert torch.equal(line, lines.layout.factor(lines.table, 0, 1))
