"""Reconstructions that something repeated has folded."""

from pathlib import Path

import numpy as np
import pytest

from nerfloom.data.image_files import read_image
from nerfloom.registry import load_dataparser
from nerfloom.scene.folded_poses import folded_neighbours, in_order, thumbnail
from nerfloom.training.data_folder import find_data


def walk(count: int = 60, turns: float = 1.49) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names, angles and thumbnails of photographs from a walk around an object; they change smoothly with the angle."""
    angles = np.linspace(0, 360 * turns, count)
    random = np.random.default_rng(0)
    waves = random.normal(size=(2, 4, 256))
    rates = np.radians(angles)[:, None] * np.arange(1, 5)
    seen = np.cos(rates) @ waves[0] + np.sin(rates) @ waves[1]
    return [f"frame {index}.jpg" for index in range(count)], angles, seen / seen.std(1, keepdims=True)


def looking(angles: np.ndarray) -> np.ndarray:
    """(M, 3) directions of cameras at these angles, degrees, which look at the middle."""
    return -np.stack([np.cos(np.radians(angles)), np.sin(np.radians(angles)), np.zeros(len(angles))], -1)


@pytest.mark.parametrize("repeats", [2, 3, 4])
def test_a_walk_is_folded_where_it_jumps(repeats: int) -> None:
    names, angles, seen = walk()
    period = 360 / repeats
    jumps = np.flatnonzero(np.diff(angles // period))
    found = folded_neighbours(names, looking(angles % period), seen)
    assert found == [(int(i), int(i) + 1) for i in jumps]
    assert len(found) == int(1.49 * repeats)


def test_the_order_is_that_of_the_numbers_in_the_names() -> None:
    names, angles, seen = walk()
    mixed = np.random.default_rng(1).permutation(len(names))
    found = folded_neighbours([names[i] for i in mixed], looking(angles[mixed] % 180), seen[mixed])
    assert [(mixed[i], mixed[j]) for i, j in found] == folded_neighbours(names, looking(angles % 180), seen)
    assert in_order(["b10.jpg", "b9.jpg", "a.jpg", "10.jpg"]) == [3, 2, 1, 0]


def test_what_is_not_folded_is_left_alone() -> None:
    names, angles, seen = walk()
    assert folded_neighbours(names, looking(angles), seen) == []  # all the way around
    elsewhere = angles + 180 * (np.arange(len(angles)) >= 30)
    _, _, other = walk(turns=3.1)
    moved = np.concatenate([seen[:30], other[30:]])  # a second walk that begins on the other side, and shows it
    assert folded_neighbours(names, looking(elsewhere), moved) == []
    mixed = np.random.default_rng(1).permutation(len(names))
    assert folded_neighbours(names, looking(angles % 180), seen[mixed]) == []  # photographs in no order
    assert folded_neighbours(names[:8], looking(angles[:8] * 30 % 180), seen[:8]) == []  # too few


def test_thumbnails_are_box_means_without_brightness_and_contrast() -> None:
    random = np.random.default_rng(0)
    blocks = random.random((16, 16))
    image = (np.kron(blocks, np.ones((4, 4)))[..., None] * np.array([120, 120, 120]) + 50).astype(np.float32)
    expected = ((blocks - blocks.mean()) / blocks.std()).ravel()
    np.testing.assert_allclose(thumbnail(image), expected, atol=1e-4)
    np.testing.assert_allclose(thumbnail(image * 0.5 + 20), expected, atol=1e-4)
    assert np.all(thumbnail(np.full((90, 33, 3), 7, np.uint8)) == 0)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("capture", "pairs"), [("colmap_can", 3), ("colmap_cup", 0), ("colmap_desk", 0), ("fern", 0), ("fox", 0)]
)
def test_of_real_captures_one_is_folded(real_data: Path, capture: str, pairs: int) -> None:
    path, name = find_data(real_data / capture, None)
    parsed = load_dataparser(name)().parse(path, "train")
    seen = np.stack([thumbnail(read_image(image)) for image in parsed.image_paths])
    names = [image.name for image in parsed.image_paths]
    ahead = -parsed.cameras.camera_to_worlds[:, :, 2].numpy()
    assert len(folded_neighbours(names, ahead, seen)) == pairs
