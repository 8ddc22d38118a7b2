"""The captures that go wrong have the fault that their pictures are said to show, and nothing else."""

from types import ModuleType

import numpy as np
import pytest

from tests.site.pages import ROOT

pytestmark = pytest.mark.medium


@pytest.fixture
def failures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "building"))
    import failures as module

    monkeypatch.setattr(module, "SIZE", 32)
    monkeypatch.setattr(module, "NUM_TRAIN", 6)
    module.taken.cache_clear()
    return module


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
