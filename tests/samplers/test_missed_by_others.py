"""What planted bugs showed that no other test holds: how cells fade, and what unit disparity has."""

import pytest
import torch

from framework.geometry.points import Points
from framework.samplers.occupancy import DECAY, MOVING_DECAY, WARM_UP_STEPS, OccupancySampler
from framework.samplers.proposal import spacing

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def nothing(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a density of 0."""
    return torch.zeros(len(points)), torch.zeros(len(points), 0)


@pytest.mark.parametrize(("moving", "decay"), [(False, DECAY), (True, MOVING_DECAY)])
def test_a_cell_fades_slower_where_something_moves(moving: bool, decay: float) -> None:
    """By hand: a cell that was full and is seen empty keeps `decay` of its density; others keep all of it."""
    sampler = OccupancySampler(BOX, resolution=8, moving=moving)
    sampler.density_grid.fill_(1.0)
    sampler.update(WARM_UP_STEPS + 16, nothing)
    assert sorted(set(sampler.density_grid.tolist())) == pytest.approx([decay, 1.0])


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_a_ray_is_sampled_from_its_near_to_its_far_end_whatever_the_unit(scale: float) -> None:
    nears, fars = scale * torch.tensor([0.2, 1.5]), scale * torch.tensor([40.0, 3.0])
    t = spacing(nears, fars, scale)(torch.tensor([[0.0, 0.5, 1.0]]).expand(2, -1))
    torch.testing.assert_close(t[:, 0], nears)
    torch.testing.assert_close(t[:, 2], fars, rtol=1e-4, atol=0)
    # Half way in disparity (t / 2 up to 1, 1 - 1 / (2 t) beyond), by hand: of 0.1 and 0.9875; of 2/3 and 5/6.
    torch.testing.assert_close(t[:, 1], scale * torch.tensor([1 / (2 - 1.0875), 1 / (2 - 1.5)]), rtol=1e-4, atol=0)
