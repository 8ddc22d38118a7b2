"""The captures that go wrong have the fault that their pictures are said to show, and nothing else."""

from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
import torch

from nerfloom import Cameras
from nerfloom.geometry.lenses import LENSES
from tests.site.pages import ROOT

pytestmark = pytest.mark.medium


@pytest.fixture(scope="module")
def failures() -> Iterator[ModuleType]:
    """Views of the scene are taken once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "building"))
        import failures as module

        patch.setattr(module, "SIZE", 32)
        patch.setattr(module, "NUM_TRAIN", 6)
        yield module
        module.taken.cache_clear()


def test_masks_hide_exactly_what_moved(failures: ModuleType) -> None:
    faulty, helped = failures.motion()
    covered = 0
    for index, still in enumerate(failures.still().images):
        changed = (faulty.images[index] != still).any(-1)
        assert not (changed & helped.masks[index]).any()
        assert np.array_equal(helped.images[index], faulty.images[index])
        covered += int((~helped.masks[index]).sum())
        assert changed.any() == (index % 3 < 2)
    assert 0.02 < covered / (6 * 32 * 32) < 0.3


def test_the_balloon_is_a_ball_where_it_is_placed(failures: ModuleType) -> None:
    """Seen along an axis at a distance of 4, a ball of radius r is a disk of radius f r / sqrt(16 - r^2) pixels."""
    _, covered = failures.balloon(np.eye(4), np.array([0.0, 0.0, -4.0]))
    focal = 16 / np.tan(failures.CAMERA_ANGLE / 2)
    radius = focal * failures.BALL / np.sqrt(16 - failures.BALL**2)
    assert covered.sum() == pytest.approx(np.pi * radius**2, rel=0.1)
    rows, columns = np.nonzero(covered)
    assert rows.mean() == pytest.approx(15.5)
    assert columns.mean() == pytest.approx(15.5)


def test_photographs_that_are_left_out_are_the_blurred_ones(failures: ModuleType) -> None:
    faulty, helped = failures.blur()
    sharp = [np.array_equal(a, b) for a, b in zip(faulty.images, failures.still().images, strict=True)]
    assert [index for index, same in enumerate(sharp) if same] == list(helped.settings["train_image_indices"])


def test_poses_are_off_by_what_is_said(failures: ModuleType) -> None:
    faulty, _ = failures.poses()
    for wrong, right in zip(faulty.poses, failures.still().poses, strict=True):
        turned = np.arccos((np.trace(wrong[:3, :3] @ right[:3, :3].T) - 1) / 2)
        assert np.degrees(turned) == pytest.approx(1.5, rel=1e-3)
        assert np.array_equal(wrong[:3, 3], right[:3, 3])


def test_plain_surroundings_are_white_outside_of_the_masks(failures: ModuleType) -> None:
    faulty, helped = failures.texture()
    for image, mask in zip(faulty.images, helped.masks, strict=True):
        assert image[~mask].min() > 0.4  # half covered pixels of a dark solid at the least
        assert np.mean(image[~mask]) > 0.95


def test_the_lens_shows_what_a_pinhole_shows_elsewhere(failures: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene has directions as colours: each pixel has the colour of its direction by the lens."""
    x, y = failures.pinhole_of(np.array([0.2, 0.36]), np.array([-0.3, 0.36]))
    squared = x * x + y * y
    np.testing.assert_allclose(x * (1 + failures.K1 * squared), [0.2, 0.36], atol=1e-12)
    np.testing.assert_allclose(y * (1 + failures.K1 * squared), [-0.3, 0.36], atol=1e-12)

    def of_directions(split: str, count: int, index: int, margin: int = 0) -> tuple[np.ndarray, None]:
        return failures.directions(np.eye(4), margin), None

    monkeypatch.setattr(failures, "photograph", of_directions)
    faulty, helped = failures.lens()
    assert (faulty.lens, helped.lens) == ({}, {"k1": failures.K1})
    square = torch.full((1,), failures.focal()), torch.full((1,), 16.0), torch.full((1,), 32)
    coefficients = torch.tensor([[failures.K1, *[0.0] * (len(LENSES["opencv"]) - 1)]])
    intrinsics = [value for value in square for _ in "xy"]
    camera = Cameras(torch.eye(4)[None, :3], *intrinsics, model="opencv", lens=coefficients)
    columns, rows, _ = camera.project(torch.from_numpy(faulty.images[0]).float().view(-1, 3), 0)
    expected = torch.arange(32.0)
    torch.testing.assert_close(columns.view(32, 32), expected.expand(32, 32), atol=0.02, rtol=0)
    torch.testing.assert_close(rows.view(32, 32), expected[:, None].expand(32, 32), atol=0.02, rtol=0)


def test_folded_cameras_stand_on_one_half_of_the_circle(failures: ModuleType) -> None:
    faulty, helped = failures.repeats()
    there = np.array([pose[:3, 3] for pose in faulty.poses])
    before = np.array([pose[:3, 3] for pose in helped.poses])
    assert (there[:, 1] >= 0).all()
    assert 0 < (before[:, 1] < 0).sum() < 6
    np.testing.assert_allclose(np.linalg.norm(there, axis=1), np.linalg.norm(before, axis=1))
    for pose in faulty.poses:  # and look at the middle, upright
        np.testing.assert_allclose(pose[:3, 2], pose[:3, 3] / np.linalg.norm(pose[:3, 3]), atol=1e-6)


def test_what_is_cut_out_differs_in_the_masks_meaning_alone(failures: ModuleType) -> None:
    faulty, helped = failures.cutout()
    assert (faulty.settings["masks"], helped.settings["masks"]) == ("ignored", "empty")
    assert all(np.array_equal(a, b) for a, b in zip(faulty.masks, helped.masks, strict=True))
    assert 0.1 < np.mean(faulty.masks) < 0.5
