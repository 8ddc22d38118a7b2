"""The appearance of a held-out photograph, found on its left half: NeRF-W's protocol.

Martin-Brualla et al., "NeRF in the Wild", CVPR 2021, section 5: a photograph that was not trained on has no appearance
vector; one is optimised on its left half, all else being fixed, and the picture is judged on its right half.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import torch
from torch import Tensor

from framework.data.dataset import Dataset
from framework.data.pixels import gather_batch
from framework.fields.appearance import Appearance
from framework.model import Model
from framework.rendering.losses import mean_squared_error

STEPS, PIXELS, RATE = 60, 1024, 0.05
"""Of Adam: steps, pixels in each, learning rate."""


def appearances(model: Model) -> list[Appearance]:
    """The model's appearance vectors; empty for a method that has none."""
    return [module for module in model.modules() if isinstance(module, Appearance)]


def right_half(image: Tensor) -> Tensor:
    """(H, W - W // 2, ...) what is judged of an image (H, W, ...)."""
    return image[:, image.shape[1] // 2 :]


@contextmanager
def fitted_appearance(model: Model, dataset: Dataset, index: int, background: Tensor) -> Iterator[None]:
    """Show photograph `index` in the appearance found on its left half.

    Args:
        background: (3,) colour behind what is not opaque.
    """
    with shown_appearance(model, fit_appearance(model, dataset, _left_pixels(dataset, index), background)):
        yield


@contextmanager
def shown_appearance(model: Model, vectors: Sequence[Tensor]) -> Iterator[None]:
    """Show what is not a training photograph in an appearance: a vector (D,) for each of the model's `appearances`."""
    with ExitStack() as stack:
        for module, vector in zip(appearances(model), vectors, strict=True):
            stack.enter_context(module.shown(vector))
        yield


def fit_appearance(
    model: Model, dataset: Dataset, pixels: Tensor, background: Tensor, start: Sequence[Tensor] | None = None
) -> list[Tensor]:
    """The appearance in which the model's picture comes nearest to a photograph, all else being fixed.

    Args:
        pixels: (P,) which to look at, counted through all images; P may be 0.
        background: (3,) colour behind what is not opaque.
        start: the vectors to start from; the mean of the training photographs' if None.
    Returns: a vector (D,) for each of the model's `appearances`.
    """
    first = [module.vectors.mean(0) for module in appearances(model)] if start is None else start
    vectors = [vector.detach().clone().requires_grad_() for vector in first]
    if vectors and len(pixels):
        with shown_appearance(model, vectors):
            _fit(model, dataset, pixels, vectors, background)
    return [vector.detach() for vector in vectors]


def _left_pixels(dataset: Dataset, index: int) -> Tensor:
    """(P,) those of the photograph's left half that no mask ignores, counted through all images."""
    width = int(dataset.cameras.widths[index])
    pixels = dataset.cameras.image_pixels(index).view(-1, width)[:, : width // 2]
    kept = dataset.kept_of(index)
    return pixels.reshape(-1) if kept is None else pixels[kept[:, : width // 2]]


def _fit(model: Model, dataset: Dataset, pixels: Tensor, vectors: list[Tensor], background: Tensor) -> None:
    was_training = model.training
    model.eval()
    optimizer = torch.optim.Adam(vectors, lr=RATE)
    draws = torch.Generator().manual_seed(0)
    with torch.enable_grad(), torch.autocast(model.device.type, torch.bfloat16, enabled=False):
        for _ in range(STEPS):
            chosen = pixels[torch.randint(len(pixels), (PIXELS,), generator=draws).to(pixels.device)]
            batch = gather_batch(dataset, chosen, background.repeat(len(chosen), 1))
            rendered = model.render(replace(batch.rays, camera_indices=None), batch.background)
            loss = mean_squared_error(rendered.rgb, batch.rgb)
            for vector, grad in zip(vectors, torch.autograd.grad(loss, vectors), strict=True):
                vector.grad = grad
            optimizer.step()
    model.train(was_training)
