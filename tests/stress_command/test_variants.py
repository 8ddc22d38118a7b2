"""Hard variants of a scene have the property that they claim, and leave the scene they start from alone."""

import math
from dataclasses import replace

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import check_pose
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.stress.faults import EVERY, spoiled_batches, spoiled_pixel, spoiled_pose
from nerfloom.stress.scenes import NUM_TRAIN, SIZE, Views, ball_views
from nerfloom.stress.variants import (
    chosen,
    first_image,
    mean_color,
    moved,
    one_pixel,
    plain_colored,
    transparent,
    twice,
    with_distractors,
)

BALL = ball_views()


def consistent(dataset: Dataset) -> None:
    """Check that the facts of a data set agree with each other."""
    count = len(dataset.cameras)
    assert len(dataset.pixels) == int(dataset.cameras.offsets[-1])
    assert len(dataset.names) == dataset.scene.num_cameras == count
    assert dataset.scene.has_alpha == (dataset.pixels.shape[1] == 4)
    assert dataset.scene.camera_to_worlds is not None
    assert torch.equal(dataset.scene.camera_to_worlds, dataset.cameras.camera_to_worlds)
    assert dataset.pixels.dtype == torch.uint8


@pytest.mark.parametrize("level", [0, 255])
def test_photographs_of_one_colour(level: int) -> None:
    found = plain_colored(BALL.train, level)
    consistent(found)
    assert found.pixels.shape == (NUM_TRAIN * SIZE**2, 3)
    assert bool((found.pixels == level).all())


def test_discs_are_opaque_and_each_image_has_its_own() -> None:
    found = with_distractors(BALL.train, 0.2)
    consistent(found)
    changed = (found.pixels != BALL.train.pixels).any(-1).view(NUM_TRAIN, -1)
    assert bool((changed.float().mean(1) > 0.15).all())
    assert bool((changed.float().mean(1) < 0.45).all())
    assert bool((found.pixels.view(NUM_TRAIN, -1, 4)[changed][:, 3] == 255).all())
    assert len({tuple(row.tolist()) for row in changed}) == NUM_TRAIN
    assert torch.equal(found.pixels, with_distractors(BALL.train, 0.2).pixels)
    assert not torch.equal(found.pixels, with_distractors(BALL.train, 0.2, seed=1).pixels)


def test_photographs_of_nothing() -> None:
    found = transparent(BALL.train)
    consistent(found)
    assert found.scene.has_alpha
    assert bool((found.pixels == 0).all())


def test_a_mean_colour_is_weighted_by_alpha() -> None:
    image = torch.tensor([[[200, 0, 100, 255], [0, 100, 0, 0]], [[100, 60, 0, 85], [9, 9, 9, 0]]], dtype=torch.uint8)
    assert mean_color(image).tolist() == [175, 15, 75, 85]  # (3 * first + third) / 4, and 340 / 4
    assert mean_color(image[..., :3]).tolist() == [77, 42, 27]
    assert mean_color(torch.zeros(2, 2, 4, dtype=torch.uint8)).tolist() == [0, 0, 0, 0]


def test_one_pixel_is_the_whole_picture() -> None:
    found = one_pixel(BALL.train)
    consistent(found)
    assert len(found.pixels) == NUM_TRAIN
    assert found.scene.image_size == 1
    before, after = BALL.train.cameras, found.cameras
    torch.testing.assert_close(after.fx * SIZE, before.fx)
    rays = after.pixel_rays(torch.arange(NUM_TRAIN), 0.0, 1.0)
    torch.testing.assert_close(rays.directions, -after.camera_to_worlds[:, :, 2])
    alpha = BALL.train.pixels[:, 3].double().view(NUM_TRAIN, -1).mean(1)
    torch.testing.assert_close(found.pixels[:, 3].double(), alpha, atol=0.51, rtol=0)


def test_the_first_image_alone_and_all_twice() -> None:
    one, double = first_image(BALL.train), twice(BALL.train)
    consistent(one)
    consistent(double)
    assert len(one) == 1
    assert torch.equal(one.image(0), BALL.train.image(0))
    assert len(double) == 2 * NUM_TRAIN
    for index in range(2 * NUM_TRAIN):
        assert torch.equal(double.image(index), BALL.train.image(index % NUM_TRAIN))
        same = double.cameras.camera_to_worlds[index], BALL.train.cameras.camera_to_worlds[index % NUM_TRAIN]
        assert torch.equal(*same)


def test_chosen_photographs_keep_their_masks_and_times() -> None:
    mask = torch.rand(NUM_TRAIN, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) < 0.5
    times = torch.linspace(0, 1, NUM_TRAIN)
    masked = replace(BALL.train, kept=PixelSet.of_mask(mask), times=times)
    found = chosen(masked, [3, 1, 3])
    assert found.kept is not None
    assert torch.equal(found.kept.mask(0, 3 * SIZE**2).view(3, SIZE, SIZE), mask[[3, 1, 3]])
    assert found.times is not None
    assert torch.equal(found.times, times[[3, 1, 3]])
    assert found.names == tuple(masked.names[i] for i in (3, 1, 3))


# -- where the scene is -------------------------------------------------------------------------------------------


def in_box(dataset: Dataset) -> torch.Tensor:
    """(M, 3) the cameras' places in units of the box, from its corner: no similarity changes these."""
    box = dataset.scene.box.double()
    return (dataset.cameras.camera_to_worlds[:, :, 3].double() - box[0]) / (box[1] - box[0])


def ends(dataset: Dataset) -> tuple[float, float]:
    """Near and far in units of the box's edge."""
    edge = float(dataset.scene.box[1, 0].double() - dataset.scene.box[0, 0].double())
    return dataset.scene.near / edge, dataset.scene.far / edge


MOVES = [(1e-6, 0.0, 1e-6), (1e6, 0.0, 1e-6), (1.0, 1e4, 1e-3)]
"""Scale, shift, and how much float32 leaves of places in units of the box: 0.001 at 10,000."""


@pytest.mark.parametrize(("scale", "shift", "rounding"), MOVES)
def test_a_moved_scene_is_the_same_in_its_box(scale: float, shift: float, rounding: float) -> None:
    views = moved(BALL, scale, shift)
    for before, after in ((BALL.train, views.train), (BALL.test, views.test)):
        consistent(after)
        expected = scale * before.cameras.camera_to_worlds[:, :, 3].double() + shift
        assert torch.equal(after.cameras.camera_to_worlds[:, :, 3], expected.float())
        torch.testing.assert_close(in_box(after), in_box(before), atol=rounding, rtol=0)
        assert ends(after) == pytest.approx(ends(before), rel=max(rounding, 1e-6))
        assert torch.equal(after.pixels, before.pixels)
        assert torch.equal(after.cameras.camera_to_worlds[:, :, :3], before.cameras.camera_to_worlds[:, :, :3])


@pytest.mark.parametrize(("scale", "shift", "rounding"), MOVES)
def test_placing_undoes_scale_and_shift(scale: float, shift: float, rounding: float) -> None:
    """Formats of captures place their cameras, so that a method never sees either."""
    plain, views = moved(BALL, placed=True), moved(BALL, scale, shift, placed=True)
    positions = [torch.cat([v.cameras.camera_to_worlds[:, :, 3] for v in (w.train, w.test)]) for w in (plain, views)]
    assert float(positions[0].abs().max()) == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(positions[0].mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(positions[1], positions[0], atol=rounding, rtol=0)
    for before, after in ((plain.train, views.train), (plain.test, views.test)):
        torch.testing.assert_close(in_box(after), in_box(before), atol=1e-6, rtol=0)
        torch.testing.assert_close(after.scene.box, before.scene.box, atol=rounding, rtol=0)
        assert ends(after) == pytest.approx(ends(before), rel=1e-6)


@pytest.mark.parametrize("placed", [False, True])
def test_the_way_back_to_the_input_is_kept(placed: bool) -> None:
    views = moved(BALL, 3.0, 5.0, placed)
    for before, after in ((BALL.train, views.train), (BALL.test, views.test)):
        given = before.cameras.camera_to_worlds[:, :, 3]
        led = after.scale * (given @ after.transform[:, :3].T + after.transform[:, 3])
        torch.testing.assert_close(led, after.cameras.camera_to_worlds[:, :, 3], atol=1e-5, rtol=1e-5)


def test_the_scene_they_start_from_is_left_alone() -> None:
    def facts(views: Views) -> list[torch.Tensor]:
        sets = (views.train, views.test)
        return [t.clone() for d in sets for t in (d.pixels, d.cameras.camera_to_worlds, d.transform, d.scene.box)]

    before = facts(BALL)
    for change in (transparent, one_pixel, first_image, twice, lambda d: spoiled_pose(d, math.nan)):
        BALL.each(change)
    moved(BALL, 2.0, 3.0)
    moved(BALL, 2.0, 3.0, placed=True)
    assert all(torch.equal(a, b) for a, b in zip(before, facts(BALL), strict=True))


# -- values that are not finite -----------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_one_pixel_of_every_third_batch_is_spoiled(value: float) -> None:
    batch, spoil = draw_batch(BALL.train, 8, "black"), spoiled_pixel(value)
    for step in range(2 * EVERY):
        found = spoil(batch, step)
        assert torch.equal(found.rgb[1:], batch.rgb[1:])
        assert bool(torch.isfinite(found.rgb[0]).all()) == (step % EVERY > 0)
    assert bool(torch.isfinite(batch.rgb).all())
    spoiled = [not bool(torch.isfinite(spoil(batch, step).rgb).all()) for step in range(2 * EVERY)]
    assert [sum(spoiled[:steps]) for steps in range(2 * EVERY)] == [spoiled_batches(n) for n in range(2 * EVERY)]


def test_a_spoiled_pose_is_one_that_formats_refuse() -> None:
    found = spoiled_pose(BALL.train, math.nan)
    with pytest.raises(DataError, match="not finite"):
        check_pose(found.cameras.camera_to_worlds[0], "frame 0")
    assert torch.equal(found.cameras.camera_to_worlds[1:], BALL.train.cameras.camera_to_worlds[1:])
