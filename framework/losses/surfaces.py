"""Terms of methods that learn a signed distance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.losses.functions import mean_squared_error
from nerfloom.losses.term import LossTerm, RenderedBatch

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel

ANYWHERE = 8
"""For every this many samples, the length of the gradient is also asked at one random place in the box."""


class Eikonal(LossTerm):
    """Squared difference of the distance's gradient from length 1: Gropp et al. 2020, equation 2.

    It is asked at the samples, and at random places in the box.
    """

    def __init__(self) -> None:
        super().__init__("eikonal", "eikonal_loss_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, model = shown.rendered.samples, shown.model
        if samples is None or samples.features is None or not len(samples):
            return None
        low, high = model.scene.box
        unit = torch.rand(max(len(samples) // ANYWHERE, 1), 3, device=low.device)
        elsewhere = model.field.shape(torch.lerp(low, high, unit)).gradients  # type: ignore[union-attr,operator]
        gradients = torch.cat([samples.features[:, :3], elsewhere])
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
