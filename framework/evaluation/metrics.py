"""Image metrics on (H, W, 3) tensors in [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.base.device import to_float64
from nerfloom.kernels.dispatch import Operation
from nerfloom.kernels.images.ssim import PHOTOMETRIC, SIMILARITY, WINDOW, structure, windows_inside
from nerfloom.kernels.images.ssim import ssim as similarity
from nerfloom.splats.resolution import halved

MAX_PSNR = 100.0
"""PSNR of identical images, dB, instead of infinity, which JSON does not support."""
EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of SSIM at five scales, from the finest (Wang, Simoncelli and Bovik 2003, section 3.2)."""
MIN_SIDE_OF_SCALES = WINDOW << (len(EXPONENTS) - 1)
"""Minimum width and height of an image for SSIM at five scales, pixels: 176."""


def psnr(prediction: Tensor, target: Tensor) -> float:
    """Compute the PSNR of `prediction` against `target`, colours in [0, 1], dB; 100 for identical images."""
    return psnr_of_error((to_float64(prediction) - to_float64(target)).square().mean())


def psnr_of_error(error: Tensor) -> float:
    """Return the PSNR of the mean squared `error` () of colours in [0, 1], dB; at most 100."""
    return float(-10 * error.clamp(min=10 ** (-MAX_PSNR / 10)).log10())


def ssim(prediction: Tensor, target: Tensor, counted: Tensor | None = None) -> float:
    """Compute the structural similarity (Wang et al. 2004) with an 11x11 Gaussian window, sigma 1.5, data range 1.

    The result is averaged over windows and channels.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1].
        counted: (H - 10, W - 10) bool, the windows that count; None for all within the image.

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
    similar = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similar = (similar / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)))[:, 0]
    return float((similar if counted is None else similar[:, counted]).mean())


def quick_ssim(prediction: Tensor, target: Tensor, kept: Tensor | None = None) -> float | None:
    """Compute `ssim` in float32 by a kernel, with an error below 1e-6, if the device has one; otherwise in float64.

    In float64 it takes longer than many methods need to render the image.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1].
        kept: (H, W) bool, pixels that count; the mean is over windows of such pixels only. None for all.

    Returns:
        The similarity; None if no window counts.

    Raises:
        ValueError: if the image is smaller than the window.
    """
    if min(prediction.shape[:2]) < WINDOW:
        return ssim(prediction, target)  # raises the error
    counted = None if kept is None else windows_inside(kept)
    if counted is not None and not counted.any():
        return None
    pair = prediction.detach().float(), target.detach().float()
    operation: Operation[..., Tensor] = PHOTOMETRIC if counted is None else SIMILARITY
    arguments = (1.0,) if counted is None else (counted, True)
    if operation.choose(pair, *pair, *arguments) is operation.reference:
        return ssim(prediction, target, counted)
    return float(similarity(*pair, counted))


def ms_ssim(prediction: Tensor, target: Tensor, kept: Tensor | None = None) -> float | None:
    """Compute SSIM at five scales (Wang, Simoncelli and Bovik 2003), the mean over channels.

    A coarser scale has half the width and height, by means of 2 x 2 pixels; an odd last row or column is dropped. All
    scales but the coarsest use contrast and structure only. Negative factors count as 0. For float32 images a kernel
    computes it, if the device has one.

    Args:
        prediction, target: (H, W, 3) colours in [0, 1], of at least 176 x 176 pixels.
        kept: (H, W) bool, pixels that count; None for all. A pixel of a coarser scale counts if all four of its pixels
            do. Each mean is over windows of such pixels only.

    Returns:
        The similarity; None if no window counts at the coarsest scale.

    Raises:
        ValueError: if the window does not fit into the image at the coarsest scale.
    """
    if min(prediction.shape[:2]) < MIN_SIDE_OF_SCALES:
        height, width = prediction.shape[:2]
        least = MIN_SIDE_OF_SCALES
        raise ValueError(f"SSIM at five scales needs at least {least}x{least} pixels, not {width}x{height}")
    counted = [None] * len(EXPONENTS) if kept is None else windows_of_scales(kept)
    if counted[-1] is not None and not counted[-1].any():
        return None
    channels = (each.detach().split(1, dim=-1) for each in (prediction, target))
    return fmean(_ms_ssim_of_channel(x, y, counted) for x, y in zip(*channels, strict=True))


def windows_of_scales(kept: Tensor) -> list[Tensor]:
    """Return the windows (h - 10, w - 10) bool within `kept`, (H, W) from 176 x 176, at five scales, finest first."""
    windows = []
    for _ in EXPONENTS:
        windows.append(windows_inside(kept))
        kept = halved(kept[..., None].float())[..., 0] == 1
    return windows


def _ms_ssim_of_channel(x: Tensor, y: Tensor, counted: Sequence[Tensor | None]) -> float:
    product = 1.0
    for exponent, windows in zip(EXPONENTS[:-1], counted[:-1], strict=True):
        product *= max(float(structure(x, y, windows)), 0.0) ** exponent  # a NaN stays one
        x, y = halved(x), halved(y)
    return product * max(float(similarity(x, y, counted[-1])), 0.0) ** EXPONENTS[-1]
