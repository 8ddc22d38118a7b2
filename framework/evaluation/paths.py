"""Camera paths for animations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.framing import perspective
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.evaluation.tour import tour
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.kernels.math import safe_normalize
from nerfloom.renderable import Renderable

MIN_JUMP = 5.0
"""A walk counts as jumping if a step exceeds this multiple of the median step."""
AROUND, ABOVE, OPENING = 1.0, math.radians(20), 50.0
"""Place of cameras around a scene: distance from its middle in edges of its box, elevation in radians, field of view in
degrees."""
MIN_CAMERAS = 3
"""Minimum number of cameras between two jumps; shorter stretches are left out of an interpolated path."""
MAX_GAP = 60.0
"""Cameras stand all around a centre if no gap between them exceeds this angle, degrees."""
MIN_HORIZONTAL = 0.2
"""Cameras closer to the vertical axis than this, relative to the mean horizontal distance, count as above or below."""
NEARBY = math.radians(20)
"""Standard deviation, radians, of the weights of the cameras in a direction of an orbit."""
SMOOTHING = 24
"""Number of cameras divided by the standard deviation, in cameras, of the weights of an interpolated path."""
MIN_WIDTH = 0.5
"""Minimum of that standard deviation, cameras."""
CONTINUED = 4.0
"""Continuation of a stretch beyond its ends, for the means there, in such deviations."""
MEASURED = 1000
"""Number of positions that measure the length of a stretch of a path."""
MIN_MEAN_DIRECTION = 0.7
"""Cameras look the same way if the mean of their unit viewing directions is at least this long."""
SMALL_RADIUS = 0.1
"""Ratio of a spiral's radius to its focus distance, for cameras that look different ways."""
FOCUS_PIXELS = 64
"""Number of pixels along the longer side of the image used to measure that distance."""


def look_at(
    position: Tensor | Sequence[float], target: Tensor | Sequence[float], up: Tensor | Sequence[float] = (0.0, 0.0, 1.0)
) -> Tensor:
    """Return the camera-to-world pose (3, 4) of a camera that looks at a point, OpenGL axes.

    Its columns are the camera's right, its up, its backwards and its position.

    Args:
        position: (3,) position of the camera.
        target: (3,) point that is in the middle of the image.
        up: (3,) upward direction in the image; if the camera looks along it, +y is used instead.
    """
    eye, point, above = (torch.as_tensor(each) * 1.0 for each in (position, target, up))  # whole numbers, too
    back = safe_normalize(eye - point)
    right = torch.linalg.cross(above.to(back), back)
    if right.norm() < 1e-6:
        right = torch.linalg.cross(back.new_tensor([0.0, 1.0, 0.0]), back)
    right = safe_normalize(right)
    return torch.stack([right, torch.linalg.cross(back, right), back, eye.to(back)], dim=-1)


@dataclass(frozen=True)
class Arc:
    """A part of a horizontal circle."""

    middle: float
    """Angle of its middle from +x towards +y, radians."""
    width: float
    """Angular width, radians."""


def arc_of(cameras: Cameras, center: Tensor) -> Arc | None:
    """Return the arc around a `center` (3,) where M `cameras` stand; None if they stand all around it.

    They stand all around if no gap between neighbours exceeds `MAX_GAP`. Cameras almost above or below the centre are
    ignored.
    """
    offsets = _beside(cameras, center)
    if len(offsets) < MIN_CAMERAS:
        return None
    angles = torch.atan2(offsets[:, 1], offsets[:, 0]).sort().values
    gaps = torch.cat([angles[1:], angles[:1] + 2 * torch.pi]) - angles
    largest = int(gaps.argmax())
    if gaps[largest] <= math.radians(MAX_GAP):
        return None
    width = 2 * math.pi - float(gaps[largest])
    return Arc(float(angles[(largest + 1) % len(angles)]) + width / 2, width)


def _beside(cameras: Cameras, center: Tensor) -> Tensor:
    """Return the offsets (K, 3) float64 from a centre (3,) of cameras that are not almost above or below it."""
    offsets = (cameras.camera_to_worlds[:, :, 3] - center).double().cpu()
    away = offsets[:, :2].norm(dim=-1)
    return offsets[away > MIN_HORIZONTAL * away.mean()]


def fractions(count: int, closed: bool = True, ease: bool = False) -> Tensor:
    """Return how far along a path each of its frames is, (F,) float64 from 0 to 1.

    Args:
        count: number of frames.
        closed: whether the path returns to its start, where the first frame follows the last; otherwise the last frame
            is at its end.
        ease: whether the path starts and ends at rest: at 3 u^2 - 2 u^3 after a share u of the time. Otherwise its
            speed is constant.
    """
    shares = torch.arange(count, dtype=torch.float64) / (count if closed else max(count - 1, 1))
    return shares.square() * (3 - 2 * shares) if ease else shares


def orbit(
    cameras: Cameras,
    center: Tensor,
    along: Tensor,
    arc: Arc | None = None,
    radius: float | None = None,
    follow: bool = False,
) -> Cameras:
    """Return cameras that go around a centre and look at it; the path is closed.

    Intrinsics come from the first camera. The path is a horizontal circle, with the mean height and distance of the
    given cameras; or it follows them, and so stays where they have looked from: in each direction, elevation and
    distance are the means over the cameras, weighted by a von Mises distribution of the angle between (`NEARBY`).

    Args:
        cameras: M cameras.
        center: (3,) centre, scene units.
        along: (F,) fraction of the path at each frame, from `fractions`.
        arc: directions of the path; it swings over them once back and forth, slowly at its ends; None for all around.
        radius: another mean horizontal distance of the cameras, scene units. The height changes alike, so that the
            elevation stays.
        follow: whether the path follows the cameras.
    """
    offsets = (cameras.camera_to_worlds[:, :, 3] - center).double().cpu()
    height, mean = offsets[:, 2].mean(), offsets[:, :2].norm(dim=-1).mean()
    angles = 2 * torch.pi * along.double().cpu()
    if arc is not None:
        angles = arc.middle + arc.width / 2 * angles.sin()
    heights, away = height.expand(len(angles)), mean.expand(len(angles))
    if follow and len(beside := _beside(cameras, center)):
        elevations, distances = _followed(beside, angles)
        heights, away = distances * elevations.sin(), distances * elevations.cos()
    path = torch.stack([away * angles.cos(), away * angles.sin(), heights], dim=-1)
    if radius is not None:
        path = path * (radius / mean.clamp(min=1e-6))
    poses = torch.stack([look_at(center + offset, center) for offset in path.to(center)])
    return replace_poses(cameras, poses)


def _followed(offsets: Tensor, angles: Tensor) -> tuple[Tensor, Tensor]:
    """Return elevations, radians, and distances (F,) of cameras at `offsets` (K, 3) in directions `angles` (F,)."""
    distances = offsets.norm(dim=-1)
    elevations = torch.asin((offsets[:, 2] / distances.clamp(min=1e-12)).clamp(-1, 1))
    apart = angles[:, None] - torch.atan2(offsets[:, 1], offsets[:, 0])
    weights = torch.softmax(apart.cos() / NEARBY**2, dim=-1)  # of K cameras, for each direction
    return weights @ elevations, weights @ distances


def around(scene: Scene, count: int = 8) -> Cameras:
    """Return `count` pinhole cameras around the box of `scene`, +z up and without any, looking down a little."""
    middle, reach = scene.box.mean(0).cpu(), AROUND * float((scene.box[1] - scene.box[0]).max())
    angles = torch.arange(count) * (2 * torch.pi / count)
    height = torch.full((count,), math.sin(ABOVE))
    places = torch.stack([math.cos(ABOVE) * angles.cos(), math.cos(ABOVE) * angles.sin(), height], dim=-1)
    poses = torch.stack([look_at(middle + reach * place, middle) for place in places])
    return perspective(poses, scene.image_size, scene.image_size, OPENING)


def outlooks(scene: Scene) -> Cameras:
    """Return pinhole cameras for a `scene` without photographs: where its cameras stood, or else around its box."""
    poses = scene.camera_to_worlds
    if poses is None:
        return around(scene)
    return perspective(poses.cpu(), scene.image_size, scene.image_size, OPENING)


# -- a walk past cameras ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Walk:
    """A way past cameras, in stretches between jumps."""

    stretches: tuple[Tensor, ...]
    """Indices (K,) int64 of the cameras in each stretch, in their order."""
    closed: bool = False
    """Whether the first camera follows the last; there is then one stretch."""


def shortest_order(cameras: Cameras, closed: bool = True) -> Tensor:
    """Return the order (M,) int64 of a short tour past M `cameras`, each once, and back if `closed` (`tour`).

    Distances and turns count: a turn by a radian equals the cameras' distance from their mean position.
    """
    return tour(_stations(cameras.camera_to_worlds), closed)


def walk_of(cameras: Cameras, closed: bool = False) -> Walk:
    """Return a walk past cameras in their order. It leaves out short stretches, and is cut where it jumps.

    Args:
        cameras: M cameras, in the order of the walk.
        closed: whether the walk returns to the first camera. It does not if it jumps anywhere.
    """
    count, stations = len(cameras), _stations(cameras.camera_to_worlds)
    steps = (stations.roll(-1, 0) - stations).norm(dim=-1)
    usual = float(steps[:-1].median()) if count > 1 else 0.0
    cut = steps > MIN_JUMP * usual if usual > 0 else torch.zeros(count, dtype=torch.bool)
    if closed and not bool(cut.any()):
        return Walk((torch.arange(count),), closed=True)
    # An open walk ends with the last camera; one that was to be closed begins anew behind its last jump.
    end = int(cut.nonzero()[-1]) if closed else count - 1
    order = torch.arange(count).roll(-(end + 1))
    cuts = cut[order][:-1].nonzero()[:, 0] + 1
    parts = tuple(part for part in torch.tensor_split(order, cuts) if len(part) >= MIN_CAMERAS)
    return Walk(parts or (order,))


def interpolate(cameras: Cameras, along: Tensor, walk: Walk) -> Cameras:
    """Return cameras along a smooth path past given cameras, without hand shake, and at equal lengths for equal shares.

    A pose is the mean of nearby poses of the walk, weighted by a Gaussian; its rotation is the one closest to the mean
    matrix. No mean is taken across a jump of the walk, because the mean could lie inside the subject: the path jumps
    there too. Intrinsics come from the first camera.

    Args:
        cameras: M cameras.
        along: (F,) fraction of the path's length at each frame, from `fractions`.
        walk: the order of the cameras.
    """
    poses = cameras.camera_to_worlds.double().cpu()
    reach, width = _reach(poses), max(sum(map(len, walk.stretches)) / SMOOTHING, MIN_WIDTH)
    parts = [poses[part] for part in walk.stretches]
    lengths = [_lengths(part, width, reach, walk.closed) for part in parts]
    starts = np.cumsum([0.0, *(length[-1] for length in lengths)])
    wanted = along.double().numpy() * starts[-1]
    chosen = np.searchsorted(starts[1:-1], wanted, side="right")
    found = torch.empty(len(wanted), 3, 4, dtype=torch.float64)
    for index, (part, length) in enumerate(zip(parts, lengths, strict=True)):
        here = np.flatnonzero(chosen == index)
        places = np.interp(wanted[here] - starts[index], length, _places(part, walk.closed))
        found[torch.from_numpy(here)] = _smoothed(part, torch.from_numpy(places), width, walk.closed)
    return replace_poses(cameras, found.float())


def _places(poses: Tensor, closed: bool) -> np.ndarray:
    """Return the places on a stretch (M, 3, 4) where its length is measured: 0 at the first camera, 1 at the next."""
    return np.linspace(0, len(poses) - (not closed), MEASURED)


def _lengths(poses: Tensor, width: float, reach: float, closed: bool) -> np.ndarray:
    """Return the length of the smoothed path through a stretch (M, 3, 4) up to each of its `_places`."""
    stations = _stations(_smoothed(poses, torch.from_numpy(_places(poses, closed)), width, closed), reach)
    return np.concatenate([[0.0], (stations[1:] - stations[:-1]).norm(dim=-1).cumsum(0).numpy()])


def _smoothed(poses: Tensor, places: Tensor, width: float, closed: bool) -> Tensor:
    """Return the means (F, 3, 4) of poses (M, 3, 4) with Gaussian weights around places (F,), in cameras.

    Beyond an end that is not closed, the poses are continued by their reflection in the last one, so that the means
    start and end with the first and the last pose.
    """
    last, margin = len(poses) - 1, math.ceil(CONTINUED * width)
    if closed:
        numbers = torch.arange(-margin, last + margin + 1)
        known = poses[numbers % len(poses)]
    else:
        margin = min(margin, last)
        numbers = torch.arange(-margin, last + margin + 1)
        reflected = last - (last - numbers.abs()).abs()
        known = 2 * poses[numbers.clamp(0, last)] - poses[reflected]
    weights = torch.exp(-0.5 * ((places[:, None] - numbers) / width).square())
    means = torch.einsum("fm,mij->fij", weights / weights.sum(-1, keepdim=True), known)
    return torch.cat([nearest_rotations(means[:, :, :3]), means[:, :, 3:]], dim=-1)


def _stations(poses: Tensor, reach: float | None = None) -> Tensor:
    """Return positions and viewing directions of poses (M, 3, 4) in one space (M, 6), directions times `reach`."""
    precise = poses.double().cpu()
    return torch.cat([precise[:, :, 3], -(_reach(precise) if reach is None else reach) * precise[:, :, 2]], dim=-1)


def _reach(poses: Tensor) -> float:
    """Return the root mean square of the distances of poses (M, 3, 4) from their mean position."""
    centers = poses[:, :, 3].double()
    return float((centers - centers.mean(0)).square().sum(-1).mean().sqrt())


def spiral(cameras: Cameras, along: Tensor, focus: float, radius: float | None = None) -> Cameras:
    """Return cameras on a spiral around the mean camera, looking at a point in front of it.

    The path is LLFF's (Mildenhall et al. 2019): two turns in the mean camera's image plane, while it moves once back
    and forth, and ends where it starts. If the cameras do not look the same way, the first camera replaces the mean
    camera. Intrinsics come from the first camera.

    Args:
        cameras: M cameras.
        along: (F,) fraction of the path at each frame, from `fractions`.
        focus: distance of the target point from the mean camera, scene units.
        radius: radius along each of its axes, scene units. If None, it is the 90th percentile of the cameras' distances
            from the mean camera along each axis, or `SMALL_RADIUS` times `focus` if they do not look the same way.
    """
    center = middle_pose(cameras)
    rotation, position = center[:, :3], center[:, 3]
    if radius is not None:
        radii = torch.full((3,), radius)
    elif look_same_way(cameras):
        offsets = (cameras.camera_to_worlds[:, :, 3] - position) @ rotation
        radii = torch.quantile(offsets.abs(), 0.9, dim=0)
    else:
        radii = torch.full((3,), SMALL_RADIUS * focus)
    angles = (4 * torch.pi * along).float()
    local = torch.stack([angles.cos(), -angles.sin(), -(angles / 2).sin()], dim=-1) * radii
    target = position - focus * rotation[:, 2]
    poses = [look_at(position + offset, target, rotation[:, 1]) for offset in local @ rotation.T]
    return replace_poses(cameras, torch.stack(poses))


def middle_pose(cameras: Cameras) -> Tensor:
    """Return the mean pose (3, 4) of M `cameras` that look the same way; the first camera's for others."""
    if not look_same_way(cameras):
        return cameras.camera_to_worlds[0]
    mean = cameras.camera_to_worlds.double().mean(0)
    return torch.cat([nearest_rotations(mean[None, :, :3])[0], mean[:, 3:]], dim=-1).float()


def look_same_way(cameras: Cameras) -> bool:
    """Return whether the mean of the viewing directions of `cameras` is longer than `MIN_MEAN_DIRECTION`."""
    return float(cameras.camera_to_worlds[:, :, 2].mean(0).norm()) > MIN_MEAN_DIRECTION


def focus_distance(model: Renderable, camera: Cameras, background: Tensor) -> float:
    """Return the median distance, scene units, in the picture of one `camera` by `model` over `background` (3,)."""
    stride = max(int(max(camera.widths[0], camera.heights[0])) // FOCUS_PIXELS, 1)
    picture = model.render_view(View.of(camera, 0, _first_time(model), stride), background)
    depths = picture.median_depth[picture.accumulation > 0.5]
    depth = float(depths.median()) if len(depths) else model.scene.near + 1.0
    if isinstance(camera, NdcCameras) and camera.ndc is not None:
        # A point at depth d lies at z = 1 - 2 near / d in the box, on a ray that starts at z = -1.
        return 2 * camera.ndc.near / max(2 - depth, 1e-2)
    return depth


def _first_time(model: Renderable) -> Tensor | None:
    return torch.zeros(1) if model.scene.moving else None


def replace_poses(cameras: Cameras, poses: Tensor) -> Cameras:
    """Return cameras with `poses` (K, 3, 4) and the intrinsics of the first of `cameras`."""
    return replace(cameras[torch.zeros(len(poses), dtype=torch.long)], camera_to_worlds=poses)
