"""The occupancy grid that is marched is the one that there is: after carving, after a checkpoint, after an update."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.methods.tensorf import MARGIN
from nerfloom.samplers.occupancy import OccupancySampler
from tests.training.helpers import tiny_trainer
from tests.truth.test_training import Fog

BOX = torch.tensor([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]])
RESOLUTION = 8


def marched(sampler: OccupancySampler) -> Tensor:
    """(K, 3) where rays along x, one through each row of cells, are sampled."""
    rows = torch.cartesian_prod(*[(torch.arange(RESOLUTION) + 0.5) / RESOLUTION] * 2)
    across = torch.lerp(BOX[0, 1:], BOX[1, 1:], rows)
    count = len(rows)
    origins = torch.cat([torch.full((count, 1), -3.0), across], -1)
    rays = Rays(origins, torch.tensor([[1.0, 0, 0]]).repeat(count, 1), torch.zeros(count), torch.full((count,), 9.0))
    return sampler.sample(rays, Fog(), False).positions(rays)


def a_corner(places: Tensor) -> Tensor:
    """(K,) bool: a part of the box that no exchange or mirroring of axes leaves where it is."""
    return (places[:, 0] > 0.5) & (places[:, 1] < 0) & (places[:, 2] > 0.75)


def corner_cells() -> Tensor:
    cells = torch.cartesian_prod(*[torch.arange(RESOLUTION)] * 3)
    return a_corner(torch.lerp(BOX[0], BOX[1], (cells + 0.5) / RESOLUTION))


def sampler() -> OccupancySampler:
    """One that has been used already, so that its grid is packed."""
    made = OccupancySampler(BOX, RESOLUTION, num_steps=100, early_stop=0.0).eval()
    assert len(marched(made)) > 1000
    return made


def assert_the_corner_alone_is_marched(used: OccupancySampler) -> None:
    found = marched(used)
    assert len(found) > 10
    assert bool(a_corner(found).all())


def test_what_is_carved_away_is_not_marched_from_then_on() -> None:
    used = sampler()
    used.carve(corner_cells())
    assert_the_corner_alone_is_marched(used)


def test_a_checkpoints_grid_takes_the_place_of_one_that_was_used() -> None:
    used, other = sampler(), OccupancySampler(BOX, RESOLUTION, num_steps=100)
    other.carve(corner_cells())
    used.load_state_dict(other.state_dict())
    assert_the_corner_alone_is_marched(used)


def test_cells_are_asked_for_where_they_are() -> None:
    """A field that is dense in one corner alone: after the first updates only that is marched."""
    used = sampler()
    torch.manual_seed(0)

    def density(points: Points) -> tuple[Tensor, Tensor]:
        return 100.0 * a_corner(points.positions), points.positions

    for step in range(8, 257, 8):
        used.update(step, density)
    assert_the_corner_alone_is_marched(used)
    assert torch.equal(used.occupied, corner_cells())


def test_tensorfs_box_shrinks_to_all_that_is_occupied(shared_tiny: Path, tmp_path: Path) -> None:
    """The cells 2 to 5, 7 and 3 to 12 along the axes, whole, and a margin."""
    model: Any = tiny_trainer("tensorf", shared_tiny, tmp_path / "run").model
    n = model.sampler.resolution
    cells = torch.zeros(n, n, n, dtype=torch.bool)
    cells[2:6, 7, 3:13] = True
    model.sampler.carve(cells.view(-1))
    low, high = torch.tensor([2.0, 7, 3]) - MARGIN, torch.tensor([6.0, 8, 13]) + MARGIN
    box = model.field.box
    expected = torch.stack([box[0] + (box[1] - box[0]) * end / n for end in (low, high)])
    torch.testing.assert_close(model._occupied_box(), expected.clamp(float(box.min()), float(box.max())))
