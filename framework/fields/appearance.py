"""Appearance of images of one scene: a row of numbers for each, such as the vectors of NeRF-W."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfloom.base.config import AppearanceConfig, HeldOutAppearance
from nerfloom.base.optimised import Optimised
from nerfloom.data.scene import Scene


class Appearance(nn.Module):
    """A learnt vector for each image, an input of the colour network: NeRF-W (Martin-Brualla et al. 2021), section 4.1.

    Subclasses may read a vector as parameters of a function of rendered colours (`rendering.light`).

    Evaluation uses the mean vector, which belongs to no image. A network that has never seen the mean vector may render
    anything for it, and the error grows with the distance between the vectors. So in a fraction of the training steps
    an image gets the mean vector: the network then learns what all images have in common.

    Args:
        size: number D of features of a vector.
        count: number of images.
        optimised: settings of the optimiser; the containing module's if None.
        mean_share: probability that an image has the mean vector in a training step.
        held_out: vector of a held-out image in evaluation: the mean vector, the nearest training image's vector, or one
            that is fitted to the image's left half and judged on its right half.
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
            return functional.embedding(camera_indices, self.own_or_mean())
        return self.current().expand(count, -1)

    def of_images(self) -> Tensor:
        """Return the vector of each training image (M, D), with a gradient."""
        return self.vectors

    def own_or_mean(self) -> Tensor:
        """Return the vector of each image in this step (M, D); the mean has no gradient."""
        own = self.of_images()
        if not self.training or not self.mean_share:
            return own
        has_mean = torch.rand(len(own), 1, device=own.device) < self.mean_share
        return torch.where(has_mean, own.detach().mean(0), own)

    def current(self) -> Tensor:
        """Return the vector (D,) of evaluation: the one set by `shown`, or the mean without a gradient."""
        return self.of_images().detach().mean(0) if self._shown is None else self._shown

    def pull(self, vector: Tensor) -> Tensor:
        """Return the term () beside the squared error of colours in fits of `vector` (D,) to an image; here 0."""
        return vector.new_zeros(())

    def of_any_view(self, vector: Tensor) -> Tensor:
        """Return a vector (D,) without any dependence on the position in an image; here `vector` itself."""
        return vector

    @contextmanager
    def shown(self, vector: Tensor) -> Iterator[None]:
        """Use `vector` (D,) as the appearance in evaluation, within a `with` block."""
        self._shown, previous = vector, self._shown
        try:
            yield
        finally:
            self._shown = previous


def make_vectors(config: AppearanceConfig, scene: Scene) -> Appearance | None:
    """Return the vectors of the training images, an input of a colour network; None if the settings have none."""
    if config.appearance != "vector":
        return None
    size, share = config.appearance_embedding_dim, config.mean_appearance_share
    return Appearance(size, scene.num_cameras, None, share, config.eval_appearance)
