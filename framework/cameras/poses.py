"""Camera poses as a set: where a captured scene is and starts, and which photographs are held out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from framework.base.splits import Split
from framework.cameras.cameras import Cameras
from framework.kernels.math import cross_matrix

Orientation = Literal["up", "pca", "none"]
Center = Literal["poses", "focus", "none"]
NEAR, NEAR_SHARE, MOST_POINTS = 0.05, 0.5, 2000
"""Where rays start without sparse points; as a share of the distance of the nearest; and how many are looked at."""


@dataclass(frozen=True)
class Placement:
    """A similarity from the input's frame to the scene's: `scale * (transform @ x)`."""

    transform: Tensor
    """(3, 4) rigid, applied before `scale`."""
    scale: float
    """Scene units per unit of the input."""

    def points(self, points: Tensor) -> Tensor:
        """Points (K, 3) of the input in the scene's frame."""
        return self.scale * (points @ self.transform[:, :3].T + self.transform[:, 3])

    def poses(self, poses: Tensor) -> Tensor:
        """Camera-to-world matrices (M, 3 or 4, 4) of the input as (M, 3, 4) of the scene."""
        rotations = self.transform[:, :3] @ poses[:, :3, :3]
        return torch.cat([rotations, self.points(poses[:, :3, 3])[..., None]], dim=-1)

    def original_points(self, points: Tensor) -> Tensor:
        """Points (K, 3) of the scene in the input's frame: the inverse of `points`."""
        return (points / self.scale - self.transform[:, 3]) @ self.transform[:, :3]

    def original_directions(self, directions: Tensor) -> Tensor:
        """Unit directions (K, 3) of the scene in the input's frame."""
        return directions @ self.transform[:, :3]

    def original_poses(self, poses: Tensor) -> Tensor:
        """Camera-to-world matrices (M, 3, 4) of the scene as those of the input: the inverse of `poses`."""
        rotations = self.transform[:, :3].T @ poses[:, :, :3]
        return torch.cat([rotations, self.original_points(poses[:, :, 3])[..., None]], dim=-1)


def place(
    poses: Tensor, orientation: Orientation = "up", center: Center = "poses", auto_scale: bool = True
) -> Placement:
    """Where to put a captured scene: as nerfstudio does, so that settings carry over.

    Args:
        poses: (M, 3 or 4, 4) camera-to-world, OpenGL axes.
        orientation: up: the cameras' mean up direction becomes +z. pca: the camera positions' directions of largest
            spread become x and y. none: as it is.
        center: poses: the cameras' mean position becomes the origin. focus: the point that their optical axes pass
            closest to (least squares). none: as it is.
        auto_scale: all coordinates of the cameras' positions lie within [-1, 1], and one on its end.
    """
    exact = poses[:, :3].double()
    origins = exact[:, :, 3]
    middle = origins.mean(0)
    if center == "focus":
        middle = nearest_point(origins, -exact[:, :, 2])
    elif center == "none":
        middle = torch.zeros_like(middle)
    turn = torch.eye(3, dtype=torch.float64)
    if orientation == "up":
        turn = rotation_between(exact[:, :, 1].mean(0), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    elif orientation == "pca":
        turn = _principal_axes(origins, exact[:, :, 1].mean(0))
    transform = torch.cat([turn, -(turn @ middle)[:, None]], dim=-1)
    furthest = float(((origins - middle) @ turn.T).abs().max())
    scale = 1 / furthest if auto_scale and furthest > 0 else 1.0
    return Placement(transform.float(), scale)


def rotation_between(start: Tensor, end: Tensor) -> Tensor:
    """(3, 3) the smallest rotation that takes the direction `start` (3,) to that of `end`; the identity for a zero."""
    identity = torch.eye(3, dtype=start.dtype)
    if not bool(start.norm() > 0) or not bool(end.norm() > 0):
        return identity
    a, b = start / start.norm(), end / end.norm()
    axis, cosine = torch.linalg.cross(a, b), torch.dot(a, b)
    if cosine < -1 + 1e-9:  # opposite: half a turn about anything perpendicular
        perpendicular = torch.linalg.cross(a, identity[int(a.abs().argmin())])
        perpendicular = perpendicular / perpendicular.norm()
        return 2 * torch.outer(perpendicular, perpendicular) - identity
    cross = cross_matrix(axis)
    return identity + cross + cross @ cross / (1 + cosine)


def nearest_point(origins: Tensor, directions: Tensor) -> Tensor:
    """(3,) the point with the smallest sum of squared distances to lines through `origins` (M, 3) along `directions`.

    Where the lines are parallel that is not one point, and the origins' mean is given.
    """
    unit = directions / directions.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    across = torch.eye(3, dtype=unit.dtype) - unit[:, :, None] * unit[:, None, :]
    matrix, right = across.mean(0), (across @ origins[:, :, None])[..., 0].mean(0)
    if float(torch.linalg.eigvalsh(matrix)[0]) < 1e-6:
        return origins.mean(0)
    return torch.linalg.solve(matrix, right)


def _principal_axes(points: Tensor, up: Tensor) -> Tensor:
    """(3, 3) rotation whose rows are the directions of most to least spread, the last being turned towards `up`."""
    centred = points - points.mean(0)
    axes = torch.linalg.eigh(centred.T @ centred).eigenvectors.flip(-1).T
    if bool(torch.dot(axes[2], up) < 0):
        axes = torch.stack([axes[0], axes[1], -axes[2]])
    if torch.linalg.det(axes) < 0:
        axes = torch.stack([axes[0], -axes[1], axes[2]])
    return axes


def nearest_shown(cameras: Cameras, points: Tensor | None) -> float:
    """A distance before which no photograph shows anything, scene units, judging by sparse points (K, 3).

    Matter right before cameras is what a few photographs explain best: on a can photographed from 62 places, held-out
    ones were 3 dB better when rays started at 0.3 rather than 0.05.
    """
    if points is None or not len(points):
        return NEAR
    points = points[torch.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).long()]
    shown = []
    for index in range(len(cameras)):
        columns, rows, ahead = cameras.project(points, index)
        inside = (columns >= 0) & (columns < cameras.widths[index]) & (rows >= 0) & (rows < cameras.heights[index])
        shown.append((points - cameras.camera_to_worlds[index, :, 3]).norm(dim=-1)[ahead & inside])
    distances = torch.cat(shown).sort().values
    # Not the very nearest, for a few points are always wrong.
    return NEAR if not len(distances) else NEAR_SHARE * float(distances[len(distances) // 100])


def held_out(names: list[str], split: Split, every: int = 8) -> Tensor:
    """Indices of a split, in the order of the names: every `every`-th by sorted name is held out, from the first.

    val and test are the same photographs. With `every` 0 none is held out, and all splits are all photographs.
    """
    order = sorted(range(len(names)), key=lambda index: names[index])
    if every > 0:
        order = [image for rank, image in enumerate(order) if (rank % every == 0) != (split == "train")]
    return torch.tensor(order, dtype=torch.int64)
