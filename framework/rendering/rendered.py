"""What is seen: along rays, in pixels, and in a whole picture."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from framework.geometry.rays import Samples


@dataclass(frozen=True)
class Pixels:
    """What P pixels show."""

    rgb: Tensor
    """(P, 3) colour over the background."""
    depth: Tensor
    """(P,) expected distance along the ray, scene units; the ray's far end where it met nothing."""
    median_depth: Tensor
    """(P,) distance at which half of the light is gone; the ray's far end where it never is."""
    accumulation: Tensor
    """(P,) opacity."""
    normals: Tensor | None = None
    """(P, 3) mean of the normals seen, of a method that has them; not of unit length."""


@dataclass(frozen=True)
class Rendered:
    """What R rays show, and the samples that it was made of."""

    rgb: Tensor
    """(R, 3) colour over the background."""
    depth: Tensor
    """(R,) expected distance: the mean of t under the weights; the ray's far end where it met nothing."""
    median_depth: Tensor
    """(R,) distance at which half of the light is gone; the ray's far end where it never is."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    num_samples: int
    """Evaluations of the field on these rays; a proposal's are not counted."""
    weights: Tensor | None = None
    """(N,) weight of each sample."""
    samples: Samples | None = None
    """The samples themselves."""
    coarse: Rendered | None = None
    """What a coarser level showed, where it is supervised too."""
    normals: Tensor | None = None
    """(R, 3) mean of the samples' normals under the weights, of a method that has them."""
    penalties: dict[str, Tensor] = field(default_factory=dict)
    """Named (R,) terms of the loss that only the samples' own values tell."""
    error_bound: float = 0.0
    """The most that a colour channel can be off by, as rays were ended early."""

    def over(self, coarse: Rendered) -> Rendered:
        """Return this with the coarser level that it was refined from; the evaluations of both count.

        Args:
            coarse: what that level showed of the same rays.
        """
        return replace(self, coarse=coarse, num_samples=self.num_samples + coarse.num_samples)

    def to_pixels(self, rays_per_pixel: int = 1) -> Pixels:
        """Average the rays of each pixel.

        Colour and opacity are means, and so is the depth, over the rays as far as they are opaque; the median depth is
        one ray's.

        Args:
            rays_per_pixel: how many successive rays make a pixel.
        Returns: R / rays_per_pixel pixels.
        """
        if rays_per_pixel == 1:
            return Pixels(self.rgb, self.depth, self.median_depth, self.accumulation, self.normals)
        shape = (-1, rays_per_pixel)
        share, depth = self.accumulation.detach().view(shape), self.depth.view(shape)
        visible = share.sum(1) > 1e-6
        share = torch.where(visible[:, None], share, torch.ones_like(share))
        return Pixels(
            rgb=self.rgb.view(*shape, 3).mean(1),
            depth=(depth * share).sum(1) / share.sum(1),
            median_depth=self.median_depth.view(shape).median(1).values,
            accumulation=self.accumulation.view(shape).mean(1),
            normals=None if self.normals is None else self.normals.view(*shape, 3).mean(1),
        )


@dataclass(frozen=True)
class Picture:
    """What a camera sees, row by row."""

    rgb: Tensor
    """(H, W, 3) colour over the background."""
    depth: Tensor
    """(H, W) expected distance along the ray, scene units."""
    median_depth: Tensor
    """(H, W) distance along the ray at which half of the light is gone, scene units."""
    accumulation: Tensor
    """(H, W) opacity."""
    normals: Tensor | None = None
    """(H, W, 3) unit directions away from surfaces, scene coordinates, of a method that has them."""
    num_rays: int = 0
    """Rays that it was made of; 0 of a method that casts none."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.rgb.shape[0], self.rgb.shape[1]
