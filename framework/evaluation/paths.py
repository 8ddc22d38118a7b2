"""Camera paths for animations."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.kernels.math import safe_normalize
from nerfloom.renderable import Renderable

MIN_JUMP = 5.0
"""A walk counts as jumping if a step reaches this multiple of the median step."""
AROUND, ABOVE, OPENING = 1.0, math.radians(20), math.radians(50)
"""Of cameras around a scene: distance from its middle in edges of its box, elevation and field of view, radians."""
MIN_CAMERAS = 3
"""Minimum number of cameras between two jumps; shorter stretches are left out of an interpolated path."""
MAX_GAP = 60.0
"""Cameras stand all around a centre if no gap between them exceeds this angle, degrees."""
MIN_HORIZONTAL = 0.2
"""Cameras closer to the vertical axis than this, relative to the mean horizontal distance, count as above or below."""
SMOOTHING = 24
"""Number of cameras divided by the standard deviation, in cameras, of the weights of an interpolated path."""
MIN_MEAN_DIRECTION = 0.7
"""Cameras look the same way if the mean of their unit viewing directions is at least this long."""
SMALL_RADIUS = 0.1
"""Ratio of a spiral's radius to its focus distance, for cameras that look different ways."""
FOCUS_PIXELS = 64
"""Number of pixels along the longer side of the image used to measure that distance."""


def look_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the camera-to-world pose (3, 4) of a camera at `position` (3,) that looks at `target` (3,).

    `up` (3,) is the upward direction in the image; if the camera looks along it, +y is used instead.
    """
    back = safe_normalize(position - target)
    right = torch.linalg.cross(up, back)
    if right.norm() < 1e-6:
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back)
    right = safe_normalize(right)
    return torch.stack([right, torch.linalg.cross(back, right), back, position], dim=-1)


@dataclass(frozen=True)
class Arc:
    """A part of a horizontal circle."""

    middle: float
    """Angle of its middle from +x towards +y, radians."""
    width: float
    """Angular width, radians."""


def arc_of(cameras: Cameras, center: Tensor) -> Arc | None:
    """Return the arc around a centre where cameras stand; None if they stand all around it.

    They stand all around if no gap between neighbours exceeds `MAX_GAP`. Cameras almost above or below the centre are
    ignored.

    Args:
        cameras: M cameras.
        center: (3,) centre, scene units.
    """
    offsets = (cameras.camera_to_worlds[:, :2, 3] - center[:2]).double().cpu()
    away = offsets.norm(dim=-1)
    offsets = offsets[away > MIN_HORIZONTAL * away.mean()]
    if len(offsets) < MIN_CAMERAS:
        return None
    angles = torch.atan2(offsets[:, 1], offsets[:, 0]).sort().values
    gaps = torch.cat([angles[1:], angles[:1] + 2 * torch.pi]) - angles
    largest = int(gaps.argmax())
    if gaps[largest] <= math.radians(MAX_GAP):
        return None
    width = 2 * math.pi - float(gaps[largest])
    return Arc(float(angles[(largest + 1) % len(angles)]) + width / 2, width)


def orbit(cameras: Cameras, center: Tensor, num_frames: int, arc: Arc | None = None) -> Cameras:
    """Return cameras on a horizontal circle, looking at its centre; the path is closed.

    Height and radius are the means over the given cameras, and intrinsics are those of the first camera.

    Args:
        cameras: M cameras.
        center: (3,) centre, scene units.
        num_frames: number of cameras on the circle.
        arc: part of the circle on which the cameras swing once back and forth, slowly at its ends; None for the whole
            circle.
    """
    offsets = cameras.camera_to_worlds[:, :, 3] - center
    height, radius = offsets[:, 2].mean(), offsets[:, :2].norm(dim=-1).mean()
    angles = torch.arange(num_frames) * (2 * torch.pi / num_frames)
    if arc is not None:
        angles = arc.middle + arc.width / 2 * angles.sin()
    circle = torch.stack([radius * angles.cos(), radius * angles.sin(), height.expand(num_frames)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack([look_at(center + offset, center, up) for offset in circle])
    return replace_poses(cameras, poses)


def around(scene: Scene, count: int = 8) -> Cameras:
    """Return pinhole cameras on a circle around the box of a scene that comes without any, looking down a little.

    Args:
        scene: the scene, +z up.
        count: number of cameras.
    """
    middle, reach = scene.box.mean(0).cpu(), AROUND * float((scene.box[1] - scene.box[0]).max())
    angles, side = torch.arange(count) * (2 * torch.pi / count), scene.image_size
    height = torch.full((count,), math.sin(ABOVE))
    places = torch.stack([math.cos(ABOVE) * angles.cos(), math.cos(ABOVE) * angles.sin(), height], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack([look_at(middle + reach * place, middle, up) for place in places])
    focal, half = torch.full((count,), 0.5 * side / math.tan(OPENING / 2)), torch.full((count,), 0.5 * side)
    sides = torch.full((count,), side)
    return Cameras(poses, focal, focal, half, half, sides, sides)


def interpolate(cameras: Cameras, num_frames: int) -> Cameras:
    """Return cameras along a smooth path past given cameras, in their order, without hand shake.

    A pose is the mean of nearby poses in that order, weighted by a Gaussian; its rotation is the one closest to the
    mean matrix. No mean is taken across a jump of the walk, because the mean could lie inside the subject: the path
    jumps there too. Intrinsics are those of the first camera.

    Args:
        cameras: M cameras.
        num_frames: number of cameras on the path.
    """
    parts = stretches(cameras)
    kept = torch.cat(parts)
    part = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor([len(each) for each in parts]))
    width = max(len(kept) / SMOOTHING, 0.5)
    positions = torch.linspace(0, len(kept) - 1, num_frames, dtype=torch.float64)
    weights = torch.exp(-0.5 * ((positions[:, None] - torch.arange(len(kept))) / width).square())
    weights = weights * (part == part[positions.round().long(), None])
    weights = weights / weights.sum(-1, keepdim=True)
    means = torch.einsum("fm,mij->fij", weights, cameras.camera_to_worlds[kept].double())
    return replace_poses(cameras, torch.cat([nearest_rotations(means[:, :, :3]), means[:, :, 3:]], dim=-1).float())


def stretches(cameras: Cameras) -> list[Tensor]:
    """Return the indices of the cameras in each stretch of a walk between jumps; short stretches are left out.

    Args:
        cameras: M cameras, in the order of the walk.
    """
    centers = cameras.camera_to_worlds[:, :, 3].double().cpu()
    steps = (centers[1:] - centers[:-1]).norm(dim=-1)
    usual = float(steps.median()) if len(steps) else 0.0
    jumps = (steps > MIN_JUMP * usual).nonzero()[:, 0] + 1 if usual > 0 else torch.zeros(0, dtype=torch.long)
    parts = torch.tensor_split(torch.arange(len(cameras)), jumps)
    return [part for part in parts if len(part) >= MIN_CAMERAS] or [torch.arange(len(cameras))]


def spiral(cameras: Cameras, num_frames: int, focus: float, radius: float | None = None) -> Cameras:
    """Return cameras on a spiral around the mean camera, looking at a point in front of it.

    The path is LLFF's (Mildenhall et al. 2019): two turns in the mean camera's image plane, while it moves once back
    and forth, and ends where it starts. If the cameras do not look the same way, the first camera replaces the mean
    camera. Intrinsics are those of the first camera.

    Args:
        cameras: M cameras.
        num_frames: number of cameras on the spiral.
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
    angles = torch.arange(num_frames) * (4 * torch.pi / num_frames)
    local = torch.stack([angles.cos(), -angles.sin(), -(angles / 2).sin()], dim=-1) * radii
    target = position - focus * rotation[:, 2]
    poses = [look_at(position + offset, target, rotation[:, 1]) for offset in local @ rotation.T]
    return replace_poses(cameras, torch.stack(poses))


def middle_pose(cameras: Cameras) -> Tensor:
    """Return the mean pose (3, 4) of cameras that look the same way; the pose of the first camera for others.

    Args:
        cameras: M cameras.
    """
    if not look_same_way(cameras):
        return cameras.camera_to_worlds[0]
    mean = cameras.camera_to_worlds.double().mean(0)
    return torch.cat([nearest_rotations(mean[None, :, :3])[0], mean[:, 3:]], dim=-1).float()


def look_same_way(cameras: Cameras) -> bool:
    """Return whether the mean of the viewing directions of `cameras` is longer than `MIN_MEAN_DIRECTION`."""
    return float(cameras.camera_to_worlds[:, :, 2].mean(0).norm()) > MIN_MEAN_DIRECTION


def focus_distance(model: Renderable, camera: Cameras, background: Tensor) -> float:
    """Return the median rendered distance of one camera's picture, scene units.

    Args:
        model: the trained model.
        camera: one camera, on the model's device.
        background: (3,) colour behind the scene.
    """
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
