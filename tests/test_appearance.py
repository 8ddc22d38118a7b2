"""The spread of light, measured from points seen, in stops that can be computed by hand."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.data.image_files import read_image
from nerfloom.data.light_spread import APPEARANCE_STOPS, MAX_PIXELS, light_of, light_spread
from nerfloom.testing.ball import cameras_at


def scene(seed: int, shape: tuple[int, int] = (90, 120)) -> np.ndarray:
    """Linear colours (H, W, 3) of a view with its own share of dark and bright parts."""
    generator = np.random.default_rng(seed)
    return 0.02 + 0.2 * generator.random((*shape, 1)) ** generator.uniform(0.5, 2) * generator.uniform(0.5, 1, 3)


def stored(linear: np.ndarray) -> np.ndarray:
    linear = linear.clip(0, 1)
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (srgb * 255).round().astype(np.uint8)


def around(count: int) -> Tensor:
    """Poses of cameras on a circle that look at its centre."""
    angles = torch.linspace(0, 5, count)
    return cameras_at(3 * torch.stack([angles.cos(), angles.sin(), 0 * angles], -1), 40.0, 8).camera_to_worlds


def spread(images: list[np.ndarray]) -> float:
    light = torch.from_numpy(np.stack([light_of(image) for image in images]))
    return light_spread(light, around(len(images)))


def test_the_same_view_in_other_exposures_differs_by_their_standard_deviation() -> None:
    stops = np.array([-1.0, 0.0, 1.0])
    found = spread([stored(scene(0) * 2**stop) for stop in stops])
    assert found == pytest.approx(np.sqrt((stops**2).mean()), rel=0.1)


def test_white_balance_counts_too() -> None:
    warm = np.array([2**0.5, 1, 2**-0.5])
    view = 0.1 + 2 * scene(0)
    found = spread([stored(view), stored(view * warm), stored(view / warm)])
    assert found == pytest.approx(0.5 * (2 / 3) ** 0.5, rel=0.1)


def test_the_same_light_on_the_same_view_differs_by_nothing() -> None:
    assert spread([stored(scene(0))] * 5) == 0
    assert spread([stored(scene(0))]) == 0


def test_parts_that_change_on_their_own_are_not_light() -> None:
    """The dark half of a view becomes darker, its bright half brighter: no change is shared."""
    views = []
    for stop in (-0.5, 0.0, 0.5):
        view = scene(0)
        dark = view.mean(-1, keepdims=True) < np.median(view.mean(-1))
        views.append(stored(np.where(dark, view * 2**-stop, view * 2**stop)))
    assert spread(views) < 0.5 * APPEARANCE_STOPS


def test_it_looks_at_opaque_and_kept_pixels_only() -> None:
    image = stored(scene(0, (100, 100)))
    rgba = np.concatenate([image, np.full((100, 100, 1), 255, np.uint8)], -1)
    half = np.zeros((100, 100), bool)
    half[:50] = True
    spoilt = rgba.copy()
    spoilt[50:] = 255
    masked = light_of(spoilt, half)
    assert np.array_equal(masked, light_of(rgba, half))
    spoilt[50:, :, 3] = 0
    assert np.array_equal(light_of(spoilt), masked)
    assert np.isnan(light_of(rgba, np.zeros((100, 100), bool))).all()


def test_it_looks_at_few_pixels() -> None:
    image = stored(scene(0, (1000, 1300)))
    other = np.zeros_like(image)
    step = int(np.ceil((1000 * 1300 / MAX_PIXELS) ** 0.5))
    other[step // 2 :: step, step // 2 :: step] = image[step // 2 :: step, step // 2 :: step]
    assert np.array_equal(light_of(image), light_of(other))


def test_photographs_without_usable_pixels_are_passed_over() -> None:
    nothing = np.full((3, 5), np.nan, np.float32)
    light = np.stack([light_of(stored(scene(0))), nothing, light_of(stored(scene(0) * 2))])
    assert light_spread(torch.from_numpy(light), around(3)) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("stops", [0.0, 0.5])
def test_the_sides_of_a_street_are_not_changing_light(stops: float) -> None:
    """Cameras along a road look ahead at dark trees, left at a grey wall and right at a white one."""
    count = 60
    yaws = torch.tensor([0.0, 90.0, -90.0]).repeat(count // 3).deg2rad()
    poses = torch.zeros(count, 3, 4)
    poses[:, :, 2] = -torch.stack([yaws.cos(), yaws.sin(), 0 * yaws], -1)
    poses[:, 2, 1] = 1
    poses[:, :, 0] = torch.linalg.cross(poses[:, :, 1], poses[:, :, 2])
    poses[:, 0, 3] = torch.linspace(0, 30, count)
    exposures = stops * np.random.default_rng(1).choice([-1, 1], count)
    views = [stored(scene(0) * 2.0 ** ([-2, 0, 1.5][index % 3] + exposures[index])) for index in range(count)]
    light = torch.from_numpy(np.stack([light_of(view) for view in views]))
    assert light_spread(light, poses) == pytest.approx(stops, abs=0.02 + 0.3 * stops)
    assert light_spread(light, around(count)) > 1


CAPTURES = {
    "fern/images_8": False,
    "fox/images": False,
    "colmap_cup/images": False,
    "colmap_desk/images_2": True,
    "statue_of_liberty/images_2": True,
}


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", CAPTURES)
def test_captures_whose_light_varies_are_told_from_others(name: str, real_data: Path) -> None:
    images = [read_image(path) for path in sorted((real_data / name).iterdir()) if path.suffix in (".jpg", ".png")]
    found = spread(images)
    print(f"{name}: {found:.3f} stops")
    assert (found > APPEARANCE_STOPS) is CAPTURES[name]
