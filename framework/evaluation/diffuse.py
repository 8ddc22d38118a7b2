"""Error of rendered diffuse light, the light of surfaces without their reflections, against the true one."""

from __future__ import annotations

from torch import Tensor

from nerfloom.base.device import to_float64
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.appearance import right_half
from nerfloom.evaluation.metrics import psnr_of_error
from nerfloom.evaluation.normals import object_weights
from nerfloom.kernels.color import to_srgb
from nerfloom.rendering.outputs import DIFFUSE
from nerfloom.rendering.rendered import Picture


def diffuse_psnr(picture: Picture, dataset: Dataset, index: int, half: bool) -> float | None:
    """Return the PSNR of the rendered diffuse light of a view in display colours, dB.

    A pixel has the weight that it has in `normal_mae`, so that pixels beside the object do not count. Nothing is
    aligned: an error of scale counts.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.
        half: whether only the right half counts.

    Returns:
        The PSNR; None if the method renders no diffuse light, the data have none, or no pixel counts.
    """
    truth = dataset.diffuse_of(index)
    if truth is None or DIFFUSE.name not in picture.extras:
        return None
    found, target = picture.extras[DIFFUSE.name], to_srgb(truth).clamp(max=1)
    weights = object_weights(picture, dataset, index)
    return weighted_psnr(*((right_half(each) if half else each) for each in (found, target, weights)))


def weighted_psnr(found: Tensor, truth: Tensor, weights: Tensor) -> float | None:
    """Return the PSNR from the weighted mean of squared errors, dB; None if all weights are 0, NaN if one is NaN.

    Args:
        found, truth: (..., 3) colours in [0, 1].
        weights: (...) weights, at least 0.
    """
    found, truth, weights = to_float64(found), to_float64(truth), to_float64(weights)
    total = weights.sum()
    if total == 0:
        return None
    return psnr_of_error((weights * (found - truth).square().mean(-1)).sum() / total)
