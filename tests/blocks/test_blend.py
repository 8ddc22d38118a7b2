"""Shares of blocks against their closed form, and blended pictures against sums by hand."""

import math

import pytest
import torch

from nerfloom.blocks.blend import MIN_VISIBILITY, blended, near_shares, visible_shares
from nerfloom.rendering.rendered import Picture


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_shares_in_closed_form() -> None:
    found = near_shares(tensor(1.0, 2.0, 9.0), tensor(4.0, 4.0, 8.0))
    one, other = (1 - 1 / 4) ** 4, (1 / 2 - 1 / 4) ** 4
    torch.testing.assert_close(found, tensor(one, other, 0.0) / (one + other))


def test_well_inside_they_are_inverse_distances_to_the_power_of_4() -> None:
    found = near_shares(tensor(1.0, 2.0, 3.0), tensor(1e9, 1e9, 1e9))
    weights = tensor(1.0, 2.0**-4, 3.0**-4)
    torch.testing.assert_close(found, weights / weights.sum())


def test_in_a_centre_a_block_has_all() -> None:
    torch.testing.assert_close(near_shares(tensor(0.0, 1.0), tensor(2.0, 2.0)), tensor(1.0, 0.0))


def test_beyond_all_radii_the_relatively_nearest_has_all() -> None:
    torch.testing.assert_close(near_shares(tensor(9.0, 30.0), tensor(2.0, 10.0)), tensor(0.0, 1.0))


def test_a_flight_across_seams_is_continuous() -> None:
    """Along a line through two blocks, from before the first to behind the second."""
    centers, radii, step = tensor(0.0, 4.0), tensor(4.0, 4.5), 0.01
    shares = torch.stack([near_shares((centers - x).abs(), radii) for x in torch.arange(-6, 10, step).double()])
    torch.testing.assert_close(shares.sum(-1), torch.ones(len(shares), dtype=torch.float64))
    assert float((shares[1:] - shares[:-1]).abs().max()) < 5 * step
    # Almost: towards the first centre the second share falls again, from about 1e-10.
    assert bool((shares[1:, 1] >= shares[:-1, 1] - 1e-9).all())


def test_what_shows_little_has_a_smaller_share_and_then_none() -> None:
    even = tensor(0.5, 0.5)
    torch.testing.assert_close(visible_shares(even, tensor(1.0, 1.0)), even)
    torch.testing.assert_close(visible_shares(even, tensor(0.3, 0.3)), even)
    torch.testing.assert_close(visible_shares(even, tensor(0.0, 0.0)), even)
    low = tensor(1 - MIN_VISIBILITY, 0.5 - MIN_VISIBILITY)
    torch.testing.assert_close(visible_shares(even, tensor(0.8, 0.4)), low / low.sum())
    torch.testing.assert_close(visible_shares(even, tensor(1.0, MIN_VISIBILITY)), tensor(1.0, 0.0))
    torch.testing.assert_close(visible_shares(tensor(0.0, 1.0), tensor(1.0, 0.2)), tensor(0.0, 1.0))


def picture(color: float, depth: float, opacity: float) -> Picture:
    shape = (2, 3)
    values = torch.full((*shape, 3), color), torch.full(shape, depth), torch.full(shape, depth + 1)
    return Picture(*values, torch.full(shape, opacity), num_rays=6)


def test_a_blended_picture_is_the_sum_by_hand() -> None:
    found = blended([picture(0.2, 2.0, 1.0), picture(0.8, 6.0, 0.5)], [0.75, 0.25])
    torch.testing.assert_close(found.rgb, torch.full((2, 3, 3), 0.75 * 0.2 + 0.25 * 0.8))
    torch.testing.assert_close(found.accumulation, torch.full((2, 3), 0.875))
    torch.testing.assert_close(found.depth, torch.full((2, 3), (0.75 * 2 + 0.125 * 6) / 0.875))
    torch.testing.assert_close(found.median_depth, torch.full((2, 3), 3.0))
    assert found.num_rays == 12


def test_where_nothing_is_the_depth_is_that_of_the_far_ends() -> None:
    found = blended([picture(0.0, 50.0, 0.0), picture(0.0, 50.0, 0.0)], [0.5, 0.5])
    torch.testing.assert_close(found.depth, torch.full((2, 3), 50.0))
    assert math.isfinite(float(found.depth.sum()))


def test_one_picture_stays_as_it_is() -> None:
    own = picture(0.3, 2.0, 0.7)
    found = blended([own], [1.0])
    assert [float(value) for value in found.rgb[0, 0]] == pytest.approx([0.3] * 3)
    torch.testing.assert_close(found.depth, own.depth)
    torch.testing.assert_close(found.median_depth, own.median_depth)
