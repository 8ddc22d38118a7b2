"""Metrics against scikit-image and by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity
from torch.nn import functional

from nerfloom.evaluation.metrics import ms_ssim, psnr, quick_ssim, ssim
from nerfloom.kernels.images.ssim import PHOTOMETRIC


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.3])
def test_ssim_equals_scikit_images(noise: float) -> None:
    torch.manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(0, 6, 40), torch.linspace(0, 4, 53), indexing="ij")
    target = torch.stack([x.sin(), (x * y).cos(), y.cos()], -1) * 0.5 + 0.5
    image = (target + noise * torch.randn_like(target)).clamp(0, 1)
    expected = structural_similarity(
        target.double().numpy(), image.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    print(f"SSIM: off scikit-image's by {abs(ssim(image, target) - expected):.1e}")
    assert ssim(image, target) == pytest.approx(expected, abs=1e-9)


def test_black_against_black_is_alike() -> None:
    black = torch.zeros(20, 20, 3)
    assert ssim(black, black) == pytest.approx(1.0)
    assert psnr(black, black) == 100.0


def test_small_images_are_refused() -> None:
    with pytest.raises(ValueError, match="11x11"):
        ssim(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3))


def test_psnr_by_hand() -> None:
    assert psnr(torch.full((4, 4, 3), 0.6), torch.full((4, 4, 3), 0.5)) == pytest.approx(20.0, abs=1e-4)
    assert psnr(torch.ones(4, 4, 3), torch.zeros(4, 4, 3)) == 0.0
    half = torch.zeros(2, 2, 3)
    half[0] = 0.1
    assert psnr(half, torch.zeros(2, 2, 3)) == pytest.approx(-10 * math.log10(0.005), abs=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("size", [(11, 30), (97, 64)])
def test_quick_ssim_is_ssim_to_a_millionth(size: tuple[int, int], noise: float) -> None:
    torch.manual_seed(0)
    rows, columns = torch.meshgrid(*(torch.linspace(0, 5, n) for n in size), indexing="ij")
    target = torch.stack([rows.sin(), (rows * columns).cos(), columns.cos()], -1) * 0.5 + 0.5
    image = (target + noise * torch.randn_like(target)).clamp(0, 1)
    for pair in ((image, target), (image.double(), target.double()), (image.transpose(0, 1), target.transpose(0, 1))):
        assert quick_ssim(*pair) == pytest.approx(ssim(*pair), abs=1e-6)
    with pytest.raises(ValueError, match="11x11"):
        quick_ssim(image[:10], target[:10])


def test_without_a_kernel_quick_ssim_is_ssim(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PHOTOMETRIC, "implementations", [])
    torch.manual_seed(0)
    image, target = torch.rand(2, 20, 20, 3)
    assert quick_ssim(image, target) == ssim(image, target)


# -- SSIM at five scales ----------------------------------------------------------------------------------------------


def five_scales(image: np.ndarray, target: np.ndarray, kept: np.ndarray | None = None) -> float:
    """Wang, Simoncelli and Bovik 2003, in float64: scipy's filters on one channel after the other.

    With masks, only windows of each scale count that lie on no ignored pixel of the whole image.
    """
    kept = np.ones(image.shape[:2], bool) if kept is None else kept
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def blur(values: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(values, taps, 0), taps, 1)[5:-5, 5:-5]

    found = []
    for x, y in zip(np.moveaxis(image, -1, 0), np.moveaxis(target, -1, 0), strict=True):
        product = 1.0
        for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            mean_x, mean_y = blur(x), blur(y)
            covariance = blur(x * y) - mean_x * mean_y
            variances = blur(x * x) - mean_x**2 + blur(y * y) - mean_y**2
            similar = (2 * covariance + 0.03**2) / (variances + 0.03**2)
            if scale == 4:
                similar *= (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
            side = 2**scale
            inside = np.array(
                [
                    [kept[side * row : side * (row + 11), side * column : side * (column + 11)].all()
                     for column in range(similar.shape[1])]
                    for row in range(similar.shape[0])
                ]
            )  # fmt: skip
            product *= max(similar[inside].mean(), 0.0) ** exponent
            rows, columns = (side // 2 * 2 for side in x.shape)
            x, y = (
                (each[:rows:2, :columns:2] + each[1:rows:2, :columns:2]
                 + each[:rows:2, 1:columns:2] + each[1:rows:2, 1:columns:2]) / 4
                for each in (x, y)
            )  # fmt: skip
        found.append(product)
    return float(np.mean(found))


@pytest.mark.parametrize("size", [(176, 176), (191, 243)])
@pytest.mark.parametrize("amount", [0.01, 0.2, 3.0])
def test_similarity_at_five_scales_is_the_papers(size: tuple[int, int], amount: float) -> None:
    torch.manual_seed(0)
    target = functional.interpolate(torch.rand(1, 3, 20, 20, dtype=torch.float64), size, mode="bicubic")
    target = target[0].permute(1, 2, 0).clamp(0, 1)
    image = (target + amount * torch.randn_like(target)).clamp(0, 1)
    expected = five_scales(image.numpy(), target.numpy())
    assert ms_ssim(image, target) == pytest.approx(expected, abs=1e-12)
    assert ms_ssim(image.float(), target.float()) == pytest.approx(expected, abs=2e-6)


def test_blur_costs_less_at_five_scales_and_a_negative_is_nothing() -> None:
    torch.manual_seed(0)
    target = torch.rand(180, 180, 3)
    assert ms_ssim(target, target) == pytest.approx(1, abs=1e-6)
    blurred = functional.avg_pool2d(target.permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)
    assert ms_ssim(blurred, target) > ssim(blurred, target)
    assert ms_ssim(1 - target, target) == 0
    target[0, 0, 0] = torch.nan
    assert math.isnan(ms_ssim(target, blurred))


def test_images_too_small_for_five_scales_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 176x176 pixels, not 300x175"):
        ms_ssim(torch.rand(175, 300, 3), torch.rand(175, 300, 3))


@pytest.mark.medium
def test_at_five_scales_windows_with_ignored_pixels_do_not_count() -> None:
    torch.manual_seed(0)
    size = 203, 250
    target = functional.interpolate(torch.rand(1, 3, 20, 20, dtype=torch.float64), size, mode="bicubic")
    target = target[0].permute(1, 2, 0).clamp(0, 1)
    image = (target + 0.2 * torch.randn_like(target)).clamp(0, 1)
    kept = torch.ones(size, dtype=torch.bool)
    kept[:, :45] = False
    kept[2, 240] = kept[201, 60] = False
    expected = five_scales(image.numpy(), target.numpy(), kept.numpy())
    assert ms_ssim(image, target, kept) == pytest.approx(expected, abs=1e-12)
    assert ms_ssim(image.float(), target.float(), kept) == pytest.approx(expected, abs=2e-6)
    image[~kept] = target[~kept]
    assert ms_ssim(image, target, kept) == pytest.approx(expected, abs=1e-12)
    assert abs(five_scales(image.numpy(), target.numpy()) - expected) > 0.005  # ignored pixels are not better


def test_without_a_window_of_kept_pixels_there_is_no_similarity() -> None:
    image = torch.rand(180, 190, 3)
    kept = torch.zeros(180, 190, dtype=torch.bool)
    kept[20:31, 30:41] = True
    assert quick_ssim(image, image, kept) == pytest.approx(1)
    assert ms_ssim(image, image, kept) is None
    kept[25, 35] = False
    assert quick_ssim(image, image, kept) is None
