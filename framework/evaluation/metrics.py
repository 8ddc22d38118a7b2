"""Image metrics on (H, W, 3) tensors in [0, 1]."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor
from torch.nn import functional

from framework.base.device import to_float64
from framework.base.extras import install_command
from framework.kernels.ssim import PHOTOMETRIC, WINDOW, structure
from framework.kernels.ssim import ssim as similarity
from framework.splats.resolution import halved

MAX_PSNR = 100.0
"""PSNR of identical images, dB, instead of infinity, which JSON cannot hold."""
EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of SSIM at five scales, from the finest (Wang, Simoncelli and Bovik 2003, section 3.2)."""
SMALLEST_OF_SCALES = WINDOW << (len(EXPONENTS) - 1)
"""Minimum width and height of an image that has SSIM at five scales, pixels: 176."""
FETCH_ALEXNET = "python -c 'import torchvision; torchvision.models.alexnet(weights=\"DEFAULT\")'"
"""Command that downloads the weights on which LPIPS is built, which come in no package."""


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


def ms_ssim(prediction: Tensor, target: Tensor) -> float:
    """Compute SSIM at five scales (Wang, Simoncelli and Bovik 2003), the mean over channels.

    A coarser scale has half the width and height, by means of 2 x 2 pixels; an odd last row or column is left out. Of
    all scales but the coarsest contrast and structure alone count. Factors below 0 count as 0. Of float32 images it is
    computed by a kernel, if the device has one.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1], of at least 176 x 176 pixels.

    Raises:
        ValueError: if the window does not fit into the image at the coarsest scale.
    """
    if min(prediction.shape[:2]) < SMALLEST_OF_SCALES:
        height, width = prediction.shape[:2]
        least = SMALLEST_OF_SCALES
        raise ValueError(f"SSIM at five scales needs at least {least}x{least} pixels, not {width}x{height}")
    channels = (each.detach().split(1, dim=-1) for each in (prediction, target))
    return fmean(_ms_ssim_of_channel(x, y) for x, y in zip(*channels, strict=True))


def _ms_ssim_of_channel(x: Tensor, y: Tensor) -> float:
    product = 1.0
    for exponent in EXPONENTS[:-1]:
        product *= max(float(structure(x, y)), 0.0) ** exponent  # a NaN stays one
        x, y = halved(x), halved(y)
    return product * max(float(similarity(x, y)), 0.0) ** EXPONENTS[-1]


def load_lpips() -> tuple[Callable[[Tensor, Tensor], float] | None, str]:
    """Load LPIPS with AlexNet (Zhang et al. 2018), if the `lpips` extra and the network's weights are installed.

    Returns:
        The metric, a function of two images (H, W, 3) in [0, 1], or None; and the network's name, or why it is absent.
    """
    if (advice := install_command("lpips")) is not None:
        return None, f"absent: {advice}; then AlexNet's weights, which no package has: {FETCH_ALEXNET}"
    weights = Path(torch.hub.get_dir()) / "checkpoints"
    if not list(weights.glob("alexnet-*.pth")):
        return None, f"absent: AlexNet's weights, which no package has, are not in {weights}: {FETCH_ALEXNET}"
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision warns of renamed arguments
        network = lpips.LPIPS(net="alex", verbose=False).eval()

    def measure(prediction: Tensor, target: Tensor) -> float:
        pair = [(image.float().cpu().permute(2, 0, 1)[None] * 2 - 1) for image in (prediction, target)]
        with torch.no_grad():
            return float(network(*pair))

    return measure, "AlexNet"
