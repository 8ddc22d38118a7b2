"""The appearance of a held-out photograph, found on its left half: NeRF-W's protocol.

Martin-Brualla et al., "NeRF in the Wild", CVPR 2021, section 5: a photograph that was not trained on has no appearance
vector; one is optimised on its left half, all else being fixed, and the picture is judged on its right half.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from framework.data.dataset import Dataset
from framework.data.pixels import gather_batch
from framework.fields.appearance import Appearance
from framework.model import HasAppearance, Model
from framework.ray_model import RayModel
from framework.rendering.losses import mean_squared_error

STEPS, PIXELS, RATE = 60, 1024, 0.05
"""Of Adam: steps, pixels in each, learning rate."""


def appearance_of(model: Model[Any]) -> Appearance | None:
    """Return the images' appearance vectors; None of a model that has none.

    Args:
        model: any method's.
    """
    return model.appearance if isinstance(model, HasAppearance) else None


def right_half(image: Tensor) -> Tensor:
    """Return (H, W - W // 2, ...), what is judged of an image.

    Args:
        image: (H, W, ...).
    """
    return image[:, image.shape[1] // 2 :]


@contextmanager
def fitted_appearance(model: Model[Any], dataset: Dataset, index: int, background: Tensor) -> Iterator[None]:
    """Show image `index` in the appearance found on its left half.

    Args:
        model: with appearance vectors.
        dataset: held-out images.
        index: which of them.
        background: (3,) colour behind what is not opaque.
    """
    with shown_appearance(model, fit_appearance(model, dataset, _left_pixels(dataset, index), background)):
        yield


@contextmanager
def shown_appearance(model: Model[Any], vector: Tensor | None) -> Iterator[None]:
    """Show what is no training image in an appearance.

    Args:
        model: whose pictures are meant.
        vector: (D,) the appearance; None of a model without.
    """
    appearance = appearance_of(model)
    with nullcontext() if appearance is None or vector is None else appearance.shown(vector):
        yield


def fit_appearance(
    model: Model[Any], dataset: Dataset, pixels: Tensor, background: Tensor, start: Tensor | None = None
) -> Tensor | None:
    """Find the appearance in which the model's picture comes nearest to an image, all else being fixed.

    Args:
        model: what is shown.
        dataset: the images.
        pixels: (P,) which to look at, counted through all images; P may be 0.
        background: (3,) colour behind what is not opaque.
        start: (D,) the vector to start from; the mean of the training images' if None.
    Returns: (D,) the vector; None of a model without appearance.
    """
    appearance = appearance_of(model)
    if appearance is None:
        return None
    vector = (appearance.vectors.mean(0) if start is None else start).detach().clone().requires_grad_()
    if len(pixels) and isinstance(model, RayModel):
        with appearance.shown(vector):
            _fit(model, dataset, pixels, vector, background)
    return vector.detach()


def _left_pixels(dataset: Dataset, index: int) -> Tensor:
    """(P,) those of the photograph's left half that no mask ignores, counted through all images."""
    width = int(dataset.cameras.widths[index])
    pixels = dataset.cameras.image_pixels(index).view(-1, width)[:, : width // 2]
    kept = dataset.kept_of(index)
    return pixels.reshape(-1) if kept is None else pixels[kept[:, : width // 2]]


def _fit(model: RayModel[Any], dataset: Dataset, pixels: Tensor, vector: Tensor, background: Tensor) -> None:
    was_training = model.training
    model.eval()
    optimizer = torch.optim.Adam([vector], lr=RATE)
    draws = torch.Generator().manual_seed(0)
    with torch.enable_grad(), torch.autocast(model.device.type, torch.bfloat16, enabled=False):
        for _ in range(STEPS):
            chosen = pixels[torch.randint(len(pixels), (PIXELS,), generator=draws).to(pixels.device)]
            batch = gather_batch(dataset, chosen, background.repeat(len(chosen), 1))
            rendered = model.render(replace(batch.rays, camera_indices=None), batch.background)
            (vector.grad,) = torch.autograd.grad(mean_squared_error(rendered.rgb, batch.rgb), [vector])
            optimizer.step()
    model.train(was_training)
