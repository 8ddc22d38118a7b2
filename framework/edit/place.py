"""Placement of Gaussians: moved, turned, scaled, set up, aligned to points or to the floor."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import rotation_between
from nerfloom.cameras.scale import checked
from nerfloom.edit.edited import UP, Edited
from nerfloom.edit.similarity import Similarity, about, axis_rotation, direction, vector
from nerfloom.geometry.alignment import align
from nerfloom.geometry.floor import find_floor
from nerfloom.geometry.regions import Vector

ORIGIN: Vector = (0.0, 0.0, 0.0)
"""The origin."""


def move(edited: Edited, by: Vector) -> Edited:
    """Move Gaussians by the shift `by`."""
    return edited.moved(Similarity(torch.eye(3, dtype=torch.float64), 1.0, vector(by)))


def rotate(edited: Edited, axis: Vector, degrees: float, center: Vector = ORIGIN) -> Edited:
    """Rotate Gaussians about an axis, with the colours that depend on the view.

    Args:
        axis: direction of the axis, of any length but 0.
        degrees: angle; counter-clockwise where the axis points to the viewer.
        center: a point on the axis.

    Raises:
        ConfigError: if the axis has no length.
    """
    return edited.moved(about(vector(center), axis_rotation(direction(axis, "axis"), degrees)))


def scale(edited: Edited, factor: float, center: Vector = ORIGIN, unit: str = "") -> Edited:
    """Scale Gaussians about a point.

    Args:
        factor: new lengths per old length.
        center: the point that stays.
        unit: name of the unit of the new lengths, which is written beside the file; empty if it is not known.

    Raises:
        ConfigError: if the unit is no short name.
    """
    moved = edited.moved(about(vector(center), scale=factor))
    return replace(moved, scale=checked(replace(moved.scale, unit=unit), "scale")) if unit else moved


def set_up(edited: Edited, up: Vector) -> Edited:
    """Rotate Gaussians about the origin, by the smallest angle, so that a direction becomes z, which is up.

    Args:
        up: the direction, of any length but 0.

    Raises:
        ConfigError: if it has no length.
    """
    moved = edited.moved(about(vector(ORIGIN), rotation_between(direction(up, "up"), UP)))
    return replace(moved, up=UP)


def align_points(
    edited: Edited, points: tuple[Vector, ...], targets: tuple[Vector, ...], with_scale: bool = True
) -> Edited:
    """Move Gaussians so that three or more points come to given places, by least squares.

    Args:
        points: the points; not all on a line.
        targets: where each of them is to be.
        with_scale: whether to scale as well. If not, only the middle of the points comes to its place exactly.

    Raises:
        DataError: if there are fewer than three pairs, or they lie on a line.
    """
    sources, places = (vector(values).reshape(len(values), 3) for values in (points, targets))
    factor, rotation, shift = align(sources, places)
    if not with_scale:
        factor, shift = 1.0, places.mean(0) - rotation @ sources.mean(0)
    if not factor > 0:
        raise ConfigError("align_points: the points do not have the shape of their targets; check their order")
    found = Similarity(rotation, factor, shift)
    misses = (factor * (sources @ rotation.T) + shift - places).norm(dim=-1)
    say(f"align_points: scaled by {factor:.6g}; the points are off their targets by up to {float(misses.max()):.3g}")
    return edited.moved(found)


def align_floor(
    edited: Edited,
    up: Vector | None = None,
    max_tilt: float = 45.0,
    tolerance: float | None = None,
    min_opacity: float = 0.5,
    seed: int = 0,
) -> Edited:
    """Find the floor, and turn Gaussians about its middle so that it becomes the plane z = 0.

    The floor is a plane: most opaque Gaussians have their centres on it, and few have them below.

    Args:
        up: the direction that is about upwards, of any length but 0; None for the up direction of the last `set_up` or
            `align_floor`, or else of the scene, which comes from the cameras of photographs.
        max_tilt: maximum angle between it and the floor's normal, degrees.
        tolerance: maximum distance of the floor's centres from it; None for 1 % of the scene's size.
        min_opacity: minimum opacity of the Gaussians that count.
        seed: seed of the search; the same one finds the same floor.

    Raises:
        ConfigError: if no floor is found.
    """
    gaussians = edited.gaussians
    opaque = gaussians.means[torch.sigmoid(gaussians.logits) >= min_opacity]
    upwards = edited.upwards if up is None else direction(up, "up")
    floor = find_floor(opaque, upwards, max_tilt, tolerance, seed)
    if floor is None:
        raise ConfigError(
            f"no floor is found: no plane through three of {len(opaque):,} opaque Gaussians has few below; say what is "
            "up (set_up, --up), give max_tilt, or lower min_opacity"
        )
    rotation = rotation_between(floor.normal, UP)
    tilt = math.degrees(2 * math.asin(min(float((floor.normal - UP).norm()) / 2, 1.0)))
    say(f"align_floor: {floor.share:.0%} of the opaque Gaussians are on the floor, which was tilted by {tilt:.2f}°")
    place = floor.center * vector((1.0, 1.0, 0.0))
    moved = edited.moved(Similarity(rotation, 1.0, place - rotation @ floor.center))
    return replace(moved, up=UP)
