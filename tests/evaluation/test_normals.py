"""The mean angle between normals: closed forms, the mask of Ref-NeRF, and files of normals."""

import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import Dataset
from nerfloom.data.normals import ENDING, files_beside, read_normals
from nerfloom.evaluation.true_outputs import mean_angle, normal_mae
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture
from nerfloom.testing.scenes import ball_in_a_box


def test_angles_in_closed_form() -> None:
    """Small ones too, which the arc cosine in float32 would round to 0, and opposite vectors."""
    truth = torch.tensor([[0.0, 0, 1]]).expand(4, 3)
    angles = [0.0, 1e-3, 90.0, 180.0]
    found = torch.tensor([[math.sin(math.radians(a)), 0, math.cos(math.radians(a))] for a in angles])
    for index, angle in enumerate(angles):
        alone = torch.eye(4)[index]
        assert mean_angle(found, truth, alone) == pytest.approx(angle, abs=1e-5)
    assert mean_angle(found, truth, torch.tensor([1.0, 0, 3, 0])) == pytest.approx(67.5)
    assert mean_angle(found, truth, torch.zeros(4)) is None
    assert mean_angle(torch.zeros(4, 3), truth, torch.ones(4)) == pytest.approx(90)


def test_what_is_not_finite_is_not_hidden() -> None:
    truth, broken = torch.tensor([[0.0, 0, 1]]).expand(2, 3), torch.tensor([1.0, torch.nan])
    for found, weights in ((truth, broken), (truth * broken[:, None], torch.ones(2))):
        angle = mean_angle(found, truth, weights)
        assert angle is not None
        assert math.isnan(angle)


@pytest.fixture
def ball(tmp_path: Path) -> Dataset:
    """Images of a ball with (normal + 1) / 2 as colours, and the same images as their normals."""
    dataset = ball_in_a_box()
    paths = tuple(tmp_path / f"{index}_normal.png" for index in range(len(dataset)))
    for index, path in enumerate(paths):
        iio.imwrite(path, dataset.image(index).numpy())
    return replace(dataset, normal_paths=paths)


def shown(normals: Tensor, opacity: Tensor) -> Picture:
    nothing = torch.zeros_like(opacity)
    return Picture(normals, nothing, nothing, opacity, {NORMALS.name: normals}, (NORMALS,))


def test_the_weight_is_opacity_times_alpha(ball: Dataset) -> None:
    truth = ball.normals_of(0)
    assert truth is not None
    alpha = ball.image(0)[..., 3] / 255
    everywhere = torch.ones_like(alpha)
    assert normal_mae(shown(truth, everywhere), ball, 0, half=False) == pytest.approx(0, abs=1e-4)
    half = truth.clone()
    half[:, : truth.shape[1] // 2] *= -1
    assert normal_mae(shown(half, everywhere), ball, 0, half=True) == pytest.approx(0, abs=1e-4)
    left = float(alpha[:, : truth.shape[1] // 2].sum() / alpha.sum())
    assert normal_mae(shown(half, everywhere), ball, 0, half=False) == pytest.approx(180 * left, abs=1e-3)
    opaque_right = everywhere.clone()
    opaque_right[:, : truth.shape[1] // 2] = 0
    assert normal_mae(shown(half, opaque_right), ball, 0, half=False) == pytest.approx(0, abs=1e-4)


def test_without_normals_there_is_no_angle(ball: Dataset) -> None:
    truth = ball.normals_of(0)
    assert truth is not None
    picture = shown(truth, torch.ones(truth.shape[:2]))
    assert normal_mae(replace(picture, extras={}), ball, 0, half=False) is None
    assert normal_mae(picture, replace(ball, normal_paths=None), 0, half=False) is None
    assert normal_mae(picture, replace(ball, normal_paths=(None,) * len(ball)), 0, half=False) is None
    assert normal_mae(replace(picture, accumulation=torch.zeros(truth.shape[:2])), ball, 0, half=False) is None


def test_normals_are_found_beside_images(tmp_path: Path) -> None:
    images = [tmp_path / "r_0.png", tmp_path / "r_1.png"]
    assert files_beside(images, ENDING) is None
    (tmp_path / "r_1_normal.png").touch()
    assert files_beside(images, ENDING) == (None, tmp_path / "r_1_normal.png")


def test_a_larger_file_is_read_at_the_images_size(tmp_path: Path) -> None:
    stored = np.full((8, 8, 3), 128, np.uint8)
    stored[:4, :, 2], stored[4:, :, 0] = 255, 255
    iio.imwrite(tmp_path / "a_normal.png", stored)
    found = read_normals(tmp_path / "a_normal.png", 4, 4)
    assert found.shape == (4, 4, 3)
    torch.testing.assert_close(found[0, 0], torch.tensor([0.0, 0, 1]), atol=5e-3, rtol=0)
    torch.testing.assert_close(found[3, 0], torch.tensor([1.0, 0, 0]), atol=5e-3, rtol=0)


@pytest.mark.parametrize("stored", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.uint16), None])
def test_other_files_are_refused_by_name(tmp_path: Path, stored: np.ndarray | None) -> None:
    path = tmp_path / "r_0_normal.png"
    if stored is None:
        path.write_bytes(b"no image")
    else:
        iio.imwrite(path, stored) if stored.dtype == np.uint8 else iio.imwrite(path, stored[..., 0])
    with pytest.raises(DataError, match=r"r_0_normal\.png"):
        read_normals(path, 4, 4)
