"""Gaussians of several blocks as one: none is there twice, and each is in the cell of its own block."""

import math

import pytest
import torch

from nerfloom.blocks.composed import GaussianBlocks, Opened
from nerfloom.blocks.merge import in_cell, merged
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import Look
from nerfloom.splats.transform import transformed
from tests.blocks.fakes import block, placement, scene

CENTERS = torch.tensor([[0.0, 0, 0], [4.0, 0, 0], [2.0, 5.0, 0]])


def cloud(count: int = 500, width: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=random) * torch.tensor([6.0, 6.0, 1.0]) - 1
    turns = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    scales = torch.full((count, 3), math.log(0.1))
    return Gaussians(means, scales, turns, torch.zeros(count), torch.rand(count, 3), torch.ones(count, 3, width))


def test_what_all_blocks_have_learned_is_there_once() -> None:
    found = merged([cloud()] * 3, CENTERS)
    assert len(found) == 500
    assert sorted(map(tuple, found.means.tolist())) == sorted(map(tuple, cloud().means.tolist()))


def test_each_is_in_the_cell_of_its_block() -> None:
    parts = [cloud(), cloud(), cloud()]
    sizes = [int(in_cell(part.means, CENTERS, number).sum()) for number, part in enumerate(parts)]
    found = merged(parts, CENTERS)
    owner = torch.arange(3).repeat_interleave(torch.tensor(sizes))
    nearest = torch.cdist(found.means.double(), CENTERS.double()).argmin(-1)
    assert torch.equal(owner, nearest)


def test_in_the_middle_between_two_centres_the_first_has_it() -> None:
    point = torch.tensor([[2.0, 0.0, 0.0]])
    assert in_cell(point, CENTERS, 0).tolist() == [True]
    assert in_cell(point, CENTERS, 1).tolist() == [False]


def test_missing_degrees_are_0() -> None:
    found = merged([cloud(), cloud(width=3)], CENTERS[:2])
    assert found.harmonics.shape == (500, 3, 3)
    assert set(found.harmonics.sum((1, 2)).tolist()) == {0.0, 9.0}


def test_blocks_in_scenes_of_their_own_give_the_gaussians_back() -> None:
    """Two blocks' parts of one cloud, each in its own frame, give the cloud in the frame of the whole."""
    whole, own = placement(0.5, (1.0, 2.0, 0.0)), (placement(2.0, angle=0.4), placement(3.0, (0.0, -4.0, 1.0)))
    models = [DrawnGaussians(transformed(cloud(), *each.similarity()), Look(), scene()) for each in own]
    blocks = [block((0.0, 0.0, 0.0), 4.0), block((4.0, 0.0, 0.0), 4.0)]
    model = GaussianBlocks(blocks, lambda number: Opened(models[number], own[number]), whole, scene())
    assert isinstance(model, HasGaussians)
    assert model.look() == Look()
    found, expected = model.gaussians(), transformed(cloud(), *whole.similarity())
    order, other = found.means[:, 0].argsort(), expected.means[:, 0].argsort()
    torch.testing.assert_close(found.means[order], expected.means[other], atol=1e-5, rtol=1e-5)
    assert float(found.log_scales[0, 0]) == pytest.approx(math.log(0.05), abs=1e-5)
    assert len(found) == 500
