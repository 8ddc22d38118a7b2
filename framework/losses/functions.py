"""Losses: pure functions of tensors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import distortion, ray_sum
from nerfloom.kernels.histograms.spacing import to_disparity

MAX_DEVIATIONS = 3.0
"""A ray should end within this many standard deviations of a known distance."""
WRONG_SHARE = 0.01
"""Assumed fraction of wrong points in a reconstruction."""
MIN_DEPTH, MIN_OPACITY = 1e-6, 1e-6
"""Minimum depth and opacity in divisions for inverse depths."""


def mean_squared_error(prediction: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the mean () of weight * (prediction - target)^2 over all elements; 0 for empty input.

    Args:
        prediction: (R, C) predicted values.
        target: (R, C) true values.
        weights: (R,) factor of each row; None for 1.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    squares = (prediction - target).square()
    return squares.mean() if weights is None else (squares * weights[:, None]).mean()


def charbonnier(prediction: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the mean () of weight * sqrt((prediction - target)^2 + 0.001^2) over all elements; 0 for empty input.

    mip-NeRF 360 (Barron et al. 2022), section 5: a smooth absolute error, less sensitive to outliers than a squared
    one.

    Args:
        prediction: (R, C) predicted values.
        target: (R, C) true values.
        weights: (R,) factor of each row; None for 1.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    errors = ((prediction - target).square() + 1e-3**2).sqrt()
    return errors.mean() if weights is None else (errors * weights[:, None]).mean()


def doubted_error(rgb: Tensor, true: Tensor, doubt: Tensor, least: float, weights: Tensor | None = None) -> Tensor:
    """Return the error () of colours in units of their uncertainty, which must not be large: NeRF-W, equation 13.

    It is the negative logarithm of a normal distribution, mean(e^2 / (2 doubt^2) + log(doubt / least)), times
    2 least^2, so that it is the mean squared error where the uncertainty is least.

    Args:
        rgb: (P, 3) rendered colours.
        true: (P, 3) true colours.
        doubt: (P,) standard deviation of each pixel's colour.
        least: the least standard deviation.
        weights: (P,) factor of each pixel; None for 1.
    """
    if not len(rgb):
        return rgb.sum()
    ratio = doubt / least
    each = (rgb - true).square().mean(-1) / ratio.square() + 2 * least**2 * ratio.log()
    return (each if weights is None else each * weights).mean()


def normalised_distortion(weights: Tensor, samples: Samples, scale: float | None = None) -> Tensor:
    """Return the mean distortion () of rays in normalised distance: mip-NeRF 360 (Barron et al. 2022), equation 15.

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples, with their edges in normalised distance, as a `ProposalSampler` returns them.
        scale: length unit for samples without such edges: normalised distance is half the distance up to this length,
            and disparity beyond (`to_disparity`).

    Raises:
        ValueError: if the samples have no such edges and `scale` is None.
    """
    if samples.edges is not None:
        return distortion(weights, Samples.regular(samples.edges[:, :-1], samples.edges[:, 1:])).mean()
    if scale is None:
        raise ValueError("these samples have no edges in normalised distance: use a ProposalSampler or give a scale")
    starts, ends = (to_disparity(t / scale) for t in (samples.t_starts, samples.t_ends))
    return distortion(weights, replace(samples, t_starts=starts, t_ends=ends)).mean()


def depth_error(weights: Tensor, samples: Samples, known: Tensor) -> Tensor:
    """Return the mean relative depth error () of rays, each sum_i w_i min(|t_i - d| / d, 1).

    Unlike the error of the expected depth, it is small only if all weight is at the known depth.

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples.
        known: (R,) known distances d along the rays, scene units; 0 if unknown, for rays without an error.
    """
    has_depth = known > 0
    depths = torch.where(has_depth, known, torch.ones_like(known))[samples.ray_indices]
    # Without the bound, far samples, which are sparse when spaced in disparity, would dominate the mean.
    apart = ((samples.t - depths).abs() / depths).clamp(max=1)
    # Not indexed by `[has_depth]`: its size would have to be read from the device.
    return (ray_sum(weights * apart, samples) * has_depth).sum() / has_depth.sum().clamp(min=1)


def matter_before(weights: Tensor, samples: Samples, clear: Tensor) -> Tensor:
    """Return the mean optical depth () before the distances `clear`, where rays should be empty; 0 without rays.

    A ray's term is -log((1 - B + e) / (1 + e)): B is the fraction of light stopped before that distance, e is
    `WRONG_SHARE`. This is the optical depth with an upper bound, so that a wall seen in all images remains.

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples.
        clear: (R,) distances along the rays, scene units.
    """
    before = samples.t_ends < clear[samples.ray_indices]
    left = (1 - ray_sum(weights * before, samples)).clamp(min=0)
    return -((left + WRONG_SHARE) / (1 + WRONG_SHARE)).log().sum() / max(len(left), 1)


def distance_likelihood(weights: Tensor, samples: Samples, known: Tensor, deviations: Tensor) -> Tensor:
    """Return the mean negative log-likelihood () of rays ending at known distances of points.

    With B the light stopped before the point, and H the light stopped at it, a ray's term is

        -log((H + e (1 - B) + e^2) / (1 + e + e^2)),     e = `WRONG_SHARE`

    The first summand is DS-NeRF's (Deng et al. 2022): a ray ends at its point. Its term is the optical depth before the
    point, with a gradient that does not vanish behind dense fog, plus the light missing at the point. The other
    summands allow for wrong points: with probability e the surface is somewhere behind and the space before is still
    empty; with probability e^2 nothing is known. "At the point" means all intervals that overlap `MAX_DEVIATIONS`
    standard deviations around it, counted in full, so that no sample has to be narrower than the sampler makes it
    (Rematas et al. 2022, Urban Radiance Fields, shrink the window by a schedule instead).

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples.
        known: (R,) known distances along the rays, scene units; 0 if unknown, for rays without a term.
        deviations: (R,) their standard deviations.
    """
    has_point = known > 0
    first, last = known - MAX_DEVIATIONS * deviations, known + MAX_DEVIATIONS * deviations
    owners = samples.ray_indices
    before = samples.t_ends < first[owners]
    there = ~before & (samples.t_starts <= last[owners])
    stopped, hit = ray_sum(torch.stack([weights * before, weights * there], dim=-1), samples).unbind(-1)
    likelihood = (hit + WRONG_SHARE * (1 - stopped).clamp(min=0) + WRONG_SHARE**2) / (1 + WRONG_SHARE + WRONG_SHARE**2)
    return -(likelihood.log() * has_point).sum() / has_point.sum().clamp(min=1)


def mean_depth_error(distances: Tensor, transmittance: Tensor, known: Tensor) -> Tensor:
    """Return the mean relative error () of rendered distances of pixels, at most 1 each, where they are known.

    Args:
        distances: (H, W) sums of weight times distance.
        transmittance: (H, W).
        known: (H, W) true distances, 0 where unknown.
    """
    opacity = 1 - transmittance
    counts = (known > 0) & (opacity.detach() > 0.5)
    mean = distances / opacity.clamp(min=0.5)
    apart = ((mean - known).abs() / known.clamp(min=1e-6)).clamp(max=1)
    return torch.where(counts, apart, 0).sum() / counts.sum().clamp(min=1)


def density_before(samples: Samples, distance: float) -> Tensor:
    """Return the mean optical depth () of rays up to a distance from the camera: FreeNeRF, equation 6.

    Yang et al. 2023 add up the densities of the first samples, which have equal lengths there. Matter right before a
    camera is seen by that camera alone, so few images do not contradict it.

    Args:
        samples: N samples of R rays, with density.
        distance: length of the ray, scene units, that should be empty.

    Raises:
        ValueError: if the samples have no density.
    """
    if samples.sigma is None:
        raise ValueError("density_before() needs samples with a density")
    lengths = (samples.t_ends.clamp(max=distance) - samples.t_starts).clamp(min=0)
    return (samples.sigma * lengths).sum() / max(samples.num_rays, 1)
