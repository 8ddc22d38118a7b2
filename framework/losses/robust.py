"""Pixels that other images contradict: people who walk through, shadows, leaves that move.

A scene that all images share has small errors after some steps. What only one image shows keeps a large error, and it
covers a connected region. RobustNeRF (Sabour et al. 2023) counts a pixel as an inlier

- if its error is below a quantile of recent errors, or
- if most of the 3 x 3 pixels around it are below, so that single pixels of fine texture count, or
- if enough of the 16 x 16 pixels around its tile of 8 x 8 are below, so that edges in an agreeing region count.

The errors of all other pixels have no effect. Patches of rays have 4 x 4 pixels, spread over the same area
(`data/pixels/patches.py`), around a tile of 2 x 2. In whole images the third rule has windows of 16, 8 or 4 pixels, by
their size, around tiles of half the side.

SpotLessSplats (Sabour et al. 2024) takes the quantile from a running histogram, and counts all pixels at first. Here
all pixels count in the first steps, and rays come in patches only afterwards: before there is a scene, large errors are
the scene itself.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from nerfloom.base.config import RobustConfig
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.data.pixels.patches import PATCH, PATCHES_ALONG

NEIGHBOURS, MOST = 3, 0.5
"""Side of a pixel's neighbourhood, and the share of it that must be exceeded."""
ENOUGH, MAX_WINDOW = 0.6, 16
"""Share of a window around a tile that must be exceeded, and the largest side of a window in whole images, pixels."""
BINS_PER_DECADE, DECADES = 128, 8
"""Bins of the histogram of squared errors for a factor of 10, and the number of such factors below 1."""
RECENT_PIXELS, KEPT_BY_IMAGE = 16_384, 0.95
"""Number of single pixels that the histogram remembers, as many as a batch of RobustNeRF; and the share that remains
of it after each whole image, as in SpotLessSplats."""


def error_counts(errors: Tensor, counted: Tensor | None = None) -> Tensor:
    """Return a histogram of squared errors with a logarithmic scale.

    Args:
        errors: (...) squared errors; those outside of the scale, and NaN, are in its first or last bin.
        counted: (...) bool, errors that count; None for all.

    Returns:
        (DECADES * BINS_PER_DECADE,) counts.
    """
    count = DECADES * BINS_PER_DECADE
    bins = ((errors.log10() + DECADES) * BINS_PER_DECADE).clamp(0, count - 1).nan_to_num(count - 1).long().view(-1)
    ones = torch.ones_like(bins, dtype=torch.float32) if counted is None else counted.float().reshape(-1)
    return torch.zeros(count, device=errors.device).index_add_(0, bins, ones)


def error_quantile(counts: Tensor, share: float) -> Tensor:
    """Return a quantile () of squared errors from their histogram; a factor of 10^(1 / BINS_PER_DECADE) is a bin.

    Args:
        counts: (DECADES * BINS_PER_DECADE,) result of `error_counts`, or a weighted sum of several.
        share: share of the errors below the quantile.
    """
    sums = counts.cumsum(0)
    wanted = share * sums[-1]
    place = torch.searchsorted(sums, wanted).clamp(max=len(counts) - 1)
    within = (wanted - (sums[place] - counts[place])) / counts[place].clamp(min=1e-12)
    return 10 ** ((place + within.clamp(0, 1)) / BINS_PER_DECADE - DECADES)


def window_side(image_side: int) -> int:
    """Return the side of the windows of the third rule, pixels: 4, 8 or 16.

    Args:
        image_side: longer side of the image, pixels.
    """
    return min(max(2 ** round(math.log2(max(image_side / PATCHES_ALONG, 1))), 4), MAX_WINDOW)


def inliers(errors: Tensor, threshold: Tensor, window: int, counted: Tensor | None = None) -> Tensor:
    """Return the pixels of patches that other images do not contradict: RobustNeRF (Sabour et al. 2023), section 4.2.

    Tiles lie a quarter of a window or more inside, so that their windows do; a patch of one window has one tile.

    Args:
        errors: (N, H, W) errors of N patches; sides are at least `window`, and multiples of half of it.
        threshold: () error below which a pixel agrees.
        window: side of the windows of the third rule; their tiles have half of it.
        counted: (N, H, W) bool, pixels with an error; None for all. Others neither agree nor disagree.

    Returns:
        (N, H, W) bool.
    """
    below = errors < threshold
    known = torch.ones_like(errors) if counted is None else counted.to(errors.dtype)
    agreeing = below * known

    def most(size: int, stride: int, padding: int, share: float) -> Tensor:
        """Return whether more than a share of the pixels that count agree, in squares of an image (N, H, W)."""
        found, of = (
            avg_pool2d(each[:, None], size, stride, padding, divisor_override=1)[:, 0] for each in (agreeing, known)
        )
        return found > share * of

    near, tile, border = most(NEIGHBOURS, 1, NEIGHBOURS // 2, MOST), window // 2, window // 4
    tiles = most(window, tile, 0, ENOUGH).repeat_interleave(tile, 1).repeat_interleave(tile, 2)
    return below | near | pad(tiles, (border, border, border, border))


def image_inliers(errors: Tensor, threshold: Tensor, counted: Tensor | None = None) -> Tensor:
    """Return the pixels of a whole image that other images do not contradict.

    The rules are those of `inliers`, with a tile around every pixel.

    Args:
        errors: (H, W) errors.
        threshold: () error below which a pixel agrees.
        counted: (H, W) bool, pixels with an error; None for all.

    Returns:
        (H, W) bool.
    """
    height, width = errors.shape
    window = window_side(max(height, width))
    tile, border = window // 2, window // 4
    around = (border, border + -width % tile, border, border + -height % tile)
    known = torch.ones_like(errors, dtype=torch.bool) if counted is None else counted
    found = inliers(pad(errors, around)[None], threshold, window, pad(known, around)[None])[0]
    return found[border : border + height, border : border + width]


class RobustColors(nn.Module):
    """The choice of the pixels that a step learns colours from (`--robust percentile`).

    Args:
        config: settings of the rule.
    """

    counts: Tensor
    """Histogram of recent squared errors."""

    def __init__(self, config: RobustConfig) -> None:
        super().__init__()
        self.quantile, self.steps = config.robust_quantile, config.robust_steps
        self.register_buffer("counts", torch.zeros(DECADES * BINS_PER_DECADE))

    @property
    def threshold(self) -> Tensor:
        """The squared error () below which a pixel agrees with the other images."""
        return error_quantile(self.counts, self.quantile)

    def waits(self, step: int) -> bool:
        """Return whether all pixels still count.

        Args:
            step: number of training steps done.
        """
        return step < self.steps

    def pixel_weights(self, rgb: Tensor, batch: PixelBatch) -> Tensor:
        """Return the factors (P,) of the colour errors of a batch: its own, and 0 for pixels that do not count.

        Args:
            rgb: (P, 3) rendered colours.
            batch: P pixels with their true colours.
        """
        errors = (rgb.detach() - batch.rgb).square().mean(-1)
        known = torch.ones_like(errors, dtype=torch.bool) if batch.weights is None else batch.weights > 0
        self._learn(errors, known, max(1 - len(errors) / RECENT_PIXELS, 0))
        first, threshold = batch.patches * PATCH**2, self.threshold
        of_patches, known_there = (each[:first].view(batch.patches, PATCH, PATCH) for each in (errors, known))
        found = inliers(of_patches, threshold, PATCH, known_there).view(-1)
        weights = torch.cat([found, errors[first:] < threshold]).to(errors)
        return weights if batch.weights is None else weights * batch.weights

    def image_pixels(self, rgb: Tensor, target: Tensor, counted: Tensor | None) -> Tensor:
        """Return the pixels (H, W) bool of a training image that count.

        Args:
            rgb: (H, W, 3) rendered colours.
            target: (H, W, 3) true colours.
            counted: (H, W) bool, pixels that masks keep; None for all.
        """
        errors = (rgb.detach() - target).square().mean(-1)
        self._learn(errors, counted, KEPT_BY_IMAGE)
        found = image_inliers(errors, self.threshold, counted)
        return found if counted is None else found & counted

    def _learn(self, errors: Tensor, counted: Tensor | None, kept: float) -> None:
        self.counts.mul_(kept).add_(error_counts(errors, counted))
