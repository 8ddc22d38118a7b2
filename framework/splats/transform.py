"""Gaussians in another frame: similarities of centres, axes and spherical harmonics."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.splats.gaussians import Gaussians

DIRECTIONS = 64
"""Number of directions where harmonics are compared; 16 unknowns need at least 16."""
TOLERANCE = 1e-4
"""Maximum deviation of a rotation's R R^T from the identity."""


def transformed(gaussians: Gaussians, rotation: Tensor, scale: float, shift: Tensor) -> Gaussians:
    """Return Gaussians moved by the similarity x -> scale * rotation @ x + shift.

    They look the same from a camera moved by the same similarity: direction d becomes `rotation @ d`.
    Columns that a method added are dropped, since their transformation is unknown.

    Args:
        gaussians: N Gaussians.
        rotation: (3, 3) proper rotation.
        scale: new units per old unit, positive.
        shift: (3,) new units.

    Raises:
        ValueError: if `rotation` is not a rotation, or `scale` is not positive.
    """
    moved = transformed_in_float64(gaussians, rotation, scale, shift)
    return replace(moved, means=moved.means.to(gaussians.log_scales))


def transformed_in_float64(gaussians: Gaussians, rotation: Tensor, scale: float, shift: Tensor) -> Gaussians:
    """Return `transformed` Gaussians with float64 centres, for coordinates far from the origin.

    `gaussians`, `rotation`, `scale` and `shift` are as in `transformed`.

    Raises:
        ValueError: as `transformed`.
    """
    rotation = rotation.to(gaussians.means.device, torch.float64)
    shift = shift.to(rotation)
    identity = torch.eye(3).to(rotation)
    if float((rotation @ rotation.T - identity).abs().max()) > TOLERANCE or not float(torch.linalg.det(rotation)) > 0:
        raise ValueError(f"{rotation.tolist()} is not a rotation")
    if not 0 < scale < math.inf:
        raise ValueError(f"a scale must be positive, not {scale}")
    rotations = quaternion_product(quaternion(rotation), gaussians.rotations.double())
    return Gaussians(
        means=scale * (gaussians.means.double() @ rotation.T) + shift,
        log_scales=gaussians.log_scales + math.log(scale),
        rotations=rotations.to(gaussians.rotations),
        logits=gaussians.logits,
        colors=gaussians.colors,
        harmonics=rotated_harmonics(gaussians.harmonics, rotation),
    )


def quaternion(rotation: Tensor) -> Tensor:
    """Return the unit quaternions (..., 4) w, x, y, z of rotation matrices, with w >= 0.

    Each is the eigenvector of the largest eigenvalue of a symmetric matrix (Bar-Itzhack 2000), which needs no cases.

    Args:
        rotation: (..., 3, 3), float64.
    """
    a = rotation.movedim((-2, -1), (0, 1))
    rows = (
        (a[0, 0] + a[1, 1] + a[2, 2], a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]),
        (a[2, 1] - a[1, 2], a[0, 0] - a[1, 1] - a[2, 2], a[1, 0] + a[0, 1], a[2, 0] + a[0, 2]),
        (a[0, 2] - a[2, 0], a[1, 0] + a[0, 1], a[1, 1] - a[0, 0] - a[2, 2], a[2, 1] + a[1, 2]),
        (a[1, 0] - a[0, 1], a[2, 0] + a[0, 2], a[2, 1] + a[1, 2], a[2, 2] - a[0, 0] - a[1, 1]),
    )
    symmetric = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    vector = torch.linalg.eigh(symmetric).eigenvectors[..., -1]
    return torch.where(vector[..., :1] < 0, -vector, vector)


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Return quaternions (..., 4) w, x, y, z of the rotation `second` (..., 4), followed by `first`."""
    w, v = first[..., :1], first[..., 1:]
    other_w, other = second[..., :1], second[..., 1:]
    v, other = torch.broadcast_tensors(v, other)
    scalar = w * other_w - (v * other).sum(-1, keepdim=True)
    return torch.cat([scalar, w * other + other_w * v + torch.linalg.cross(v, other)], dim=-1)


def rotated_harmonics(harmonics: Tensor, rotation: Tensor) -> Tensor:
    """Return the coefficients of the rotated function: its value at d moves to `rotation @ d`.

    Rotations do not mix degrees. The matrix of each degree (Wigner's D, in the real basis) is found by solving for it
    at more directions than it has columns, in float64, which is exact up to rounding.

    Args:
        harmonics: (N, 3, K) coefficients of degrees 1 to D, as in `Gaussians`.
        rotation: (3, 3), float64.
    """
    levels = math.isqrt(harmonics.shape[2] + 1)
    if levels == 1:
        return harmonics
    directions = _spread_directions().to(rotation)
    basis = spherical_harmonics_reference(directions, levels)
    before = spherical_harmonics_reference(directions @ rotation, levels)  # at the inverse rotation of each direction
    parts = []
    for degree in range(1, levels):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = torch.linalg.lstsq(basis[:, band].cpu(), before[:, band].cpu()).solution.to(rotation)
        coefficients = harmonics[:, :, degree**2 - 1 : (degree + 1) ** 2 - 1].double()
        parts.append((coefficients @ matrix.T).to(harmonics))
    return torch.cat(parts, dim=-1)


def _spread_directions() -> Tensor:
    """Return unit vectors (DIRECTIONS, 3), float64, evenly spread over the sphere along a spiral."""
    steps = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1 - 2 * steps / DIRECTIONS
    angles = steps * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angles.cos(), radius * angles.sin(), z], dim=-1)
