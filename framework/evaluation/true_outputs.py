"""Errors of rendered normals and diffuse light against true ones, in the pixels of an object.

A pixel's weight is its rendered opacity times the alpha of the true image, as in the code of Ref-NeRF (Verbin et al.
2022), so that pixels beside the object do not count.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.device import to_float64
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.appearance import right_half
from nerfloom.evaluation.metrics import psnr_of_error
from nerfloom.kernels.color import to_srgb
from nerfloom.rendering.outputs import DIFFUSE, NORMALS, Output
from nerfloom.rendering.rendered import Picture


def normal_mae(picture: Picture, dataset: Dataset, index: int, half: bool) -> float | None:
    """Return the mean angle between rendered and true normals of a view, degrees: Ref-NeRF, section 5.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.
        half: whether only the right half counts.

    Returns:
        The angle; None if the method renders no normals, the data have none, or no pixel counts.
    """
    pixels = _pixels(picture, NORMALS, dataset.normals_of(index), dataset, index, half)
    return None if pixels is None else mean_angle(*pixels)


def diffuse_psnr(picture: Picture, dataset: Dataset, index: int, half: bool) -> float | None:
    """Return the PSNR of the rendered diffuse light of a view in display colours, dB; None as in `normal_mae`.

    Nothing is aligned: an error of scale counts. `picture`, `dataset`, `index` and `half` are as in `normal_mae`.
    """
    light = dataset.diffuse_of(index)
    truth = None if light is None else to_srgb(light).clamp(max=1)
    pixels = _pixels(picture, DIFFUSE, truth, dataset, index, half)
    return None if pixels is None else weighted_psnr(*pixels)


def _pixels(
    picture: Picture, output: Output, truth: Tensor | None, dataset: Dataset, index: int, half: bool
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return rendered values, true ones and weights of a view, or of its right half; None if it lacks either value."""
    if truth is None or output.name not in picture.extras:
        return None
    image, kept = dataset.image(index), dataset.kept_of(index)
    weights = picture.accumulation
    if image.shape[-1] == 4:
        weights = weights * image[..., 3] / 255
    weights = weights if kept is None else weights * kept
    found = picture.extras[output.name]
    return (right_half(found), right_half(truth), right_half(weights)) if half else (found, truth, weights)


def mean_angle(found: Tensor, truth: Tensor, weights: Tensor) -> float | None:
    """Return the weighted mean angle between unit vectors, degrees; None if all weights are 0, NaN if one is NaN.

    Args:
        found, truth: (..., 3) unit vectors; a vector of length 0 is 90 degrees from every other.
        weights: (...) weights, at least 0.
    """
    found, truth = to_float64(found), to_float64(truth)
    sines, cosines = torch.linalg.cross(found, truth).norm(dim=-1), (found * truth).sum(-1)
    angles = torch.atan2(sines, cosines)  # exact for small angles too, where arccos loses half of its digits
    mean = _mean(torch.where((sines == 0) & (cosines == 0), torch.pi / 2, angles), weights)
    return None if mean is None else float(torch.rad2deg(mean))


def weighted_psnr(found: Tensor, truth: Tensor, weights: Tensor) -> float | None:
    """Return the PSNR from the weighted mean of squared errors, dB; None if all weights are 0, NaN if one is NaN.

    Args:
        found, truth: (..., 3) colours in [0, 1].
        weights: (...) weights, at least 0.
    """
    error = _mean((to_float64(found) - to_float64(truth)).square().mean(-1), weights)
    return None if error is None else psnr_of_error(error)


def _mean(values: Tensor, weights: Tensor) -> Tensor | None:
    """Return the weighted mean () of `values`; None if all `weights` are 0."""
    weights = to_float64(weights)
    total = weights.sum()
    return None if total == 0 else (weights * values).sum() / total
