"""The compiled kernels of silhouettes beside their references."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerfloom.kernels.images.silhouettes import (
    Photograph,
    hold_balls,
    hold_balls_reference,
    opaque_sums,
    opaque_sums_reference,
    pixels_near_balls,
    pixels_near_balls_reference,
)
from tests.kernels.compiled import needs_kernels

pytestmark = needs_kernels


def photograph(seed: int, distance: float) -> tuple[Photograph, torch.Tensor]:
    """A photograph of random opaque spots, from somewhere at a distance from the origin; and the spots."""
    generator = torch.Generator().manual_seed(seed)
    opaque = torch.rand(37, 53, generator=generator) > 0.97
    opaque[5:12, 20:31] = True
    axes, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))  # the camera looks down its -z, at the origin
    pose = torch.cat([axes, axes[:, 2:] * distance], dim=1).contiguous()
    return Photograph(pose, 60.0, 55.0, 26.0, 19.0, opaque_sums(opaque)), opaque


@pytest.mark.parametrize("seed", range(3))
def test_sums_are_those_of_every_rectangle(seed: int) -> None:
    taken, opaque = photograph(seed, 4.0)
    assert torch.equal(taken.sums, opaque_sums_reference(opaque))
    for x0, x1, y0, y1 in ((0, 53, 0, 37), (3, 20, 1, 30), (7, 7, 0, 37)):
        counted = taken.sums[y1, x1] - taken.sums[y1, x0] - taken.sums[y0, x1] + taken.sums[y0, x0]
        assert int(counted) == int(opaque[y0:y1, x0:x1].sum())


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("every", [True, False])
@pytest.mark.parametrize("distance", [0.2, 2.0, 6.0])
def test_balls_are_held_as_by_the_reference(distance: float, every: bool, closed: bool) -> None:
    """Balls all around, some behind the camera, some around it, some cut off by the picture's edge."""
    generator = torch.Generator().manual_seed(0)
    centers, known = torch.rand(5000, 3, generator=generator) * 4 - 2, torch.rand(5000, generator=generator) > 0.3
    centers[0] = torch.nan
    taken = replace(photograph(1, distance)[0], closed=closed)
    found, expected = known.clone(), known.clone()
    hold_balls(taken, centers, 0.05, found, every)
    hold_balls_reference(taken, centers, 0.05, expected, every)
    changed = int((expected != known).sum())
    differ = int((found != expected).sum())
    print(f"{changed} of 5000 changed, {differ} otherwise than in the reference")
    assert changed > 20
    assert differ <= 5  # where rounding moves an edge across a pixel
    assert bool(found[0]) == bool(known[0] or not every)  # an empty ball has no place


@pytest.mark.parametrize("distance", [0.05, 1.2, 2.0, 6.0])
@pytest.mark.parametrize("count", [0, 1, 20000])
def test_pixels_near_balls_are_those_of_the_reference(distance: float, count: int) -> None:
    centers = torch.rand(count, 3, generator=torch.Generator().manual_seed(2)) * 2 - 1
    taken, _ = photograph(3, distance)
    found = pixels_near_balls(taken, centers, 0.02)
    expected = pixels_near_balls_reference(taken, centers, 0.02)
    assert found.shape == expected.shape == (37, 53)
    assert int((found != expected).sum()) <= 2
    assert bool(found.any())
