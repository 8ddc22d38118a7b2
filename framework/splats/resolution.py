"""Images of reduced sizes: training goes from coarse to fine."""

from __future__ import annotations

import math
from collections import Counter

import torch
from torch import Tensor

from nerfloom.base.pace import Pace, StepTimes

REDUCED_SHARE = 0.4
"""Share of the budget for reduced images where there are enough steps at full size."""
ENOUGH_STEPS, SHARE_POWER, LEAST_WHOLE = 700, 0.7, 0.1
"""Steps at full size that should fit into a whole budget; exponent of the share for full size as a function of their
number; and the least share for full size."""
LEAST_SIDE = 150
"""Minimum side of reduced images, pixels of a square with as many."""
QUICKER = 3.0
"""Assumed ratio of the time of a step to that of a step with images of half the size, until both are measured."""


def octaves_at(progress: float, share: float, most: int) -> int:
    """Return how often images are halved at some point of a run.

    They are halved once in the share of the budget that is for reduced images, twice in the first half of this share,
    three times in the first quarter, and so on: each size has as much time as all smaller ones together.

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
    whole = (1 - REDUCED_SHARE) * min(steps / ENOUGH_STEPS, 1.0) ** SHARE_POWER
    return 1 - max(whole, LEAST_WHOLE)


def most_octaves(pixels: float) -> int:
    """Return how often an image can be halved: once, or more often while a square of as many pixels has `LEAST_SIDE`.

    Args:
        pixels: number of pixels of the whole image.
    """
    return max(int(math.log2(max(math.sqrt(pixels) / LEAST_SIDE, 1.0))), 1)


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
        """Number of steps so far, by how often their images were halved."""
        self._times, self._octaves = StepTimes(), 0

    def next(self, progress: float) -> int:
        """Return how often the images of the next step are halved.

        Args:
            progress: share of the budget that is spent.
        """
        unknown = self.paced and self.share > 0 and self._times.of(0) is None
        octaves = 0 if unknown else octaves_at(progress, self.share, self.most)
        self.steps[octaves] += 1
        self._octaves = octaves
        return octaves

    def learn(self, pace: Pace) -> None:
        """Measure the last step, whose images had the size that `next` returned, or the whole one if it was not called.

        Args:
            pace: the run after this step.
        """
        self._times.learn(pace, self._octaves)
        whole = self._times.of(0)
        if whole and self.share > 0:
            self.share = share_for(pace.budget / whole)

    def steps_until(self, pace: Pace, end: float) -> float | None:
        """Return how many steps there will be until some point of the run, at measured times; None before any.

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
        octaves: how often it is halved.
    """
    for _ in range(octaves):
        image = halved(image)
    return image


def reduced_distances(distances: Tensor, octaves: int) -> Tensor:
    """Return distances (H, W) halved a number of times, as `halved_distances` does it once.

    Args:
        distances: (H, W), 0 where unknown.
        octaves: how often they are halved.
    """
    for _ in range(octaves):
        distances = halved_distances(distances)
    return distances


def halved(image: Tensor) -> Tensor:
    """Return an image of half the size, each pixel of which is the mean of four.

    Args:
        image: (H, W, C); an odd last row or column is left out.
    """
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))


def halved_distances(distances: Tensor) -> Tensor:
    """Return distances at half the size, the least of four that are known, 0 where none is.

    A mean would lie between what is in front and what is behind; where few pixels are known, none is lost.

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
        whole: (H, W, C) the whole one, whose last rows and columns fill what reducing left out.
        octaves: how often the image was halved.
    """
    if octaves == 0:
        return image
    out, side = whole.clone(), 1 << octaves
    larger = image.repeat_interleave(side, 0).repeat_interleave(side, 1)
    out[: larger.shape[0], : larger.shape[1]] = larger
    return out
