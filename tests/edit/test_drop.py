"""Removal of single Gaussians, with known ones among others, and sums of weights in closed form."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from nerfloom import edit
from nerfloom.base.errors import ConfigError
from nerfloom.edit.edited import Edited
from nerfloom.edit.sightings import sightings
from nerfloom.kernels.splats.blend import MAX_ALPHA
from nerfloom.kernels.splats.project import BLUR, MIN_ALPHA
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.gaussians import Gaussians
from tests.edit.clouds import at, ball_in_capture, scattered
from tests.splats.test_method import camera


def test_faint_large_and_needle_like_ones_are_dropped() -> None:
    given = at(torch.arange(18.0).view(6, 3))
    given.logits[1] = math.log(0.1 / 0.9)
    given.log_scales[2] = torch.tensor([0.01, 0.01, 0.4]).log()
    given.log_scales[3] = torch.tensor([0.001, 0.3, 0.3]).log()  # flat, and no needle
    given.log_scales[4] = torch.tensor([0.3, 0.3, 0.3]).log()
    edited = Edited(given)

    def left(kept: Edited) -> list[int]:
        return [int(x) // 3 for x in kept.gaussians.means[:, 0]]

    assert left(edit.drop_faint(edited, 0.11)) == [0, 2, 3, 4, 5]
    assert left(edit.drop_faint(edited, 0.09)) == [0, 1, 2, 3, 4, 5]
    assert left(edit.drop_large(edited, 0.35)) == [0, 1, 3, 4, 5]
    assert left(edit.drop_large(edited, 0.2)) == [0, 1, 5]
    assert left(edit.drop_needles(edited)) == [0, 1, 3, 4, 5]
    assert left(edit.drop_needles(edited, 41.0)) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("far", [10.0, 1e6])
def test_isolated_ones_are_dropped_however_far_they_are(far: float) -> None:
    random = torch.Generator().manual_seed(0)
    crowd = torch.rand(600, 3, generator=random, dtype=torch.float64)
    alone = torch.tensor([[far, 0, 0], [0, -10.0, 0], [3.0, 3.0, 0]], dtype=torch.float64)
    shift = torch.tensor([5e5, 4e6, 0.0], dtype=torch.float64)  # the coordinates of a survey
    edited = Edited(at(torch.cat([crowd, alone]) + shift))
    kept = edit.drop_isolated(edited)
    assert torch.equal(kept.gaussians.means, crowd + shift)


def test_a_far_background_is_not_isolated() -> None:
    """Large Gaussians on a sphere around a crowd stay where they overlap; small ones at its distances do not."""
    random = torch.Generator().manual_seed(0)
    crowd = torch.rand(600, 3, generator=random, dtype=torch.float64)
    index = torch.arange(400, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * index / 400, index * math.pi * (3 - math.sqrt(5))
    around = (1 - z.square()).sqrt()
    sphere = 100 * torch.stack([around * angle.cos(), around * angle.sin(), z], -1)
    alone = torch.tensor([[3.0, 3, 0], [0, -50.0, 0]], dtype=torch.float64)
    given = at(torch.cat([crowd, sphere, alone]))
    given.log_scales[600:1000, :2] = math.log(20.0)  # the distance of the nearest is about 18
    kept = edit.drop_isolated(Edited(given)).gaussians.means
    assert torch.equal(kept, torch.cat([crowd, sphere]))


def alpha(opacity: float, size: float, distance: float) -> np.ndarray:
    """Alpha (33, 33) of a round Gaussian on the axis of `camera()`, which has a focal length of 40."""
    rows, columns = np.mgrid[:33, :33] + 0.5
    squared = (rows - 16.5) ** 2 + (columns - 16.5) ** 2
    found = opacity * np.exp(-squared / (2 * ((40 * size / distance) ** 2 + BLUR)))
    return np.where(found < MIN_ALPHA, 0, np.minimum(found, MAX_ALPHA))


def on_axis(*rows: tuple[float, float, float]) -> Gaussians:
    """Round Gaussians of an opacity and a size at a distance from the camera at z = 3."""
    opacities, sizes, distances = torch.tensor(rows).T
    means = torch.stack([torch.zeros(len(rows)), torch.zeros(len(rows)), 3 - distances], -1)
    given = at(means).map(torch.Tensor.float)
    return dataclasses.replace(given, log_scales=sizes.log()[:, None].expand(-1, 3).clone(), logits=opacities.logit())


def test_weights_are_those_of_blending() -> None:
    """Three behind one another, the nearest last in the list."""
    seen = sightings(on_axis((0.9, 0.2, 4.0), (0.5, 0.1, 3.0), (0.3, 0.05, 2.0)), [splat_camera(camera(), near=0.1)])
    back, middle, front = alpha(0.9, 0.2, 4.0), alpha(0.5, 0.1, 3.0), alpha(0.3, 0.05, 2.0)
    truth = [(back * (1 - middle) * (1 - front)).sum(), (middle * (1 - front)).sum(), front.sum()]
    np.testing.assert_allclose(seen.weights.numpy(), truth, rtol=1e-3)


def test_what_is_in_front_is_told_from_what_is_on_a_surface_or_behind() -> None:
    """A wall at distance 3; faint ones in front, on it, and behind; and one outside of the image."""
    wall = (0.99, 0.5, 3.0)
    given = on_axis(wall, (0.2, 0.05, 2.0), (0.2, 0.05, 2.95), (0.2, 0.05, 4.0), (0.2, 0.05, 2.0))
    given.means[4, 0] = 5.0
    views = [splat_camera(camera(), near=0.1), splat_camera(camera(distance=3.1), near=0.1)]
    seen = sightings(given, views)
    assert seen.views.tolist() == [2, 2, 2, 0, 0]
    assert seen.in_front.tolist() == [0, 2, 0, 0, 0]
    assert float(seen.opacity_in_front[1]) == pytest.approx(0.2, rel=0.05)
    assert float(seen.weights[4]) == 0


def test_without_anything_in_view() -> None:
    given = on_axis((0.5, 0.1, -2.0))
    seen = sightings(given, [splat_camera(camera(), near=0.1)])
    assert float(seen.weights[0]) == float(seen.views[0]) == 0


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Edited:
    return ball_in_capture(tmp_path_factory.mktemp("ball"))


def test_floaters_of_a_capture_are_dropped(ball: Edited) -> None:
    """After the Gaussians have been moved away from the frame of the photographs, too."""
    for given in (ball, edit.scale(edit.rotate(edit.move(ball, (3.0, 0.0, -2.0)), (0.0, 1.0, 2.0), 40.0), 0.2)):
        kept = edit.drop_floaters(given)
        assert torch.equal(kept.gaussians.means, given.gaussians.means[:-1])
    assert len(edit.drop_floaters(ball, max_opacity=0.05)) == len(ball)
    assert len(edit.drop_floaters(ball, min_views=8)) == len(ball)  # there are seven training images


def test_what_contributes_least_is_reduced_first(ball: Edited) -> None:
    """Gaussians in the middle of the ball have no weight, however large they are."""
    middle = ball.gaussians.means[:-2].mean(0)
    hidden = at(middle + 0.02 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double(), 0.1)
    parts = [hidden, dataclasses.replace(ball.gaussians, extras={})]
    both = dataclasses.replace(ball, gaussians=Gaussians.joined(parts))
    kept = edit.reduce_to(both, 600)
    assert len(kept) == 600
    inside = (kept.gaussians.means - middle).norm(dim=-1) < 0.3
    assert int(inside.sum()) == 0
    alone = edit.reduce_to(Edited(both.gaussians), 600)  # without photographs, size counts
    assert int(((alone.gaussians.means - middle).norm(dim=-1) < 0.3).sum()) == 50


def test_floaters_need_photographs() -> None:
    with pytest.raises(ConfigError, match="--data DIR"):
        edit.drop_floaters(scattered())
