"""Terms of methods that learn a signed distance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.fields.surface import SurfaceField
from nerfloom.losses.functions import mean_squared_error
from nerfloom.losses.term import LossTerm, RenderedBatch

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel

EVERY, ANYWHERE = 4, 8
"""The length of the gradient is asked at one in this many samples, so that others may be without a gradient and are
skipped; and for one in this many samples at a random place in the box."""


class Eikonal(LossTerm):
    """Squared difference of the distance's gradient from length 1: Gropp et al. 2020, equation 2.

    It is asked at some of the samples, and at random places in the box.
    """

    def __init__(self) -> None:
        super().__init__("eikonal", "eikonal_loss_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, field = shown.rendered.samples, shown.model.field
        if samples is None or samples.features is None or not len(samples):
            return None
        assert isinstance(field, SurfaceField)
        unit = torch.rand(max(len(samples) // ANYWHERE, 1), 3, device=field.box.device)
        low, high = field.box
        elsewhere = field.shape(torch.lerp(low, high, unit)).gradients
        first = int(torch.randint(EVERY, ()))
        gradients = torch.cat([samples.features[first::EVERY, :3], elsewhere])
        return (gradients.norm(dim=-1) - 1).square().mean()


class Silhouette(LossTerm):
    """Difference between the opacity of pixels and the alpha of their images: the mask of IDR (Yariv et al. 2020)."""

    def __init__(self) -> None:
        super().__init__("silhouette", "silhouette_loss_mult")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return batch.alpha is not None

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        batch = shown.batch
        assert batch.alpha is not None
        return mean_squared_error(shown.pixels.accumulation, batch.alpha, batch.weights)
