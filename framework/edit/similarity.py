"""Similarity transforms of Gaussians: rotations about an axis, turns, scales and shifts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.kernels.math import cross_matrix


class Similarity(NamedTuple):
    """The transform x -> scale * rotation @ x + shift."""

    rotation: Tensor
    """(3, 3) float64 proper rotation."""
    scale: float
    """New units per old unit, positive."""
    shift: Tensor
    """(3,) float64, new units."""


def vector(values: Sequence[float] | Sequence[Sequence[float]]) -> Tensor:
    """Return three coordinates `values`, or several points' coordinates, as a tensor float64."""
    return torch.tensor(values, dtype=torch.float64)


def direction(values: Sequence[float], name: str) -> Tensor:
    """Return the direction `values`, of any length but 0, as a unit vector (3,) float64; `name` is for the message.

    Raises:
        ConfigError: if the length is 0.
    """
    found = vector(values)
    length = float(found.norm())
    if not length > 0:
        raise ConfigError(f"{name} is {tuple(values)}, which is no direction; give one with a length")
    return found / length


def about(center: Tensor, rotation: Tensor | None = None, scale: float = 1.0) -> Similarity:
    """Return the similarity that turns by `rotation` (3, 3), if any, and scales by `scale` about `center` (3,)."""
    turn = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
    return Similarity(turn, scale, center - scale * (turn @ center))


def axis_rotation(axis: Tensor, degrees: float) -> Tensor:
    """Return the rotation (3, 3) by `degrees` about the unit vector `axis` (3,) float64, by Rodrigues' formula."""
    angle, cross = math.radians(degrees), cross_matrix(axis)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
