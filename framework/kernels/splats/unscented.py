"""Projection of Gaussians by the unscented transform, for any lens (3DGUT, Wu et al. 2024).

Seven sigma points stand for a Gaussian (Julier and Uhlmann 1997; weights of Wan and van der Merwe 2000). p is its
centre and v_k are its axes times their standard deviations, in the camera's frame:

    p_0 = p,  p_k = p + STEP v_k,  p_{k + 3} = p - STEP v_k      STEP^2 = ALPHA^2 (3 + KAPPA)
    mean = sum_i w_i f(p_i)                                      f: the lens, from points to pixels
    covariance = sum_i c_i (f(p_i) - mean) (f(p_i) - mean)^T

    w_i = c_i = OUTER = 1 / (2 STEP^2),   w_0 = CENTER = 1 - 3 / STEP^2,   c_0 = CENTER + 1 - ALPHA^2 + BETA

No Jacobian is taken, so a Gaussian may lie beside the camera or behind it. The covariance is returned as the columns
sqrt(c_i) (f(p_i) - mean), so that squares cannot cancel; gradients go through all seven points. `unscented.h` is the
same in C++.

**Points that a lens does not show.** A Gaussian is left out if the lens does not show its centre. For the lenses
`ALL_AROUND`, a sigma point beyond the lens's reach is moved to the edge of its disk, so that Gaussians there keep a
size. For the other lenses, a Gaussian is left out if the lens does not show all its sigma points, because points behind
the camera have no position.

**A panorama** (equirectangular) is an image of longitudes and latitudes. Longitudes are angles: they are counted from
the centre's longitude, within half a turn, and their mean is the angle of the mean sine and cosine. So a Gaussian on
the seam has the same size as elsewhere; `seam.py` draws its other side. Near a pole a Gaussian is wide, and the image
of a Gaussian that contains the pole is not an ellipse. Its longitudes still differ by at most half a turn, so the
covariance stays finite. The Gaussian covers much of the rows next to the pole, which show a small solid angle.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.geometry.lenses import Distortion, project

ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
"""Spread of the sigma points, additional weight of the centre in the covariance, and second parameter of the spread.
With a smaller ALPHA, weights of both signs cancel in float32."""
STEP = ALPHA * math.sqrt(3 + KAPPA)
"""Distance of a sigma point from the centre, standard deviations."""
OUTER = 1 / (2 * STEP**2)
"""Weight of each sigma point but the centre."""
CENTER = 1 - 6 * OUTER
"""Weight of the centre in the mean."""
CENTER_SQUARED = CENTER + 1 - ALPHA**2 + BETA
"""Weight of the centre in the covariance; not negative."""
ALL_AROUND = ("fisheye", "equirectangular")
"""Lenses that may show points beside and behind the camera."""
TURN = 2 * math.pi


def unscented(
    at: Tensor, axes: Tensor, model: str, lens: Distortion | None, intrinsics: tuple[float, float, float, float],
    width: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Project K Gaussians by the unscented transform. Differentiable.

    Args:
        at: (K, 3) centres in the camera's frame: x right, y down, z forward.
        axes: (K, 3, 3) axes times their standard deviations, as columns, in the same frame.
        model: projection, a key of `LENSES`.
        lens: the distortion, for the models in `DISTORTED`.
        intrinsics: fx, fy, cx, cy, pixels; for equirectangular, pixels per radian.
        width: width of the image, pixels. Positions on a panorama repeat every turn; the one nearest to the middle of
            the image is returned.

    Returns:
        The means x, y (K,), pixels; columns (K, 2, 7) with the covariance as their products, pixels; and (K,) bool,
        whether the lens shows the Gaussian.
    """
    fx, fy, cx, cy = intrinsics
    steps = STEP * axes.transpose(1, 2)
    center = at[:, None]
    points = torch.cat([center, center + steps, center - steps], 1)  # (K, 7, 3)
    right, down, depth = points.flatten(0, 1).unbind(-1)
    local, lens = torch.stack([right, -down, -depth], -1), None if lens is None else lens.to(at)
    x, y, seen = (each.reshape(points.shape[:2]) for each in project(model, local, lens))
    off_x, off_y = x - x[:, :1], y - y[:, :1]
    mean_y = OUTER * off_y.sum(1, keepdim=True)
    if model == "equirectangular":
        sine, cosine = OUTER * off_x.sin()[:, 1:].sum(1), CENTER + OUTER * off_x.cos()[:, 1:].sum(1)
        mean_x = torch.atan2(sine, cosine)[:, None]
        off_x = _within_half_a_turn(off_x - mean_x)
        middle = (0.5 * width - cx) / fx
        at_x = middle + _within_half_a_turn(x[:, 0] + mean_x[:, 0] - middle)
    else:
        mean_x = OUTER * off_x.sum(1, keepdim=True)
        off_x, at_x = off_x - mean_x, x[:, 0] + mean_x[:, 0]
    columns = torch.stack([fx * off_x, fy * (off_y - mean_y)], 1) * math.sqrt(OUTER)
    middle_column = columns[..., :1] * math.sqrt(CENTER_SQUARED / OUTER)
    shown = seen[:, 0] if model in ALL_AROUND else seen.all(1)
    return (
        fx * at_x + cx,
        fy * (y[:, 0] + mean_y[:, 0]) + cy,
        torch.cat([middle_column, columns[..., 1:]], -1),
        shown,
    )


def _within_half_a_turn(angles: Tensor) -> Tensor:
    """Return the same directions as angles in [-pi, pi]."""
    return angles - TURN * torch.round(angles / TURN)
