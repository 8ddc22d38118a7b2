"""Appearance of held-out images, fitted to their left halves by NeRF-W's protocol.

Martin-Brualla et al., "NeRF in the Wild", CVPR 2021, section 5. A held-out image has no appearance vector. A vector is
optimised on the image's left half with all other parameters fixed, and metrics are computed on the right half.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import gather_batch
from nerfloom.data.scene import Scene
from nerfloom.fields.appearance import Appearance
from nerfloom.geometry.bounds import half_edge
from nerfloom.losses.functions import mean_squared_error
from nerfloom.renderable import Renderable, RendersRays, training_poses

STEPS, PIXELS = 30, 2048
"""Maximum number of steps of L-BFGS for fitting an appearance vector, and of pixels that it is fitted to."""
MAX_CANDIDATES = 32
"""Maximum number of training images' vectors tried as the initial vector."""


def right_half(image: Tensor) -> Tensor:
    """Return the right half (H, W - W // 2, ...) of an `image` (H, W, ...), used for metrics."""
    return image[:, image.shape[1] // 2 :]


@contextmanager
def held_out_appearance(model: Renderable, dataset: Dataset, index: int, background: Tensor) -> Iterator[None]:
    """Render an image with the appearance that the model's settings name, within a `with` block.

    Args:
        model: a model; without appearance vectors, nothing is changed.
        dataset: the held-out images, with cameras in the frame of the model's scene.
        index: index of the image.
        background: (3,) colour behind transparent pixels.
    """
    appearance = model.appearance
    if appearance is None or appearance.held_out == "mean":
        yield
    elif appearance.held_out == "half":
        with fitted_appearance(model, dataset, index, background):
            yield
    else:
        known = replace(model.scene, camera_to_worlds=training_poses(model))
        nearest = nearest_camera(known, dataset.view(index))
        with appearance.shown(appearance.of_images()[nearest].detach()):
            yield


@contextmanager
def fitted_appearance(model: Renderable, dataset: Dataset, index: int, background: Tensor) -> Iterator[None]:
    """Render with the appearance fitted to the left half of an image, within a `with` block.

    Args:
        model: a model with appearance vectors.
        dataset: the held-out images.
        index: index of the image.
        background: (3,) colour behind transparent pixels.
    """
    with shown_appearance(model, fit_appearance(model, dataset, _left_pixels(dataset, index), background)):
        yield


def nearest_camera(scene: Scene, view: View) -> int:
    """Return the training image with the camera nearest to a view's.

    Cameras are compared by their positions and by the points half the box's edge in front of them, so that directions
    count too.

    Args:
        scene: the scene, with the poses of the training cameras.
        view: the view.

    Raises:
        ConfigError: if the scene does not know the training cameras.
    """
    if scene.camera_to_worlds is None:
        raise ConfigError("--eval-appearance nearest: the training cameras' poses are not known; use mean or half")

    def ends(poses: Tensor) -> Tensor:
        ahead = poses[:, :, 3] - half_edge(scene.box) * poses[:, :, 2]
        return torch.cat([poses[:, :, 3], ahead], -1)

    known, own = ends(scene.camera_to_worlds.cpu()), ends(view.camera.camera_to_worlds.cpu())
    return int((known - own).square().sum(-1).argmin())


@contextmanager
def shown_appearance(model: Renderable, vector: Tensor | None) -> Iterator[None]:
    """Render views other than training images with an appearance vector, within a `with` block.

    Args:
        model: the model.
        vector: (D,) appearance vector; None to change nothing.
    """
    appearance = model.appearance
    with nullcontext() if appearance is None or vector is None else appearance.shown(vector):
        yield


def fit_appearance(
    model: Renderable, dataset: Dataset, pixels: Tensor, background: Tensor, start: Tensor | None = None
) -> Tensor | None:
    """Fit the appearance vector that brings the model's colours closest to given pixels.

    It has nothing that depends on the position in an image: the pixels may be of a part of one.

    Args:
        model: the model; its parameters are not changed.
        dataset: the images, with cameras in the frame of the model's scene.
        pixels: (P,) indices of the pixels, counted over all images; P may be 0.
        background: (3,) colour behind transparent pixels.
        start: (D,) initial vector. If None, a model that casts rays starts from the best of the training images'
            vectors and their mean; other models start from the mean.

    Returns:
        (D,) vector; None if the model has no appearance vectors.
    """
    appearance = model.appearance
    if appearance is None:
        return None
    mean = appearance.of_images().detach().mean(0)
    if not len(pixels):
        return appearance.of_any_view(mean if start is None else start)
    with model.rendering(), torch.autocast(model.device.type, torch.bfloat16, enabled=False):
        if isinstance(model, RendersRays):
            error = _error_of_rays(model, dataset, pixels, background)
            start = _closest(appearance, error) if start is None else start
        else:
            error = _error_of_view(model, dataset, pixels, background)
        return _fit(appearance, error, mean if start is None else start)


@torch.no_grad()
def _closest(appearance: Appearance, error: Callable[[], Tensor]) -> Tensor:
    """Return the vector (D,) with the smallest error: the mean, or a training image's.

    The network learns the mean vector separately (`Appearance`), so vectors near the mean say little about the light of
    others, and a descent from there may end at a poor minimum.
    """
    own, errors = appearance.of_images(), []
    candidates = torch.cat([own.mean(0)[None], own[evenly_spaced(len(own), MAX_CANDIDATES).to(own.device)]])
    for vector in candidates:
        with appearance.shown(appearance.of_any_view(vector)):
            errors.append(error())
    return candidates[torch.stack(errors).argmin()]


def _left_pixels(dataset: Dataset, index: int) -> Tensor:
    """Return the unmasked pixels (P,) of an image's left half, counted over all images."""
    width = int(dataset.cameras.widths[index])
    pixels = dataset.cameras.image_pixels(index).view(-1, width)[:, : width // 2]
    kept = dataset.kept_of(index)
    return pixels.reshape(-1) if kept is None else pixels[kept[:, : width // 2]]


def _error_of_rays(model: RendersRays, dataset: Dataset, pixels: Tensor, background: Tensor) -> Callable[[], Tensor]:
    """Return a function that returns the squared error () of some pixels in the appearance shown.

    They are drawn at random, once. Evenly spaced ones may be all in a few columns.
    """
    chosen = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))[:PIXELS]
    some = pixels[chosen.to(pixels.device)]
    batch = gather_batch(dataset, some, background.repeat(len(some), 1))
    rays = replace(batch.rays, camera_indices=None)
    return lambda: mean_squared_error(model.render(rays, batch.background).rgb, batch.rgb)


def _error_of_view(model: Renderable, dataset: Dataset, pixels: Tensor, background: Tensor) -> Callable[[], Tensor]:
    """Return a function that returns the squared error () of pixels of one image, drawn as a whole."""
    index = int(torch.searchsorted(dataset.cameras.offsets.to(pixels), pixels[0], right=True)) - 1
    pixels_there = pixels - dataset.cameras.offsets[index].to(pixels)
    view = dataset.view(index)
    true = gather_batch(dataset, pixels, background.repeat(len(pixels), 1)).rgb
    return lambda: mean_squared_error(model.render_view(view, background).rgb.reshape(-1, 3)[pixels_there], true)


@torch.enable_grad()
def _fit(appearance: Appearance, error: Callable[[], Tensor], start: Tensor) -> Tensor:
    """Return the vector (D,) with the smallest error and pull, found from a start (D,).

    The appearance's first `size` parameters belong to an image; others are shared, and stay as they are. L-BFGS adapts
    to parameters of any unit, and to parameters that depend on each other, such as the entries of an affine function.
    """
    own, shared = start.detach().split([appearance.size, len(start) - appearance.size])
    own = own.clone().requires_grad_()
    optimizer = torch.optim.LBFGS([own], max_iter=STEPS, line_search_fn="strong_wolfe")

    def vector() -> Tensor:
        return appearance.of_any_view(torch.cat([own, shared]))

    def loss() -> Tensor:
        with appearance.shown(vector()):
            value = error() + appearance.pull(vector())
        (own.grad,) = torch.autograd.grad(value, [own])
        return value.detach()

    optimizer.step(loss)
    return vector().detach()
