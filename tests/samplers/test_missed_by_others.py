"""Behaviour that only planted bugs showed to be untested: fading of cells, full cells, the unit of disparity."""

import pytest
import torch

from nerfloom.data.scene import Scene
from nerfloom.geometry.points import Points
from nerfloom.kernels.histograms.spacing import spacing
from nerfloom.samplers.choice import SamplingConfig, make_sampler
from nerfloom.samplers.occupancy import DECAY, MOVING_DECAY, WARM_UP_STEPS, OccupancySampler

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def nothing(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a density of 0."""
    return torch.zeros(len(points)), torch.zeros(len(points), 0)


@pytest.mark.parametrize(("moving", "decay"), [(False, DECAY), (True, MOVING_DECAY)])
def test_a_cell_fades_slower_where_something_moves(moving: bool, decay: float) -> None:
    """The truth is by hand: a full cell that is seen empty keeps `decay` of its density; others keep all of it."""
    sampler = OccupancySampler(BOX, resolution=8, moving=moving)
    sampler.density_grid.fill_(1.0)
    sampler.update(WARM_UP_STEPS + 16, nothing)
    assert sorted(set(sampler.density_grid.tolist())) == pytest.approx([decay, 1.0])


def late(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a density that is there in the second half of the time alone."""
    there = torch.zeros(len(points)) if points.times is None else (points.times.view(-1) > 0.5).float()
    return there, torch.zeros(len(points), 0)


@pytest.mark.parametrize("moving", [False, True])
def test_a_cell_of_a_scene_that_moves_is_full_if_it_is_at_any_time(moving: bool) -> None:
    """The grid is made for a scene: a still one is not asked for its times."""
    scene = Scene(BOX, 0.0, 10.0, 3, True, moving, 20, num_times=3 * moving)
    sampler = make_sampler(SamplingConfig(sampler="occupancy", grid_resolution=8), scene)
    assert isinstance(sampler, OccupancySampler)
    sampler.density_grid.zero_()
    sampler.update(WARM_UP_STEPS + 16, late)
    assert sampler.density_grid.unique().tolist() == ([0.0, 1.0] if moving else [0.0])


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_a_ray_is_sampled_from_its_near_to_its_far_end_whatever_the_unit(scale: float) -> None:
    nears, fars = scale * torch.tensor([0.2, 1.5]), scale * torch.tensor([40.0, 3.0])
    t = spacing(nears, fars, scale)(torch.tensor([[0.0, 0.5, 1.0]]).expand(2, -1))
    torch.testing.assert_close(t[:, 0], nears)
    torch.testing.assert_close(t[:, 2], fars, rtol=1e-4, atol=0)
    # Half way in disparity (t / 2 up to 1, 1 - 1 / (2 t) beyond), by hand: of 0.1 and 0.9875; of 2/3 and 5/6.
    torch.testing.assert_close(t[:, 1], scale * torch.tensor([1 / (2 - 1.0875), 1 / (2 - 1.5)]), rtol=1e-4, atol=0)
