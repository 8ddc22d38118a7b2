"""Metrics against scikit-image and by hand."""

import math

import pytest
import torch
from skimage.metrics import structural_similarity

from framework.evaluation.metrics import psnr, quick_ssim, ssim
from framework.kernels.ssim import PHOTOMETRIC


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
