"""Terms shared by methods. Each states its name, the setting that weighs it, and its inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.geometry.bounds import half_edge
from nerfloom.losses.functions import (
    density_before,
    depth_error,
    distance_likelihood,
    matter_before,
    mean_squared_error,
    normalised_distortion,
)
from nerfloom.losses.term import LossTerm, RenderedBatch

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel


class ColorError(LossTerm):
    """Mean squared error of colours: NeRF (Mildenhall et al. 2020), equation 6.

    Subclasses can override `error`.

    Args:
        name: name of the term in logs.
        weight: factor of the term, or the name of the setting that holds it.
    """

    def __init__(self, name: str = "rgb", weight: float | str = 1.0) -> None:
        super().__init__(name, weight)

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        return self.error(shown.pixels.rgb, shown)

    def error(self, rgb: Tensor, shown: RenderedBatch) -> Tensor:
        """Return the error () of the colours of P pixels.

        Args:
            rgb: (P, 3) rendered colours.
            shown: the rendered batch, with true colours and pixel weights.
        """
        return mean_squared_error(rgb, shown.batch.rgb, shown.batch.weights)


class CoarseColorError(ColorError):
    """Error of the colours of a coarse level, for samplers that have one.

    Args:
        weight: factor of the term, or the name of the setting that holds it.
    """

    def __init__(self, weight: float | str = 1.0) -> None:
        super().__init__("rgb_coarse", weight)

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return model.sampler.has_coarse_level

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        coarse = shown.rendered.coarse
        return None if coarse is None else self.error(coarse.to_pixels(shown.batch.rays_per_pixel).rgb, shown)


COLOR_ERROR = ColorError()
"""The term supported by compiled steps. An objective of this term alone can be trained in one native call."""


class SamplerLoss(LossTerm):
    """Loss that trains the sampler itself (`Sampler.loss`), such as the interlevel loss of proposals."""

    def __init__(self) -> None:
        super().__init__("interlevel")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return model.sampler.learns_from_weights

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, weights = shown.rendered.samples, shown.rendered.weights
        return None if samples is None or weights is None else shown.model.sampler.loss(samples, weights)


class Distortion(LossTerm):
    """Spread of the weights along rays, in normalised distance: mip-NeRF 360 (Barron et al. 2022), equation 15.

    Args:
        of_marched: whether samples of an occupancy grid have a distortion in contracted scenes, in disparity beyond
            half the box's edge.
    """

    def __init__(self, of_marched: bool = True) -> None:
        super().__init__("distortion", "distortion_loss_mult")
        self.of_marched = of_marched

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, weights, model = shown.rendered.samples, shown.rendered.weights, shown.model
        if samples is None or weights is None or not samples.num_rays:
            return None
        if samples.edges is not None:
            return normalised_distortion(weights, samples)
        if not self.of_marched or not model.config.contraction:
            return None
        return normalised_distortion(weights, samples, half_edge(model.scene.box))


class DepthError(LossTerm):
    """Error of the distances in depth images or of a reconstruction's points.

    Args:
        coarse: whether to compare the coarse level, for samplers that have one.
    """

    def __init__(self, coarse: bool = False) -> None:
        super().__init__("depth_coarse" if coarse else "depth", "depth_loss_mult")
        self.coarse = coarse

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return batch.distances is not None and (model.sampler.has_coarse_level or not self.coarse)

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        batch, level = shown.batch, shown.rendered.coarse if self.coarse else shown.rendered
        if level is None or level.weights is None or level.samples is None or not level.samples.num_rays:
            return None
        assert batch.distances is not None
        known = batch.distances.repeat_interleave(batch.rays_per_pixel)
        if batch.deviations is None:
            return depth_error(level.weights, level.samples, known)
        deviations = batch.deviations.repeat_interleave(batch.rays_per_pixel)
        return distance_likelihood(level.weights, level.samples, known, deviations)


class FreeSpace(LossTerm):
    """Matter in space that other images see through (`--free-space`)."""

    def __init__(self) -> None:
        super().__init__("free_space", "free_space_loss_mult")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return batch.clear is not None

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        batch, rendered = shown.batch, shown.rendered
        if rendered.samples is None or rendered.weights is None:
            return None
        assert batch.clear is not None
        clear = batch.clear.repeat_interleave(batch.rays_per_pixel)
        return matter_before(rendered.weights, rendered.samples, clear)


KNOWN_DISTANCES = DepthError(), DepthError(coarse=True), FreeSpace()
"""Terms of methods that learn from known distances."""


class MatterNearCameras(LossTerm):
    """Optical depth right before cameras: FreeNeRF (Yang et al. 2023), equation 6."""

    def __init__(self) -> None:
        super().__init__("occlusion", "occlusion_loss_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        near = shown.model.config.occlusion_range * shown.model.scene.near
        levels = [level.samples for level in (shown.rendered, shown.rendered.coarse) if level is not None]
        before = [density_before(s, near) for s in levels if s is not None and s.sigma is not None]
        return torch.stack(before).sum() if before else None


FEW_IMAGES = (MatterNearCameras(),)
"""Terms of methods with settings that include `FewImagesConfig`."""
