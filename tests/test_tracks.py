"""Tracks: how well the distance of a sparse point is known, and which points may be learned from."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.data.tracks import DOUBTS, MAX_DEVIATION, Observations, Tracks, distance_deviations, doubts_about
from tests.images import parsed

SOUND = torch.zeros(1, dtype=torch.int64)
"""No doubt about the only point."""


def two_rays(angle: float, distance: float, error: float) -> tuple[Tracks, torch.Tensor]:
    """A point at the origin, seen from two cameras at the same distance, with rays `angle` apart."""
    half = angle / 2
    centers = distance * torch.tensor([[math.sin(half), 0.0, math.cos(half)], [-math.sin(half), 0.0, math.cos(half)]])
    return Tracks(
        torch.zeros(1, 3), torch.tensor([0, 1]), torch.tensor([0, 0]), torch.full((2,), error), SOUND
    ), centers


@pytest.mark.parametrize("angle", [0.02, 0.3, 1.5])
def test_two_rays_in_closed_form(angle: float) -> None:
    """Across the bisector the information is 2 cos^2(a/2) / (r e)^2, along it 2 sin^2(a/2) / (r e)^2."""
    distance, error, half = 3.0, 1e-3, angle / 2
    found = distance_deviations(*two_rays(angle, distance, error))
    across, along = (math.cos(half) ** -2 / 2, math.sin(half) ** -2 / 2)
    expected = distance * error * math.sqrt(along * math.cos(half) ** 2 + across * math.sin(half) ** 2)
    torch.testing.assert_close(found, torch.full((2,), expected, dtype=torch.float64), rtol=1e-2, atol=0)


def test_against_triangulation_of_noisy_rays() -> None:
    """Five cameras around a point, at different distances and with different errors: 20,000 triangulations."""
    torch.manual_seed(0)
    point = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    centers = torch.tensor(
        [[3.0, 0, 0], [2.5, 1, 0.5], [2.0, -1, 1], [4.0, 0.5, -1], [2.8, 0, 1.5]], dtype=torch.float64
    )
    angles = torch.tensor([1e-3, 2e-3, 1e-3, 5e-4, 3e-3], dtype=torch.float64)
    every = torch.arange(5)
    found = distance_deviations(Tracks(point[None], every, torch.zeros(5, dtype=torch.int64), angles, SOUND), centers)
    apart = point - centers
    distances = apart.norm(dim=-1, keepdim=True)
    noise = torch.randn(20_000, 5, 3, dtype=torch.float64) * angles[:, None]
    directions = torch.nn.functional.normalize(apart / distances + noise, dim=-1)
    # Weighted least squares: the point with the smallest sum of squared angles to the rays.
    across = torch.eye(3, dtype=torch.float64) - directions[..., :, None] * directions[..., None, :]
    across = across / (distances * angles[:, None]).square()[..., None]
    positions = torch.linalg.solve(across.sum(1), (across @ centers[:, :, None]).sum(1))[..., 0]
    spread = ((positions - point) @ (apart / distances).T).std(0)
    torch.testing.assert_close(found, spread, rtol=0.03, atol=0)


def test_the_distance_of_a_point_beyond_measure_is_unknown() -> None:
    """Its information is below float64: the inverse does not exist. The other point's distance is as before."""
    tracks, centers = two_rays(0.3, 3.0, 1e-3)
    points = torch.cat((tracks.points.double(), torch.full((1, 3), 1e200, dtype=torch.float64)))
    images, seen = torch.tensor([0, 1, 0, 1]), torch.tensor([0, 0, 1, 1])
    both = Tracks(points, images, seen, torch.full((4,), 1e-3), torch.zeros(2, dtype=torch.int64))
    found = distance_deviations(both, centers)
    torch.testing.assert_close(found[:2], distance_deviations(tracks, centers))
    assert not (found[2:] <= MAX_DEVIATION).any()


def test_one_image_knows_no_distance() -> None:
    tracks, centers = two_rays(0.3, 3.0, 1e-3)
    alone = tracks.of_images(torch.tensor([1]))
    assert alone.images.tolist() == [0]
    deviation = distance_deviations(alone, centers[1:])
    assert deviation.item() == pytest.approx(3.0, rel=1e-3)
    assert alone.confirmed().tolist() == [False]
    assert len(alone.sightings(centers[1:])) == 0


def test_rays_that_hardly_differ_know_no_distance() -> None:
    """The deviation is 7 % at an angle of 20 errors, and 28 % at 5."""
    for ratio, count in ((20, 2), (5, 0)):
        tracks, centers = two_rays(ratio * 1e-3, 3.0, 1e-3)
        deviations = distance_deviations(tracks, centers) / 3
        assert bool((deviations <= MAX_DEVIATION).all()) == (count == 2)
        assert len(tracks.sightings(centers)) == count


def test_images_are_numbered_anew_in_the_order_given() -> None:
    images, seen = torch.tensor([0, 0, 1, 2, 2, 4]), torch.tensor([0, 1, 0, 1, 2, 2])
    tracks = Tracks(torch.randn(3, 3), images, seen, torch.arange(6).float(), SOUND.expand(3))
    some = tracks.of_images(torch.tensor([4, 2, 3]))
    assert list(zip(some.images.tolist(), some.seen.tolist(), some.angles.tolist(), strict=True)) == [
        (1, 1, 3.0), (1, 2, 4.0), (0, 2, 5.0)
    ]  # fmt: skip
    assert some.confirmed().tolist() == [False, False, True]
    less = tracks.without(torch.tensor([True, False, False, False, False]))
    assert less.images.tolist() == [1, 2, 2, 4]
    assert less.confirmed().tolist() == [False, False, True]


def test_images_keep_the_points_that_they_see(tmp_path: Path) -> None:
    """There are five images: image i sees points i and i + 1, and the last one sees none. Point 9 has no track."""
    sees = [(image, point) for image in range(4) for point in (image, image + 1)]
    points = torch.arange(10.0)[:, None].expand(10, 3)
    observations = Observations(*torch.tensor(sees).unbind(-1)).of_points(torch.ones(10, dtype=torch.bool))
    several = parsed([tmp_path / str(image) for image in range(5)], [(4, 4)] * 5)
    scene = replace(several, points=points[[*range(5), 9]], observations=observations)
    some = scene[torch.tensor([3, 0])]
    assert some.points is not None
    assert some.points[:, 0].tolist() == [0, 1, 3, 4, 9]
    one = some[torch.tensor([0])]  # which was image 3
    assert one.points is not None
    assert one.points[:, 0].tolist() == [3, 4, 9]
    assert replace(scene, observations=None)[torch.tensor([0])].points is scene.points
    without = replace(scene, points=points[:5])[torch.tensor([4])]
    assert without.points is None  # not an empty set, where nothing could start


def test_points_that_leave_the_range_of_numbers_go_with_their_sightings() -> None:
    points = torch.tensor([[0.0, 0, 0], [torch.inf, 0, 0], [1.0, 1, 1]])
    images, seen, doubts = torch.tensor([0, 1, 0, 1]), torch.tensor([0, 1, 2, 2]), torch.tensor([1, 2, 3])
    tracks = Tracks(torch.zeros(3, 3), images, seen, torch.ones(4), doubts).at(points)
    assert tracks.doubts.tolist() == [1, 3]
    assert tracks.points.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert (tracks.images.tolist(), tracks.seen.tolist()) == ([0, 0, 1], [0, 1, 1])


def test_nothing_is_something_too() -> None:
    tracks = Tracks(torch.zeros(0, 3), *[torch.zeros(0, dtype=torch.int64)] * 2, torch.zeros(0), SOUND[:0])
    assert len(tracks.of_images(torch.tensor([0, 1])).sightings(torch.zeros(2, 3))) == 0
    without = tracks.without(torch.zeros(2, dtype=torch.bool)).sightings(torch.zeros(2, 3))
    assert len(without.of_images(torch.tensor([1]))) == 0


def test_doubtful_points_tell_no_distance() -> None:
    tracks, centers = two_rays(0.3, 3.0, 1e-3)
    assert tracks.known_distances(centers).tolist() == [True, True]
    doubted = replace(tracks, doubts=torch.ones(1, dtype=torch.int64))
    assert doubted.known_distances(centers).tolist() == [False, False]
    assert len(doubted.sightings(centers)) == 0
    assert doubted.confirmed().tolist() == [True]


def test_reasons_to_doubt_a_point() -> None:
    lengths, errors = torch.tensor([3, 9, 2, 3, 0, 1]), torch.tensor([2.0, 0.5, 0.5, 2.1, 0.5, 7.0])
    found = [DOUBTS[index] for index in doubts_about(lengths, errors).tolist()]
    few, large = "seen by fewer than 3 images", "with a reprojection error above 2 pixels"
    assert found == ["", "", few, large, "without a track", few]


def test_what_is_known_without_held_out_images() -> None:
    """Image 9 is held out. Points without a track, and points that training images alone see, are known as they are."""
    sees = {0: [], 1: [3], 2: [3, 4], 3: [3, 9], 4: [3, 4, 9], 5: [9], 6: [3, 3]}
    pairs = [(image, point) for point, images in sees.items() for image in images]
    images, seen = torch.tensor(pairs).unbind(-1)
    tracks = Tracks(torch.randn(7, 3), images, seen, torch.ones(len(pairs)), SOUND.expand(7))
    held_out = torch.zeros(10, dtype=torch.bool)
    held_out[9] = True
    assert tracks.known_without(held_out).tolist() == [True, True, True, False, True, False, True]
    assert bool(tracks.known_without(torch.zeros(10, dtype=torch.bool)).all())
