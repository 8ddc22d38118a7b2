"""The PSNR of diffuse light: closed forms, the mask of normals, and files of light."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import Dataset
from nerfloom.data.diffuse_light import read_diffuse
from nerfloom.evaluation.true_outputs import diffuse_psnr, weighted_psnr
from nerfloom.rendering.outputs import DIFFUSE
from nerfloom.rendering.rendered import Picture
from nerfloom.testing.scenes import ball_in_a_box

GREY = 0.2140411
"""Light of the display colour 0.5 (IEC 61966-2-1)."""


def test_psnr_in_closed_form() -> None:
    truth = torch.tensor([0.5, 0.5, 0.5]).expand(2, 3)
    found = torch.tensor([[0.6, 0.5, 0.5], [0.0, 0.0, 0.0]])
    assert weighted_psnr(found, truth, torch.tensor([1.0, 0.0])) == pytest.approx(-10 * math.log10(0.01 / 3), abs=1e-4)
    mixed = (3 * 0.01 / 3 + 0.25) / 4
    assert weighted_psnr(found, truth, torch.tensor([3.0, 1.0])) == pytest.approx(-10 * math.log10(mixed), abs=1e-4)
    assert weighted_psnr(truth, truth, torch.ones(2)) == 100
    assert weighted_psnr(found, truth, torch.zeros(2)) is None
    broken = weighted_psnr(found, truth, torch.tensor([1.0, torch.nan]))
    assert broken is not None
    assert math.isnan(broken)


@pytest.fixture
def ball(tmp_path: Path) -> Dataset:
    """Images of a ball with files of grey diffuse light."""
    dataset = ball_in_a_box()
    paths = tuple(tmp_path / f"{index}_light.npz" for index in range(len(dataset)))
    for path, (height, width) in zip(paths, dataset.cameras.sizes, strict=True):
        np.savez_compressed(path, diffuse=np.full((int(height), int(width), 3), GREY, np.float32))
    return replace(dataset, light_paths=paths)


def shown(diffuse: Tensor) -> Picture:
    opaque = torch.ones_like(diffuse[..., 0])
    return Picture(diffuse, opaque, opaque, opaque, {DIFFUSE.name: diffuse}, (DIFFUSE,))


def test_light_is_compared_as_display_colours_of_the_object(ball: Dataset) -> None:
    """A file has linear light; pixels beside the ball do not count."""
    alpha = ball.image(0)[..., 3:] / 255
    assert 0 < float(alpha.mean()) < 1
    off = torch.where(alpha > 0, 0.4, 0.9).expand(-1, -1, 3)
    assert diffuse_psnr(shown(off), ball, 0, half=False) == pytest.approx(20, abs=1e-3)
    assert diffuse_psnr(shown(torch.full_like(off, 0.5)), ball, 0, half=False) > 80
    left = torch.full_like(off, 0.4)
    left[:, : left.shape[1] // 2] = 1
    assert diffuse_psnr(shown(left), ball, 0, half=True) == pytest.approx(20, abs=1e-3)
    assert diffuse_psnr(replace(shown(off), accumulation=torch.zeros_like(off[..., 0])), ball, 0, half=False) is None


def test_without_diffuse_light_there_is_no_psnr(ball: Dataset) -> None:
    picture = shown(torch.zeros(*ball.image(0).shape[:2], 3))
    assert diffuse_psnr(replace(picture, extras={}), ball, 0, half=False) is None
    assert diffuse_psnr(picture, replace(ball, light_paths=None), 0, half=False) is None
    assert diffuse_psnr(picture, replace(ball, light_paths=(None,) * len(ball)), 0, half=False) is None


def test_a_larger_file_is_read_at_the_images_size(tmp_path: Path) -> None:
    rows = np.repeat(np.arange(8, dtype=np.float32)[:, None, None], 8, 1).repeat(3, 2)
    np.savez_compressed(tmp_path / "a_light.npz", diffuse=rows)
    assert read_diffuse(tmp_path / "a_light.npz", 4, 4)[:, 0, 0].tolist() == [1, 3, 5, 7]


@pytest.mark.parametrize(
    "stored",
    [
        None,
        {"specular": np.zeros((4, 4, 3), np.float32)},
        {"diffuse": np.zeros((4, 4), np.float32)},
        {"diffuse": np.zeros((4, 4, 3), np.float64)},
        {"diffuse": np.full((4, 4, 3), np.nan, np.float32)},
        {"diffuse": np.full((4, 4, 3), -1, np.float32)},
        {"diffuse": np.zeros((400, 400, 3), np.float32)},
        {"diffuse": np.array([[[None] * 3]])},
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, stored: dict[str, np.ndarray] | None) -> None:
    path = tmp_path / "r_0_light.npz"
    if stored is None:
        path.write_bytes(b"no arrays")
    else:
        np.savez_compressed(path, **stored)
    with pytest.raises(DataError, match=r"r_0_light\.npz"):
        read_diffuse(path, 4, 4)
