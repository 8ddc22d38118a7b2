"""The scenes of the stress suite: the ball's pictures agree with geometry, and data is reduced correctly."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from torch.nn.functional import normalize

from nerfloom.cameras.cameras import check_pose, subpixels
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.dataparsers.blender import Blender
from nerfloom.geometry.bounds import intersect_box
from nerfloom.stress.scenes import (
    BALL_SHARE,
    FIELD_OF_VIEW,
    NUM_TEST,
    NUM_TRAIN,
    SIZE,
    Views,
    as_decoded,
    ball_views,
    data_views,
    reduced,
)
from nerfloom.testing.ball import RADIUS, trace

INSIDE = RADIUS / 2
views_of = cache(ball_views)
"""Pictures of the ball, which are only read here."""
LOOKS = [(FIELD_OF_VIEW, None), (4.0, None), (90.0, INSIDE), (170.0, INSIDE)]
"""Fields of view, degrees, and distances."""


def both(views: Views) -> tuple[Dataset, Dataset]:
    return views.train, views.test


@pytest.mark.parametrize(("field_of_view", "distance"), LOOKS)
def test_cameras_are_rigid_look_at_the_ball_and_see_so_many_degrees(
    field_of_view: float, distance: float | None
) -> None:
    views = views_of(field_of_view, distance)
    assert (len(views.train), len(views.test)) == (NUM_TRAIN, NUM_TEST)
    for dataset in both(views):
        cameras, scene = dataset.cameras, dataset.scene
        for pose in cameras.camera_to_worlds:
            check_pose(pose, "a camera")
        seen = 2 * torch.atan(cameras.widths / 2 / cameras.fx).rad2deg()
        torch.testing.assert_close(seen, torch.full_like(seen, field_of_view))
        columns, rows, ahead = cameras.project(torch.zeros(len(cameras), 3), torch.arange(len(cameras)))
        assert bool(ahead.all())
        middle = torch.full_like(columns, SIZE / 2 - 0.5)
        torch.testing.assert_close(columns, middle, atol=1e-2, rtol=0)
        torch.testing.assert_close(rows, middle, atol=1e-2, rtol=0)
        away = torch.cdist(cameras.camera_to_worlds[:, :, 3], torch.cartesian_prod(*scene.box.T))
        assert scene.near - 1e-3 <= away.min()
        assert away.max() <= scene.far + 1e-3
        assert scene.num_cameras == len(dataset.names) == len(cameras)
        assert len(dataset.pixels) == int(cameras.offsets[-1])


@pytest.mark.parametrize(("field_of_view", "distance"), LOOKS)
def test_every_ray_meets_the_box(field_of_view: float, distance: float | None) -> None:
    for dataset in both(views_of(field_of_view, distance)):
        pixels = torch.arange(len(dataset.pixels))
        rays = dataset.cameras.pixel_rays(pixels, 0.0, 100.0, subpixels=subpixels(16))
        enter, leave = intersect_box(rays.origins, rays.directions, dataset.scene.box)
        assert bool((leave > enter).all())


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.4)])
def test_rays_meet_the_ball_where_brute_force_says(center: tuple[float, float, float]) -> None:
    generator = torch.Generator().manual_seed(0)
    origins, targets = torch.randn(2, 200, 3, generator=generator, dtype=torch.float64)
    unit = normalize(0.5 * targets - origins, dim=-1)
    middle = torch.tensor(center, dtype=torch.float64)
    normals, hits = trace(origins, unit, middle)
    t = torch.arange(1e-3, 8.0, 1e-3, dtype=torch.float64)
    inside = (origins[:, None] + t[:, None] * unit[:, None] - middle).norm(dim=-1) < RADIUS
    crossed = inside != inside[:, :1]
    assert (hits != crossed.any(-1)).sum() <= 1  # a grazing chord may be shorter than a step
    first = t[crossed.to(torch.int32).argmax(-1)]
    points = (origins + first[:, None] * unit)[hits]
    error = (normals[hits] - (points - middle) / RADIUS).abs().amax(-1)
    print(f"{int(hits.sum())} of 200 rays hit, {int(inside[:, 0].sum())} start inside; largest error {error.max():.1e}")
    assert error.sort().values[:-1].max() < 4e-3
    assert 20 < hits.sum() < 180
    assert inside[:, 0].sum() >= 3


@pytest.mark.parametrize("field_of_view", [FIELD_OF_VIEW, 4.0])
def test_the_ball_takes_its_share_of_a_picture(field_of_view: float) -> None:
    for dataset in both(views_of(field_of_view)):
        assert dataset.scene.has_alpha
        alpha = dataset.pixels[:, 3].double().mean() / 255
        assert float(alpha) == pytest.approx(math.pi / 4 * BALL_SHARE**2, abs=5e-3)


@pytest.mark.parametrize(("field_of_view", "distance"), LOOKS[:3])
def test_the_middle_of_a_picture_has_the_colour_of_its_normal(field_of_view: float, distance: float | None) -> None:
    """It is the nearest point's from outside, and the opposite wall's from inside."""
    dataset = views_of(field_of_view, distance).train
    for index, pose in enumerate(dataset.cameras.camera_to_worlds):
        normal = pose[:, 2] if distance is None else -pose[:, 2]
        middle = slice(SIZE // 2 - 1, SIZE // 2 + 1)
        shown = dataset.image(index)[middle, middle, :3].double().mean((0, 1)) / 255
        torch.testing.assert_close(shown, 0.5 + 0.5 * normal.double(), atol=0.02, rtol=0)


@pytest.mark.parametrize("field_of_view", [90.0, 170.0])
def test_from_inside_there_is_no_background(field_of_view: float) -> None:
    for dataset in both(views_of(field_of_view, INSIDE)):
        assert dataset.pixels.shape[1] == 3
        assert not dataset.scene.has_alpha


def test_alpha_that_says_nothing_is_dropped_as_in_decoding() -> None:
    opaque = torch.full((5, 4), 255, dtype=torch.uint8)
    assert as_decoded(opaque).shape == (5, 3)
    opaque[2, 3] = 254
    assert as_decoded(opaque) is opaque


def test_a_few_photographs_of_data(shared_tiny: Path) -> None:
    views = data_views(Blender(), shared_tiny)
    whole = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    assert (len(views.train), len(views.test)) == (10, 3)
    assert torch.equal(views.train.pixels, whole.pixels)
    assert views.train.names == whole.names


def test_data_is_reduced_as_a_format_would(shared_tiny: Path) -> None:
    whole = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    half = load_dataset(Blender(downscale_factor=2).parse(shared_tiny, "train"), "train")
    found = reduced(whole, 10)
    assert found.scene.image_size == 10
    assert torch.equal(found.pixels, half.pixels)
    torch.testing.assert_close(found.cameras.fx, half.cameras.fx)
    torch.testing.assert_close(found.cameras.cx, half.cameras.cx)
    assert torch.equal(found.cameras.widths, half.cameras.widths)


def test_a_reduced_pixel_counts_where_all_of_it_does(shared_tiny: Path) -> None:
    whole = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    mask = torch.rand(len(whole), 20, 20, generator=torch.Generator().manual_seed(1)) < 0.8
    found = reduced(replace(whole, kept=PixelSet.of_mask(mask)), 10)
    assert found.kept is not None
    assert found.drawn is not None
    expected = [
        bool(mask[image, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2].all())
        for image in range(len(whole))
        for row in range(10)
        for column in range(10)
    ]
    assert found.kept.mask(0, 1000).tolist() == expected
    assert found.drawn.pixels().tolist() == [pixel for pixel, kept in enumerate(expected) if kept]
