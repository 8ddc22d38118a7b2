"""Error of rendered normals against true ones: the mean angular error of Ref-NeRF (Verbin et al. 2022), section 5."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.device import to_float64
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.appearance import right_half
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture


def normal_mae(picture: Picture, dataset: Dataset, index: int, half: bool) -> float | None:
    """Return the mean angle between rendered and true normals of a view, degrees.

    A pixel's weight is its rendered opacity times the alpha of the true image, as in the authors' code, so that pixels
    beside the object do not count.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.
        half: whether only the right half counts.

    Returns:
        The angle; None if the method renders no normals, the data have none, or no pixel counts.
    """
    truth = dataset.normals_of(index)
    if truth is None or NORMALS.name not in picture.extras:
        return None
    found, weights = picture.extras[NORMALS.name], object_weights(picture, dataset, index)
    return mean_angle(*((right_half(each) if half else each) for each in (found, truth, weights)))


def object_weights(picture: Picture, dataset: Dataset, index: int) -> Tensor:
    """Return the weights (H, W) of pixels where properties of an object's surface are compared.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.

    Returns:
        Rendered opacity times the alpha of the true image, if it has any; 0 for ignored pixels.
    """
    image, kept = dataset.image(index), dataset.kept_of(index)
    weights = picture.accumulation
    if image.shape[-1] == 4:
        weights = weights * image[..., 3] / 255
    return weights if kept is None else weights * kept


def mean_angle(found: Tensor, truth: Tensor, weights: Tensor) -> float | None:
    """Return the weighted mean angle between unit vectors, degrees; None if all weights are 0, NaN if one is NaN.

    Args:
        found, truth: (..., 3) unit vectors; a vector of length 0 is 90 degrees from every other.
        weights: (...) weights, at least 0.
    """
    found, truth, weights = to_float64(found), to_float64(truth), to_float64(weights)
    total = weights.sum()
    if total == 0:
        return None
    sines, cosines = torch.linalg.cross(found, truth).norm(dim=-1), (found * truth).sum(-1)
    angles = torch.atan2(sines, cosines)  # exact for small angles too, where arccos loses half of its digits
    angles = torch.where((sines == 0) & (cosines == 0), torch.pi / 2, angles)
    return float(torch.rad2deg((weights * angles).sum() / total))
