"""Sizes and fields of view of cameras, against their definitions."""

import math

import pytest
import torch

from nerfloom.base.colors import color_of
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.framing import framed, perspective, size_of
from nerfloom.geometry.lenses import panorama


def cameras(width: int = 400, height: int = 300, model: str = "pinhole", lens: torch.Tensor | None = None) -> Cameras:
    """Two cameras with a principal point outside of the middle."""
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    numbers = (torch.full((2,), value) for value in (380.0, 390.0, 210.0, 140.0))
    return Cameras(poses, *numbers, torch.full((2,), width), torch.full((2,), height), model, lens)


def opening(focal: torch.Tensor, size: int) -> float:
    """The angle that a side of an image shows, degrees."""
    return math.degrees(2 * math.atan(size / 2 / float(focal[0])))


def test_a_perspective_shows_its_field_of_view_in_the_height_and_more_in_a_wide_image() -> None:
    found = perspective(torch.eye(4)[None, :3], 1920, 1080, 50.0)
    assert opening(found.fy, 1080) == pytest.approx(50, abs=1e-4)
    across = math.degrees(2 * math.atan(1920 / 1080 * math.tan(math.radians(25))))
    assert opening(found.fx, 1920) == pytest.approx(across, abs=1e-4)
    assert (float(found.cx[0]), float(found.cy[0])) == (960, 540)
    assert (found.widths.tolist(), found.heights.tolist()) == ([1920], [1080])
    several = perspective(torch.eye(4)[:3].repeat(2, 1, 1), 100, 100, torch.tensor([90.0, 60.0]))
    torch.testing.assert_close(several.fx, torch.tensor([50.0, 50 * math.sqrt(3)]))


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(None, None, (400, 300)), (800, None, (800, 600)), (None, 150, (200, 150)), (70, 90, (70, 90)), (1, None, (1, 1))],
)
def test_a_side_that_is_not_given_follows_from_the_other(
    width: int | None, height: int | None, size: tuple[int, int]
) -> None:
    assert size_of((400, 300), width, height) == size


def test_images_of_the_same_shape_show_the_same() -> None:
    before, after = cameras(), framed(cameras(), 800)
    for name, factor in (("fx", 2), ("fy", 2), ("cx", 2), ("cy", 2), ("widths", 2), ("heights", 2)):
        torch.testing.assert_close(getattr(after, name), getattr(before, name) * factor)
    same = framed(before)
    for name in ("fx", "fy", "cx", "cy", "widths", "heights"):
        assert torch.equal(getattr(same, name), getattr(before, name))


def test_an_image_of_another_shape_shows_as_large_a_part_of_the_image_plane() -> None:
    before, after = cameras(), framed(cameras(), 640, 640)
    areas = [each.widths / each.fx * each.heights / each.fy for each in (before, after)]
    torch.testing.assert_close(areas[1], areas[0])
    torch.testing.assert_close(after.fx / after.fy, before.fx / before.fy)
    for middle, side, focal in (("cx", "widths", "fx"), ("cy", "heights", "fy")):
        off = [(getattr(each, middle) - getattr(each, side) / 2) / getattr(each, focal) for each in (before, after)]
        torch.testing.assert_close(off[1], off[0])


def test_a_field_of_view_makes_a_pinhole_camera() -> None:
    found = framed(cameras(model="opencv", lens=torch.full((2, 9), 0.01)), 500, 200, fov=40.0)
    assert (found.model, found.lens) == ("pinhole", None)
    torch.testing.assert_close(found.fx, found.fy)
    assert opening(found.fy, 200) == pytest.approx(40, abs=1e-4)
    assert (found.widths.tolist(), found.heights.tolist()) == ([500, 500], [200, 200])


def test_a_panorama_keeps_its_shape() -> None:
    fx, fy, cx, cy = (torch.tensor([value]) for value in panorama(200, 100))
    sizes = torch.tensor([200]), torch.tensor([100])
    whole = Cameras(torch.eye(4)[None, :3], fx, fy, cx, cy, *sizes, "equirectangular")
    for width, height in ((400, 200), (401, 200), (33, 16)):  # sides that are odd have a ratio near 2
        found = framed(whole, width)
        assert (int(found.widths[0]), int(found.heights[0])) == (width, height)
        shown = [float(each) for each in (found.fx, found.fy, found.cx, found.cy)]
        assert shown == pytest.approx(list(panorama(width, height)))
    with pytest.raises(ConfigError, match="keep their aspect ratio"):
        framed(whole, 400, 300)
    assert framed(whole, 400, 300, fov=60).model == "pinhole"


def test_colours_are_named_or_hexadecimal() -> None:
    assert color_of("white") == (1, 1, 1)
    assert color_of("#ff8000") == (1, 128 / 255, 0)
    for wrong in ("red", "#fff", "#gg0000", "ff8000", ""):
        with pytest.raises(ConfigError, match="is not a colour"):
            color_of(wrong)
