"""Appearance vectors (NeRF-W), for images of a scene that differ in light, exposure or camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfloom.base.config import HeldOutAppearance
from nerfloom.base.optimised import Optimised

AFFINE = 12
"""Length of an appearance vector that holds an affine transform of colours."""
LIGHT_REASONS = {True: "light differs between the images", False: "the images are lit alike"}
"""Reason for or against an appearance vector per image, by whether light, exposure or camera differ."""


class Appearance(nn.Module):
    """A learnt vector for each image, an input of the colour network: NeRF-W (Martin-Brualla et al. 2021), section 4.1.

    Evaluation uses the mean vector, which belongs to no image. A network that has never seen the mean vector may render
    anything for it, and the error grows with the distance between the vectors. So in a fraction of the training steps
    an image gets the mean vector: the network then learns what all images have in common.

    Args:
        size: number D of features of a vector.
        count: number of images.
        optimised: settings of the optimiser; those of the containing module if None.
        mean_share: probability that an image has the mean vector in a training step.
        held_out: what held-out images are evaluated with: the mean vector, one that is fitted to the left half of each,
            and judged on its right half, or that of the nearest training image.
    """

    def __init__(
        self,
        size: int,
        count: int,
        optimised: Optimised | None = None,
        mean_share: float = 0.0,
        held_out: HeldOutAppearance = "mean",
    ) -> None:
        super().__init__()
        self.size, self.optimised, self.mean_share, self.held_out = size, optimised, mean_share, held_out
        self.vectors = nn.Parameter(torch.zeros(count, size))
        self._shown: Tensor | None = None

    def forward(self, camera_indices: Tensor | None, count: int) -> Tensor:
        """Return the vector of the image of each sample.

        Args:
            camera_indices: (N,) image of each sample; None for evaluation. In evaluation all samples get the vector set
                by `shown`, or the mean vector, without a gradient.
            count: number N of samples.

        Returns:
            (N, D) vectors.
        """
        if camera_indices is not None:
            # Not `vectors[camera_indices]`: its gradient depends on the order of the threads' sums.
            return functional.embedding(camera_indices, self._own_or_mean())
        return (self.vectors.detach().mean(0) if self._shown is None else self._shown).expand(count, -1)

    def _own_or_mean(self) -> Tensor:
        """Return the vector of each image in this step (M, D); the mean has no gradient."""
        if not self.training or not self.mean_share:
            return self.vectors
        has_mean = torch.rand(len(self.vectors), 1, device=self.vectors.device) < self.mean_share
        return torch.where(has_mean, self.vectors.detach().mean(0), self.vectors)

    @contextmanager
    def shown(self, vector: Tensor) -> Iterator[None]:
        """Use `vector` (D,) as the appearance in evaluation, within a `with` block."""
        self._shown, previous = vector, self._shown
        try:
            yield
        finally:
            self._shown = previous


def affine_colors(rgb: Tensor, vector: Tensor) -> Tensor:
    """Return colours as an image with another light or exposure shows them: rgb + A rgb + b, unchanged by zeros.

    Args:
        rgb: (..., 3) colours.
        vector: (AFFINE,) rows of the matrix [A, b] (3, 4).
    """
    affine = vector.view(3, 4)
    return rgb + rgb @ affine[:, :3].T + affine[:, 3]


def exposed(rgb: Tensor, opacity: Tensor, background: Tensor, vectors: Tensor) -> Tensor:
    """Return the colours of rays as their images show them: `affine_colors` of the scene without the background.

    The transform is applied to the composited colour, which equals transforming the colour of each sample.

    Args:
        rgb: (R, 3) composited colours over the background.
        opacity: (R,) opacity of the scene.
        background: (R, 3) or (3,) colour of the background.
        vectors: (R, AFFINE) rows of the matrix [A, b] (3, 4) of each ray's image.

    Returns:
        (R, 3) colours.
    """
    affine, seen = vectors.view(-1, 3, 4), opacity[:, None]
    scene = rgb - (1 - seen) * background
    return rgb + (affine[..., :3] * scene[:, None]).sum(-1) + affine[..., 3] * seen
