"""Image metrics on (H, W, 3) tensors in [0, 1]."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from framework.base.device import to_float64
from framework.base.extras import install_command
from framework.kernels.ssim import PHOTOMETRIC

MAX_PSNR = 100.0
"""PSNR of identical images, dB, instead of infinity, which JSON cannot hold."""


def psnr(prediction: Tensor, target: Tensor) -> float:
    """Compute the peak signal-to-noise ratio in dB for a peak of 1; 100 for identical images.

    Args:
        prediction, target: colours in [0, 1], of the same shape.
    """
    error = (to_float64(prediction) - to_float64(target)).square().mean().clamp(min=10 ** (-MAX_PSNR / 10))
    return float(-10 * error.log10())


def ssim(prediction: Tensor, target: Tensor) -> float:
    """Compute the structural similarity (Wang et al. 2004) with an 11x11 Gaussian window, sigma 1.5, data range 1.

    It is averaged over the windows inside the image and over channels.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1].

    Raises:
        ValueError: if the image is smaller than the window.
    """
    if min(prediction.shape[:2]) < 11:
        raise ValueError(f"SSIM needs at least 11x11 pixels, not {prediction.shape[1]}x{prediction.shape[0]}")
    prediction, target = to_float64(prediction), to_float64(target)
    offsets = to_float64(torch.arange(-5, 6, device=prediction.device))
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()

    def blur(image: Tensor) -> Tensor:
        return functional.conv2d(functional.conv2d(image, line.view(1, 1, 11, 1)), line.view(1, 1, 1, 11))

    x, y = (image.permute(2, 0, 1)[:, None] for image in (prediction, target))
    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return float((similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean())


def quick_ssim(prediction: Tensor, target: Tensor) -> float:
    """Compute `ssim` by a kernel in float32, which is off by less than 1e-6, if the device has one; else in float64.

    In float64 it takes longer than many methods need to render the image.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1].

    Raises:
        ValueError: if the image is smaller than the window.
    """
    pair = prediction.detach().float(), target.detach().float()
    chosen = PHOTOMETRIC.choose(pair, *pair, 1.0)
    if chosen is PHOTOMETRIC.reference or min(prediction.shape[:2]) < 11:
        return ssim(prediction, target)
    return 1 - float(chosen.run(*pair, 1.0))


def load_lpips() -> tuple[Callable[[Tensor, Tensor], float] | None, str]:
    """Load LPIPS with AlexNet (Zhang et al. 2018), if the `lpips` extra and the network's weights are installed.

    Returns:
        The metric, a function of two images (H, W, 3) in [0, 1], or None; and the network's name, or why it is absent.
    """
    if (advice := install_command("lpips")) is not None:
        return None, f"absent: {advice}"
    weights = Path(torch.hub.get_dir()) / "checkpoints"
    if not list(weights.glob("alexnet-*.pth")):
        return None, f"absent: AlexNet's weights are not in {weights}"
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision warns of renamed arguments
        network = lpips.LPIPS(net="alex", verbose=False).eval()

    def measure(prediction: Tensor, target: Tensor) -> float:
        pair = [(image.float().cpu().permute(2, 0, 1)[None] * 2 - 1) for image in (prediction, target)]
        with torch.no_grad():
            return float(network(*pair))

    return measure, "AlexNet"
