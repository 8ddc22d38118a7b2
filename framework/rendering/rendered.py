"""Results of rendering: values of rays, of pixels, and of a whole image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.rendering.outputs import Output


@dataclass(frozen=True)
class Pixels:
    """Rendered values of P pixels."""

    rgb: Tensor
    """(P, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(P,) expected distance along the ray, scene units; the far end of the ray if it is transparent."""
    median_depth: Tensor
    """(P,) distance where the transmittance falls to 0.5, scene units; the far end of the ray if it does not."""
    accumulation: Tensor
    """(P,) opacity."""
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    """Further outputs (P, ...) by name."""


@dataclass(frozen=True)
class Rendered:
    """Rendered values of R rays, and the N samples they come from."""

    rgb: Tensor
    """(R, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(R,) expected distance, the weighted mean of t, scene units; the far end of the ray if it is transparent."""
    median_depth: Tensor
    """(R,) distance where the transmittance falls to 0.5, scene units; the far end of the ray if it does not."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    num_samples: int | Tensor
    """Number of evaluations of the field on these rays, excluding proposals; () int64 in training steps that do not
    wait for the device."""
    weights: Tensor | None = None
    """(N,) weight of each sample."""
    samples: Samples | None = None
    """The samples."""
    extras: Mapping[str, Any] = field(default_factory=dict)
    """Further values by name, tensors (R, ...): outputs declared by the renderer, and inputs of losses. `coarse` is the
    coarse level, if it is supervised too."""
    error_bound: float = 0.0
    """Maximum error of a colour channel caused by the early stop of rays."""

    @property
    def coarse(self) -> Rendered | None:
        """Rendered values of the coarse level; None if there is none."""
        return self.extras.get("coarse")

    def over(self, coarse: Rendered) -> Rendered:
        """Attach the `coarse` level of the same rays, and add up the numbers of evaluations."""
        extras = {**self.extras, "coarse": coarse}
        return replace(self, extras=extras, num_samples=self.num_samples + coarse.num_samples)

    def to_pixels(self, rays_per_pixel: int = 1, outputs: Sequence[Output] = ()) -> Pixels:
        """Average the rays of each pixel.

        Colour and opacity are means over the rays. The depth is a mean weighted by the opacity of the rays, and the
        median depth is the median of the rays' own.

        Args:
            rays_per_pixel: number of consecutive rays that form a pixel.
            outputs: further outputs of the pixels; any that the rays lack are left out.

        Returns:
            R / rays_per_pixel pixels.
        """
        found = [output for output in outputs if output.name in self.extras]
        extras = {output.name: output.averaged(self.extras[output.name], rays_per_pixel) for output in found}
        if rays_per_pixel == 1:
            return Pixels(self.rgb, self.depth, self.median_depth, self.accumulation, extras)
        shape = (-1, rays_per_pixel)
        share, depth = self.accumulation.detach().view(shape), self.depth.view(shape)
        visible = share.sum(1) > 1e-6
        share = torch.where(visible[:, None], share, torch.ones_like(share))
        return Pixels(
            rgb=self.rgb.view(*shape, 3).mean(1),
            depth=(depth * share).sum(1) / share.sum(1),
            median_depth=self.median_depth.view(shape).median(1).values,
            accumulation=self.accumulation.view(shape).mean(1),
            extras=extras,
        )


@dataclass(frozen=True)
class Picture:
    """A rendered image."""

    rgb: Tensor
    """(H, W, 3) colour in [0, 1] over the background."""
    depth: Tensor
    """(H, W) expected distance along the ray, scene units."""
    median_depth: Tensor
    """(H, W) distance along the ray where the transmittance falls to 0.5, scene units."""
    accumulation: Tensor
    """(H, W) opacity."""
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    """Further outputs (H, W, ...) by name."""
    outputs: tuple[Output, ...] = ()
    """Declarations of `extras`, from the model (`Model.outputs`)."""
    num_rays: int = 0
    """Number of rays that were cast for the image; 0 if the method casts none."""
    level_error: float | None = None
    """Level error (`levels.cut`), pixels; None if the picture is not of levels of detail."""

    def of(self, name: str) -> Tensor:
        """Return the values (H, W, ...) of the output `name`."""
        return self.extras[name] if name in self.extras else getattr(self, name)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.rgb.shape[0], self.rgb.shape[1]
