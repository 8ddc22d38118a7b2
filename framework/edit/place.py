"""Placement of Gaussians: moved, turned, scaled, set up, aligned to points or to the floor."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import UP, looked_at, rotation_between
from nerfloom.cameras.scale import checked
from nerfloom.edit.edited import Edited
from nerfloom.edit.similarity import Similarity, about, axis_rotation, direction, vector
from nerfloom.geometry.alignment import align
from nerfloom.geometry.floor import Plane, find_floor, size_of
from nerfloom.geometry.regions import Vector
from nerfloom.renderable import training_poses

ORIGIN: Vector = (0.0, 0.0, 0.0)
"""The origin."""
NEAR_FLOOR = 0.01
"""Distance from the floor in the report of `align_floor`, scene sizes (`size_of`)."""


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
    """Find the floor, and move Gaussians so that it becomes the plane z = 0, with the origin under the subject.

    The floor is a plane: most opaque Gaussians have their centres on it, and few have them below. The subject is the
    point that the cameras look at. If they are not known, or it is outside of the opaque Gaussians or below the floor,
    the origin is the floor's middle.

    Args:
        up: the direction that is about upwards, of any length but 0; None for the up direction of the last `set_up` or
            `align_floor`, or else of the scene, which comes from the cameras of photographs.
        max_tilt: maximum angle between it and the floor's normal, degrees.
        tolerance: maximum distance of the floor's centres from it; None for 1 % of the median distance of all opaque
            centres from their middle.
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
    near = float(f"{NEAR_FLOOR * size_of(opaque):.1g}")
    share = float((((opaque - floor.center) @ floor.normal).abs() <= near).double().mean())
    within = f"within {near:g} {edited.scale.unit or 'units'} of the floor"
    say(f"align_floor: {share:.0%} of the opaque Gaussians are {within}, which was tilted by {tilt:.2f}°")
    subject = _subject(edited, opaque, floor)
    if subject is None:
        foot, where = floor.center, "in its middle"
    else:
        foot = subject - floor.normal * ((subject - floor.center) @ floor.normal)
        where = "under the point that the cameras look at"
    say(f"align_floor: the origin is on the floor, {where}")
    return replace(edited.moved(Similarity(rotation, 1.0, -(rotation @ foot))), up=UP)


def _subject(edited: Edited, opaque: Tensor, floor: Plane) -> Tensor | None:
    """Return the point (3,) that cameras look at, if it is among centres `opaque` (N, 3) and above the floor."""
    poses = None if edited.loaded is None else training_poses(edited.loaded.model)
    point = None if poses is None or not len(poses) else looked_at(edited.placement.original_poses(poses.cpu()))
    if point is None or float((point - floor.center) @ floor.normal) < 0:
        return None
    inside = (point >= opaque.amin(0)) & (point <= opaque.amax(0))
    return point if bool(inside.all()) else None
