"""The visual hull: no cell that matters is lost, and no pixel that could see one."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.motion_bound import MotionBound
from nerfloom.dataparsers.blender import Blender
from nerfloom.kernels.images.silhouettes import hold_balls
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import candidates
from nerfloom.scene.moving_hulls import moving_box, moving_hulls
from nerfloom.scene.silhouettes import Silhouettes, pixels_near, visual_hull
from nerfloom.scene.speed import motion_bound
from tests.conftest import write_tiny

BOX = torch.tensor([[-1.2, -1.2, -1.2], [1.2, 1.2, 1.2]])


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A ball of radius 1 seen from 24 sides, 80 pixels wide."""
    folder = write_tiny(tmp_path_factory.mktemp("hull") / "ball", size=80, counts=(24, 1, 1))
    return load_dataset(Blender().parse(folder, "train"), "train")


def centers(resolution: int) -> torch.Tensor:
    index = torch.cartesian_prod(*[torch.arange(resolution)] * 3)
    return BOX[0] + (index + 0.5) * (BOX[1] - BOX[0]) / resolution


@pytest.mark.parametrize("resolution", [7, 16, 32])
def test_the_hull_holds_the_ball_and_little_else(ball: Dataset, resolution: int) -> None:
    hull = visual_hull(Silhouettes.of(ball), BOX, resolution)
    half_diagonal = 1.2 * 3**0.5 / resolution
    distance = centers(resolution).norm(dim=-1)
    assert bool(hull[distance < 1 + half_diagonal].all())  # every cell that touches the ball
    # Cells that lie well within some photograph, and well beside the ball in it.
    seen_empty = torch.zeros(resolution**3, dtype=torch.bool)
    for pose, fx in zip(ball.cameras.camera_to_worlds.double(), ball.cameras.fx.double(), strict=True):
        local = (centers(resolution).double() - pose[:, 3]) @ pose[:, :3]
        depth = -local[:, 2] - half_diagonal
        slack = 3 / fx + 1.3 * half_diagonal / depth  # three pixels, and the cell's own size
        inside = (local[:, :2].abs().amax(-1) / depth < 40 / fx - slack) & (depth > 0)
        angle = torch.atan2(local[:, :2].norm(dim=-1), -local[:, 2])
        seen_empty |= inside & (angle > torch.asin(torch.tensor(1 / 4.0)) + 1.5 * slack)
    assert not bool((hull & seen_empty).any())
    assert resolution < 10 or seen_empty.float().mean() > 0.03


@pytest.mark.medium
def test_every_pixel_that_could_see_the_hull_is_kept(ball: Dataset) -> None:
    resolution = 48
    silhouettes = Silhouettes.of(ball)
    hull = visual_hull(silhouettes, BOX, resolution)
    kept = torch.zeros(len(ball.pixels), dtype=torch.bool)
    kept[pixels_near(silhouettes, hull, BOX, resolution).pixels()] = True
    grid = Occupancy(hull, BOX, resolution)
    for image in range(len(ball)):
        rays = ball.cameras.pixel_rays(ball.cameras.image_pixels(image), 0.1, 20)
        _, _, _, offsets, _ = candidates(rays, grid, 0.01, 0.0, None)
        sees = offsets.diff() > 0
        mine = kept[image * 6400 : (image + 1) * 6400]
        assert not bool((sees & ~mine).any())
    assert 0.15 < kept.float().mean() < 0.95


def test_an_object_that_leaves_the_frame_is_not_cut_off(ball: Dataset) -> None:
    """The photographs are zoomed in until the ball fills them: an object that none shows whole stays."""
    cameras = replace(ball.cameras, fx=ball.cameras.fx * 3, fy=ball.cameras.fy * 3)
    pixels = ball.pixels.clone()
    pixels[:, 3] = 255
    hull = visual_hull(Silhouettes.of(replace(ball, cameras=cameras, pixels=pixels)), BOX, 16)
    assert bool(hull.all())


def test_a_camera_inside_the_box_says_nothing_of_what_is_behind_it(ball: Dataset) -> None:
    poses = ball.cameras.camera_to_worlds.clone()
    poses[:, :, 3] *= 0.3  # 1.2 from the middle
    empty = ball.pixels.clone()
    empty[:, 3] = 0
    one = replace(ball, cameras=replace(ball.cameras, camera_to_worlds=poses), pixels=empty)
    index = torch.tensor([0])
    single = replace(one, cameras=one.cameras[index], pixels=one.pixels[:6400])
    silhouettes = Silhouettes.of(single)
    hull = visual_hull(silhouettes, BOX, 16)
    behind = silhouettes.photograph(0).depth(centers(16)) < 0
    assert bool(hull[behind].all())
    assert not bool(hull.all())


def test_of_a_moving_scene_all_that_is_ever_seen_stays(ball: Dataset) -> None:
    """Half of the photographs are empty: standing still nothing could be there, moving it was there for a while."""
    pixels = ball.pixels.clone()
    pixels[: 12 * 6400, 3] = 0
    silhouettes = Silhouettes.of(replace(ball, pixels=pixels))
    assert not bool(visual_hull(silhouettes, BOX / 2, 16).any())
    times = torch.linspace(0, 1, 24)
    bound = motion_bound(silhouettes, BOX, times)
    assert bound is not None
    hull = moving_hulls(silhouettes, BOX, 16, times, bound)
    assert bool(hull[centers(16).norm(dim=-1) < 1].all())
    assert bool(moving_hulls(silhouettes, BOX / 4, 4, times, bound).all())


def test_of_a_moving_scene_what_all_photographs_show_empty_goes(ball: Dataset) -> None:
    """Far cameras that see the whole box: all of them see the ball in the middle, and none anything by the corners."""
    wide = replace(ball, cameras=replace(ball.cameras, fx=ball.cameras.fx / 3, fy=ball.cameras.fy / 3))
    pixels = torch.zeros_like(wide.pixels).view(24, 80, 80, 4)
    pixels[:, 38:42, 38:42, 3] = 255  # all that any of them shows is in the middle
    times, bound = torch.linspace(0, 1, 24), MotionBound.of(torch.tensor([0.0, 1.0]), torch.tensor([1.2, 1.2]))
    hull = moving_hulls(Silhouettes.of(replace(wide, pixels=pixels.view(-1, 4))), BOX, 16, times, bound)
    assert bool(hull[centers(16).norm(dim=-1) < 0.2].all())
    assert not bool(hull.all())
    assert hull.float().mean() < 0.9


def disc(cameras: Cameras, image: int, center: torch.Tensor, radius: float) -> torch.Tensor:
    """The pixels (H, W) bool with a ray that meets a ball, by the distance between its centre and the ray."""
    rays = cameras.pixel_rays(cameras.image_pixels(image), 0.1, 20)
    apart = (center - rays.origins).cross(rays.directions, dim=-1).norm(dim=-1)
    return (apart < radius).view(int(cameras.heights[image]), int(cameras.widths[image]))


def flight(
    ball: Dataset, place: Callable[[float], torch.Tensor], radius: float, zoom: float = 0.5
) -> tuple[Dataset, torch.Tensor]:
    """Photographs, by default of the whole box, of a ball that flies, and times; neighbours in time see other sides."""
    wide = replace(ball, cameras=replace(ball.cameras, fx=ball.cameras.fx * zoom, fy=ball.cameras.fy * zoom))
    times, pixels = torch.arange(24) * 7 % 24 / 23, torch.zeros_like(wide.pixels).view(24, 80, 80, 4)
    for image, time in enumerate(times.tolist()):
        pixels[image, disc(wide.cameras, image, place(time), radius)] = 255
    return replace(wide, pixels=pixels.view(-1, 4), times=times), times


RADIUS = 0.25
"""Radius of the flying ball."""


def place(time: float) -> torch.Tensor:
    """Where the ball is that flies."""
    return torch.tensor([0.8 * time - 0.4, 0.25 * math.sin(3 * time), 0.15 - 0.3 * time])


@pytest.fixture(scope="module")
def flying(ball: Dataset) -> tuple[Silhouettes, torch.Tensor, MotionBound]:
    """Silhouettes of a ball that flies, their times, and how fast it is."""
    seen, times = flight(ball, place, RADIUS)
    silhouettes = Silhouettes.of(seen)
    bound = motion_bound(silhouettes, BOX, times)
    assert bound is not None
    return silhouettes, times, bound


@pytest.mark.parametrize("slices", [1, 3, 8])
def test_a_flying_ball_is_never_outside_the_hull_of_its_time(
    flying: tuple[Silhouettes, torch.Tensor, MotionBound], slices: int
) -> None:
    """This holds at all times, also between two images; and the hull shrinks with the number of slices."""
    silhouettes, times, bound = flying
    hull = moving_hulls(silhouettes, BOX, 16, times, bound, slices).view(slices, -1)
    cells = centers(16)
    for time in torch.linspace(0, 1, 97).tolist():
        inside = (cells - place(time)).norm(dim=-1) < RADIUS
        assert bool(inside.any())
        assert bool(hull[min(int(time * slices), slices - 1)][inside].all())
    far = (cells - place(0.0)).norm(dim=-1) > 0.8
    assert hull[0][far].float().mean() < {1: 0.15, 3: 0.05, 8: 0.02}[slices]


def test_a_flying_ball_never_leaves_the_smallest_box(flying: tuple[Silhouettes, torch.Tensor, MotionBound]) -> None:
    silhouettes, times, bound = flying
    box = moving_box(silhouettes, BOX, times, bound)
    for time in torch.linspace(0, 1, 97).tolist():
        assert bool((box[0] < place(time) - RADIUS).all())
        assert bool((box[1] > place(time) + RADIUS).all())
    assert float((box[1] - box[0]).prod()) < 0.4 * float((BOX[1] - BOX[0]).prod())


def test_the_box_of_a_scene_that_frames_cut_is_larger(ball: Dataset) -> None:
    """The same ball in the same place: where an image shows matter at its border, there may be more outside."""
    seen, times = flight(ball, lambda time: torch.zeros(3), 0.25, zoom=1.2)
    whole = Silhouettes.of(seen)
    assert whole.closed_if_whole().closed
    pixels = seen.pixels.clone()
    pixels[79, 3] = 255  # a corner of the first image
    cut = Silhouettes.of(replace(seen, pixels=pixels))
    assert not cut.closed_if_whole().closed
    bound = MotionBound.of(torch.tensor([0.0, 1.0]), torch.tensor([1.2, 1.2]))
    small, large = (moving_box(silhouettes, 1.5 * BOX, times, bound) for silhouettes in (whole, cut))
    assert bool((small[0] < -0.25).all())
    assert bool((small[1] > 0.25).all())
    assert bool((large[0] <= small[0]).all())
    assert bool((large[1] >= small[1]).all())
    assert float((small[1] - small[0]).prod()) < 0.95 * float((large[1] - large[0]).prod())


def test_closed_frames_show_the_same_and_nothing_around(ball: Dataset) -> None:
    silhouettes = Silhouettes.of(ball)
    points = torch.rand(500, 3) * 2.4 - 1.2
    for image in (0, 7):
        held = [torch.ones(500, dtype=torch.bool) for _ in range(2)]
        for closed, found in zip((False, True), held, strict=True):
            hold_balls(replace(silhouettes, closed=closed).photograph(image), points, 0.05, found, every=True)
        assert bool((held[0] | ~held[1]).all())  # empty cells stay empty
        assert held[1].float().mean() < held[0].float().mean()
