"""Division of cameras: every camera is covered, bounds are kept, and the same input gives the same blocks."""

import itertools

import pytest
import torch

from nerfloom.blocks.block import Block
from nerfloom.blocks.split import grid_blocks, in_no_block, tree_blocks


def town(count: int = 400, seed: int = 0) -> torch.Tensor:
    """Cameras in a plane, denser in one corner, far from the origin as in UTM."""
    random = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 3, generator=random, dtype=torch.float64) ** 2
    return places * torch.tensor([300.0, 100.0, 2.0]) + torch.tensor([4e5, 5e6, 100.0])


def road(count: int = 101) -> torch.Tensor:
    """Cameras on a straight road of length 100."""
    x = torch.linspace(0, 100, count, dtype=torch.float64)
    return torch.stack([x, torch.zeros_like(x), torch.ones_like(x)], dim=-1)


@pytest.mark.parametrize("overlap", [0.0, 0.5])
def test_each_camera_is_in_a_block_and_no_block_has_too_many(overlap: float) -> None:
    blocks = tree_blocks(town(), 60, overlap, 1)
    assert in_no_block(blocks, 400) == []
    assert len(blocks) > 400 / 60
    for block in blocks:
        assert len(block.cameras) <= 60
        assert list(block.cameras) == sorted(set(block.cameras))
    assert sum(len(block.cameras) for block in blocks) == 400 or overlap > 0


def test_a_grid_covers_every_camera_too() -> None:
    blocks = grid_blocks(town(), 50.0, 0.0, 1)
    assert in_no_block(blocks, 400) == []
    assert sorted(itertools.chain(*(block.cameras for block in blocks))) == list(range(400))
    for block in blocks:
        own = town()[list(block.cameras)]
        assert float((own.amax(0) - own.amin(0)).max()) <= 50 + 1e-6


def test_blocks_reach_all_of_their_cameras() -> None:
    for block in tree_blocks(town(), 60, 0.5, 1):
        away = (town()[list(block.cameras)] - torch.tensor(block.center, dtype=torch.float64)).norm(dim=-1)
        assert float(away.max()) <= block.radius * (1 + 1e-12)


def test_half_of_a_block_on_a_road_is_shared_with_each_neighbour() -> None:
    blocks = grid_blocks(road(1001), 25.0, 0.5, 1)
    assert len(blocks) == 4
    for one, other in itertools.pairwise(blocks[1:3]):
        shared = set(one.cameras) & set(other.cameras)
        assert len(shared) == pytest.approx(len(one.cameras) / 2, abs=2)
    assert [block.center[0] for block in blocks] == pytest.approx([12.5, 37.5, 62.5, 87.5], abs=0.1)


def test_the_same_cameras_give_the_same_blocks_and_their_order_does_not_matter() -> None:
    first = tree_blocks(town(), 60, 0.3, 1)
    assert first == tree_blocks(town().clone(), 60, 0.3, 1)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    shuffled = tree_blocks(town()[order], 60, 0.3, 1)
    names = [sorted(int(order[index]) for index in block.cameras) for block in shuffled]
    assert names == [sorted(block.cameras) for block in first]


def test_a_scene_that_fits_is_one_block() -> None:
    (block,) = tree_blocks(road(), 101, 0.5, 1)
    assert block.cameras == tuple(range(101))
    assert block.center == pytest.approx((50.0, 0.0, 1.0))


def test_cameras_at_one_place_cannot_be_divided() -> None:
    (block,) = tree_blocks(torch.ones(9, 3), 4, 0.5, 1)
    assert block == Block((1.0, 1.0, 1.0), 1.0, tuple(range(9)))


def test_small_blocks_are_left_out_and_their_cameras_counted() -> None:
    positions = torch.cat([road(), torch.tensor([[500.0, 0.0, 1.0], [501.0, 0.0, 1.0]], dtype=torch.float64)])
    blocks = grid_blocks(positions, 50.0, 0.0, 8)
    assert in_no_block(blocks, 103) == [101, 102]
    assert all(len(block.cameras) >= 8 for block in blocks)
