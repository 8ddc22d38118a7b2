"""Structural similarity (SSIM) of an image and its target, and the loss on whole images based on it.

Definition: Wang, Bovik, Sheikh and Simoncelli 2004, "Image quality assessment: from error visibility to structural
similarity". Each window p has 11 x 11 pixels, weighted by a Gaussian g of sigma 1.5. With the means m, variances s and
the covariance s_xy in it of an image x and its target y:

    S(p) = (2 m_x m_y + C1) (2 s_xy + C2) / ((m_x^2 + m_y^2 + C1) (s_xx + s_yy + C2))

The compiled form uses the sum u = x + y - 1 and the difference v = x - y:

    S(p) = (1 - m_v^2 / (m_x^2 + m_y^2 + C1)) (1 - s_vv / ((s_uu + s_vv) / 2 + C2))

Only u, v, u^2 and v^2 are blurred, and 1 - S is small without cancellation if the images are similar. The derivative by
a pixel q, with E for the blurred squares, is a sum over the windows that contain the pixel:

    sum_p g(q - p) (dS/dm(p) + 2 u(q) dS/dE[u^2](p) + 2 v(q) dS/dE[v^2](p))

Pixels may have weights. The absolute error of a pixel is multiplied by its weight, and 1 - S of a window by the least
weight of its pixels, so that a pixel of weight 0 has no effect on the loss.

The loss is a single number, and so is its incoming gradient. The derivative is computed together with the value, while
rows are in the processor's cache, and the backward pass only multiplies it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.known_gradient import KnownGradient
from nerfloom.kernels.triton_backend import later

WINDOW = 11
"""Pixels along each side of the window."""
SIGMA = 1.5
"""Standard deviation of the window's Gaussian, in pixels."""
C1, C2 = 0.01**2, 0.03**2
"""Constants that bound the quotients of dark and of flat windows, for values in [0, 1]."""


def ssim(image: Tensor, target: Tensor, counted: Tensor | None = None) -> Tensor:
    """Return the mean structural similarity of an image and its target: 1 where they are equal.

    This is `nerfloom.evaluation.metrics.ssim`, which is for measurements: in float64, without gradient. A NaN among the
    values makes the result NaN.

    Args:
        image: (H, W, C) values, assumed to be in [0, 1]. Compiled with its first derivative.
        target: (H, W, C) values to compare with. A gradient of the target uses the slow reference.
        counted: (H - 10, W - 10) bool, the windows that count, by their first pixel (`windows_inside`); None for all
            inside the image. With it, only the reference has a gradient.

    Returns:
        The mean over channels and over the windows that count, a tensor without dimensions.

    Raises:
        ValueError: The shapes differ or do not fit images, a side is shorter than the window, or no window counts.
    """
    _check(image, target)
    _check_window(image, counted)
    if counted is not None:
        return SIMILARITY((image, target), image, target, counted, True)
    return 1 - PHOTOMETRIC((image, target), image, target, 1.0)


def windows_inside(kept: Tensor) -> Tensor:
    """Return the windows with kept pixels only, (H - 10, W - 10) bool, each at the position of its first pixel.

    Args:
        kept: (H, W) bool; each side has at least 11 pixels.
    """
    return least_in_windows(kept.float()) == 1


def least_in_windows(weights: Tensor) -> Tensor:
    """Return the least weight in each window, (H - 10, W - 10), at the position of its first pixel.

    Args:
        weights: (H, W) weights of pixels; each side has at least 11 pixels.
    """
    least = -weights[None]  # a maximum along one axis after the other takes less time than over both
    for size in ((WINDOW, 1), (1, WINDOW)):
        least = torch.nn.functional.max_pool2d(least, size, 1)
    return -least[0]


def _check(image: Tensor, target: Tensor) -> None:
    if image.ndim != 3 or image.shape != target.shape or image.shape[2] < 1:
        raise ValueError(f"SSIM needs two images (H, W, C), not {tuple(image.shape)} and {tuple(target.shape)}")


def _check_window(image: Tensor, counted: Tensor | None) -> None:
    height, width = image.shape[:2]
    if min(height, width) < WINDOW:
        raise ValueError(f"SSIM needs at least {WINDOW}x{WINDOW} pixels, not {width}x{height}")
    if counted is not None and counted.shape != (height - WINDOW + 1, width - WINDOW + 1):
        raise ValueError(f"an image of {width}x{height} pixels has no windows of shape {tuple(counted.shape)}")
    if counted is not None and not counted.any():
        raise ValueError("SSIM needs at least one window that counts")


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None) -> Tensor:
    """Return the loss of an image: (1 - w) times the mean absolute error, plus w times (1 - SSIM).

    Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", equation 7. The compiled form
    computes both terms and their derivative in one sweep over the images.

    Args:
        image: (H, W, C) values, assumed to be in [0, 1]. Compiled with its first derivative.
        target: (H, W, C) values to compare with. A gradient of the target uses the slow reference.
        ssim_weight: w, between 0 and 1. An image smaller than the window has no SSIM: its loss is the error alone.
        weights: (H, W) factors of the pixels' errors, without a gradient; a window has the least of its pixels'. Means
            are over all pixels and windows. None for 1.

    Returns:
        A tensor without dimensions.

    Raises:
        ValueError: The shapes differ or do not fit images.
    """
    _check(image, target)
    if weights is not None and weights.shape != image.shape[:2]:
        raise ValueError(f"an image {tuple(image.shape)} needs weights of its pixels, not {tuple(weights.shape)}")
    if ssim_weight == 0 or min(image.shape[:2]) < WINDOW:
        return weighted_error(image, target, weights)
    return PHOTOMETRIC((image, target, weights), image, target, ssim_weight, weights)


def photometric_reference(image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None) -> Tensor:
    """Compute `photometric_loss` of `image`, `target`, `ssim_weight` and `weights` in torch, with all derivatives."""
    by_means, by_variances = _similarities(image, target)
    dissimilar = 1 - by_means * by_variances
    if weights is not None:
        dissimilar = dissimilar * least_in_windows(weights)[..., None]
    return (1 - ssim_weight) * weighted_error(image, target, weights) + ssim_weight * dissimilar.mean()


def weighted_error(image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
    """Return the mean of weight times absolute error, a tensor without dimensions.

    Args:
        image: (H, W, C) values.
        target: (H, W, C) values to compare with.
        weights: (H, W) factors of the pixels; None for 1.
    """
    errors = (image - target).abs()
    return errors.mean() if weights is None else (errors * weights[..., None]).mean()


def structure(image: Tensor, target: Tensor, counted: Tensor | None = None) -> Tensor:
    """Return the mean of S without its first factor, which compares means; contrast and structure remain.

    SSIM at several scales (Wang, Simoncelli and Bovik 2003) uses it for all scales but the coarsest. `image`, `target`,
    `counted`, the result and errors are as in `ssim`; the compiled form has no derivative. With NaN the result is NaN.
    """
    _check(image, target)
    _check_window(image, counted)
    return SIMILARITY((image, target), image, target, counted, False)


def similarity_reference(image: Tensor, target: Tensor, counted: Tensor | None, of_means: bool) -> Tensor:
    """Compute `ssim` or `structure` over some windows, in torch, with derivatives of any order by both images.

    Args:
        image: (H, W, C) values, on any device, of any float type.
        target: (H, W, C) values to compare with.
        counted: (H - 10, W - 10) bool, the windows that count; None for all.
        of_means: whether to include the first factor of S, which compares means (`ssim`); otherwise `structure`.
    """
    by_means, by_variances = _similarities(image, target)
    similar = by_means * by_variances if of_means else by_variances
    return (similar if counted is None else similar[counted]).mean()


def _similarities(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two factors of S, by means and by variances, of each window and channel."""
    maps = torch.cat([image, target, image * image, target * target, image * target], dim=-1)
    mean_x, mean_y, square_x, square_y, product = _blurred(maps).chunk(5, dim=-1)
    variance_x, variance_y, covariance = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    of_means = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return of_means, (2 * covariance + C2) / (variance_x + variance_y + C2)


def _blurred(values: Tensor) -> Tensor:
    """Return the weighted sums of values (H, W, C) over each window inside the image, (H - 10, W - 10, C)."""
    weights = [math.exp(-((offset - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for offset in range(WINDOW)]
    line = [weight / math.fsum(weights) for weight in weights]
    for dim in (0, 1):
        size = values.shape[dim] - WINDOW + 1
        total = line[0] * values.narrow(dim, 0, size)
        for k in range(1, WINDOW):
            total = torch.add(total, values.narrow(dim, k, size), alpha=line[k])
        values = total
    return values


PHOTOMETRIC = Operation("photometric", photometric_reference)
SIMILARITY = Operation("similarity", similarity_reference)
_photometric = native.Function("photometric", "ppqqqffpppi", "d")


@PHOTOMETRIC.implementation(CPP, differentiable=1)
def _compiled(image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None) -> Tensor:
    image, target = image.contiguous(), target.contiguous()
    weights = None if weights is None else weights.contiguous()
    derivative = torch.empty_like(image) if image.requires_grad and torch.is_grad_enabled() else None
    least = None if weights is None else least_in_windows(weights)
    value = _photometric(
        native.pointer(image, "the image", image.shape), native.pointer(target, "the target", image.shape),
        *image.shape, ssim_weight, C1,
        None if weights is None else native.pointer(weights, "the weights", image.shape[:2]),
        None if least is None else native.pointer(least, "the windows' weights", least.shape),
        None if derivative is None else derivative.data_ptr(), native.threads(),
    )  # fmt: skip
    found = image.new_tensor(value)
    return found if derivative is None else KnownGradient.apply((found, derivative), image)


@SIMILARITY.implementation(CPP, order=0)
def _compiled_similarity(image: Tensor, target: Tensor, counted: Tensor | None, of_means: bool) -> Tensor:
    image, target = image.contiguous(), target.contiguous()
    counts = None if counted is None else counted.to(image).contiguous()
    windows = image.shape[0] - WINDOW + 1, image.shape[1] - WINDOW + 1
    value = _photometric(
        native.pointer(image, "the image", image.shape), native.pointer(target, "the target", image.shape),
        *image.shape, 1.0, C1 if of_means else math.inf, None,
        None if counts is None else native.pointer(counts, "the windows that count", windows),
        None, native.threads(),
    )  # fmt: skip
    share = 1.0 if counts is None else counts.mean(dtype=torch.float64).item()  # the kernel's mean is over all windows
    return image.new_tensor(1 - value / share)


PHOTOMETRIC.implementation(TRITON, differentiable=1)(later("images.ssim_triton", "photometric_loss"))
