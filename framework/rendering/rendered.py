"""Results of rendering: of rays, of pixels, and of a whole image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples


@dataclass(frozen=True)
class Pixels:
    """Rendered values of P pixels."""

    rgb: Tensor
    """(P, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(P,) expected distance along the ray, scene units; the far end of the ray if it is transparent."""
    median_depth: Tensor
    """(P,) distance at which the transmittance falls to 0.5, scene units; the far end of the ray if it does not."""
    accumulation: Tensor
    """(P,) opacity."""
    normals: Tensor | None = None
    """(P, 3) mean normal, not of unit length; None if the method has no normals."""


@dataclass(frozen=True)
class Rendered:
    """Rendered values of R rays, and the N samples that they were computed from."""

    rgb: Tensor
    """(R, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(R,) expected distance, the weighted mean of t, scene units; the far end of the ray if it is transparent."""
    median_depth: Tensor
    """(R,) distance at which the transmittance falls to 0.5, scene units; the far end of the ray if it does not."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    num_samples: int | Tensor
    """Number of evaluations of the field on these rays, without those of proposals; () int64 in training steps that do
    not wait for the device."""
    weights: Tensor | None = None
    """(N,) weight of each sample."""
    samples: Samples | None = None
    """The samples."""
    coarse: Rendered | None = None
    """Rendered values of the coarse level, if it is supervised too."""
    normals: Tensor | None = None
    """(R, 3) weighted sum of the samples' normals; None if the method has no normals."""
    penalties: dict[str, Tensor] = field(default_factory=dict)
    """Terms (R,) of the loss by name that depend on values of single samples."""
    error_bound: float = 0.0
    """Maximum error of a colour channel that the early stop of rays causes."""

    def over(self, coarse: Rendered) -> Rendered:
        """Return these values with those of the coarse level attached, and the evaluations of both levels added up.

        Args:
            coarse: the coarse level, rendered on the same rays.
        """
        return replace(self, coarse=coarse, num_samples=self.num_samples + coarse.num_samples)

    def to_pixels(self, rays_per_pixel: int = 1) -> Pixels:
        """Average the rays of each pixel.

        Colour, opacity and normal are means over the rays. The depth is a mean weighted by the opacity of the rays,
        and the median depth is the median of the rays' own.

        Args:
            rays_per_pixel: number of consecutive rays that form a pixel.

        Returns:
            R / rays_per_pixel pixels.
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
    """A rendered image."""

    rgb: Tensor
    """(H, W, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(H, W) expected distance along the ray, scene units."""
    median_depth: Tensor
    """(H, W) distance along the ray at which the transmittance falls to 0.5, scene units."""
    accumulation: Tensor
    """(H, W) opacity."""
    normals: Tensor | None = None
    """(H, W, 3) unit normals, scene coordinates, pointing away from surfaces; None if the method has no normals."""
    num_rays: int = 0
    """Number of rays that were cast for the image; 0 if the method casts none."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.rgb.shape[0], self.rgb.shape[1]
