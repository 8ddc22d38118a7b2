"""Images of reduced sizes: training goes from coarse to fine."""

from __future__ import annotations

import math
from collections import Counter

import torch
from torch import Tensor

from nerfloom.base.pace import Pace, StepTimes

REDUCED_SHARE = 0.4
"""Share of the budget for reduced images if there are enough steps at full size."""
MIN_STEPS_FULL_SIZE, SHARE_POWER, MIN_WHOLE_SHARE = 700, 0.7, 0.1
"""Number of full-size steps that counts as enough; exponent of the full-size share as a function of the number of
steps; minimum full-size share."""
MIN_SIDE = 150
"""Minimum side of a square with the area of a reduced image, pixels."""
QUICKER = 3.0
"""Assumed ratio of step times with full and half-size images, until both are measured."""


def octaves_at(progress: float, share: float, most: int) -> int:
    """Return the number of halvings of the images at a point of the run.

    Images are halved once during `share` of the budget, twice in its first half, three times in its first quarter, and
    so on. Each size takes the same time as all smaller ones together.

    Args:
        progress: share of the budget that is spent.
        share: share of the budget for reduced images.
        most: maximum number of times that an image is halved.
    """
    octaves = 0
    while octaves < most and progress < share / 2**octaves:
        octaves += 1
    return octaves


def share_for(steps: float) -> float:
    """Return the share of the budget for reduced images.

    Args:
        steps: number of steps at full size that fit into the whole budget.
    """
    whole = (1 - REDUCED_SHARE) * min(steps / MIN_STEPS_FULL_SIZE, 1.0) ** SHARE_POWER
    return 1 - max(whole, MIN_WHOLE_SHARE)


def most_octaves(pixels: float) -> int:
    """Return the maximum number of halvings: at least 1, and more while the side stays above `MIN_SIDE`.

    Args:
        pixels: number of pixels of the whole image.
    """
    return max(int(math.log2(max(math.sqrt(pixels) / MIN_SIDE, 1.0))), 1)


class ImageSizes:
    """Sizes of the training images over a run.

    Args:
        share: share of the budget for reduced images, until steps have been measured.
        most: maximum number of times that an image is halved.
        paced: whether measured steps change the share. The first steps are then at full size, to know how long one
            takes.
    """

    def __init__(self, share: float, most: int, paced: bool) -> None:
        self.share, self.most, self.paced = share, most, paced
        self.steps: Counter[int] = Counter()
        """Number of steps so far, by number of halvings."""
        self._times, self._octaves = StepTimes(), 0

    def next(self, progress: float) -> int:
        """Return the number of halvings for the next step.

        Args:
            progress: share of the budget that is spent.
        """
        unknown = self.paced and self.share > 0 and self._times.of(0) is None
        octaves = 0 if unknown else octaves_at(progress, self.share, self.most)
        self.steps[octaves] += 1
        self._octaves = octaves
        return octaves

    def learn(self, pace: Pace) -> None:
        """Measure the last step. Its images had the size of the last `next`, or full size if it was not called.

        Args:
            pace: the run after this step.
        """
        self._times.learn(pace, self._octaves)
        whole = self._times.of(0)
        if whole and self.share > 0:
            self.share = share_for(pace.budget / whole)

    def steps_until(self, pace: Pace, end: float) -> float | None:
        """Return the number of steps until a point of the run, from measured times; None before the first.

        Args:
            pace: the run now.
            end: share of the budget that is spent at this point.
        """
        whole = self._times.of(0)
        if not whole:
            return None
        steps = 0.0
        for octaves in range(self.most + 1):
            first = 0.0 if octaves == self.most else self.share / 2**octaves
            last = 1.0 if octaves == 0 else self.share / 2 ** (octaves - 1)
            share = max(min(last, end) - max(first, pace.progress), 0.0)
            steps += share * pace.budget / (self._times.of(octaves) or whole / QUICKER**octaves)
        return steps


def reduced(image: Tensor, octaves: int) -> Tensor:
    """Return an image halved a number of times.

    Args:
        image: (H, W, C) the whole image.
        octaves: number of halvings.
    """
    for _ in range(octaves):
        image = halved(image)
    return image


def reduced_distances(distances: Tensor, octaves: int) -> Tensor:
    """Apply `halved_distances` a number of times.

    Args:
        distances: (H, W), 0 where unknown.
        octaves: number of halvings.
    """
    for _ in range(octaves):
        distances = halved_distances(distances)
    return distances


def reduced_weights(weights: Tensor, octaves: int) -> Tensor:
    """Return the weights of the pixels of a reduced image: the least of the pixels that each is the mean of.

    Args:
        weights: (H, W) weights of the whole image; odd last rows and columns are left out.
        octaves: number of halvings.
    """
    return -torch.nn.functional.max_pool2d(-weights[None], 1 << octaves)[0] if octaves else weights


def halved(image: Tensor) -> Tensor:
    """Return an image of half the size; each pixel is the mean of four.

    Args:
        image: (H, W, C); an odd last row or column is left out.
    """
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))


def halved_distances(distances: Tensor) -> Tensor:
    """Return distances at half the size: the minimum of four known distances, 0 where none is known.

    A mean would lie between foreground and background.

    Args:
        distances: (H, W), 0 where unknown; an odd last row or column is left out.
    """
    unknown_far = torch.where(distances > 0, distances, torch.inf)
    least = -torch.nn.functional.max_pool2d(-unknown_far[None], 2)[0]
    return torch.where(least.isfinite(), least, 0)


def enlarged(image: Tensor, whole: Tensor, octaves: int) -> Tensor:
    """Return a reduced image as large as the whole one: each of its pixels becomes a square.

    Args:
        image: (H >> octaves, W >> octaves, C) the reduced image.
        whole: (H, W, C) the whole one; its last rows and columns fill the border that reducing left out.
        octaves: number of halvings of the image.
    """
    if octaves == 0:
        return image
    out, side = whole.clone(), 1 << octaves
    larger = image.repeat_interleave(side, 0).repeat_interleave(side, 1)
    out[: larger.shape[0], : larger.shape[1]] = larger
    return out
