"""Runs of pixels against plain boolean arrays."""

import pytest
import torch

from nerfloom.data.pixels.pixel_set import PixelSet


def random_mask(size: int, seed: int, smooth: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(-(-size // smooth), generator=generator) < 0.4).repeat_interleave(smooth)[:size]


@pytest.mark.parametrize("smooth", [1, 7, 1000])
def test_ranks_masks_and_pixels_against_a_boolean_array(smooth: int) -> None:
    mask = random_mask(997, smooth, smooth)
    mask[:smooth] = True
    chosen, expected = PixelSet.of_mask(mask, first=50), mask.nonzero().squeeze(-1) + 50
    assert len(chosen) == len(expected)
    assert torch.equal(chosen.pixels(), expected)
    ranks = torch.randint(len(expected), (300,))
    assert torch.equal(chosen.at(ranks), expected[ranks])
    assert torch.equal(chosen.listed().to("cpu").at(ranks), expected[ranks])
    for first, last in ((50, 1047), (60, 61), (0, 2000), (333, 700)):
        padded = torch.zeros(3000, dtype=torch.bool)
        padded[50:1047] = mask
        assert torch.equal(chosen.mask(first, last), padded[first:last])
        some = torch.randint(first, last, (200,))
        assert torch.equal(chosen.contains(some), padded[some])
        assert torch.equal(chosen.ranks(some), (padded.cumsum(0) - padded.long())[some])


@pytest.mark.parametrize("seed", range(4))
def test_unions_and_intersections(seed: int) -> None:
    masks = [random_mask(500, 10 * seed + index, smooth) for index, smooth in enumerate((1, 3, 20))]
    sets = [PixelSet.of_mask(mask) for mask in masks]
    depth = torch.stack(masks).sum(0)
    for at_least in (1, 2, 3):
        found = PixelSet.shared(sets, at_least)
        assert torch.equal(found.mask(0, 500), depth >= at_least)
        expected = PixelSet.of_mask(depth >= at_least)
        assert torch.equal(found.starts, expected.starts)  # neighbouring pieces are one run
        assert torch.equal(found.before, expected.before)


def test_sets_that_follow_each_other_and_empty_ones() -> None:
    empty = PixelSet.of_mask(torch.zeros(9, dtype=torch.bool))
    assert len(empty) == 0
    assert not bool(empty.mask(0, 9).any())
    assert not bool(empty.contains(torch.arange(9)).any())
    joined = PixelSet.joined([PixelSet.of_mask(torch.ones(3)), empty, PixelSet.of_mask(torch.ones(2), 7)])
    assert joined.pixels().tolist() == [0, 1, 2, 7, 8]
    assert len(PixelSet.shared([joined, empty], 2)) == 0
    assert PixelSet.shared([joined, empty], 1).pixels().tolist() == [0, 1, 2, 7, 8]
