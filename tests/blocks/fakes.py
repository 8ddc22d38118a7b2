"""Fully known blocks: pictures in closed form, in scenes of their own."""

import math
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.blocks.block import IDENTITY, Affine, TrainedBlock, Vector
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.renderable import Renderable
from nerfloom.rendering.rendered import Picture

FAR = 50.0


def scene() -> Scene:
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return Scene(box, 0.1, FAR, num_cameras=4, has_alpha=False, moving=False, image_size=24, unbounded=True)


class Shown(Renderable):
    """Pictures with colours that are an affine function of the pixel's place, of one distance and one opacity.

    Args:
        matrix: (3, 4) from (row, column, their product, 1), each in [0, 1], to colours.
        distance: in the units of its own scene.
        opacity: of all pixels.
    """

    def __init__(self, matrix: Tensor, distance: float = 1.0, opacity: float = 1.0) -> None:
        self.scene, self.matrix, self.distance, self.opacity = scene(), matrix, distance, opacity
        self.views: list[View] = []

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def render_view(self, view: View, background: Tensor) -> Picture:
        self.views.append(view)
        flat = view.pixels()
        row, column = flat // view.camera.sizes[0][1] / 24, flat % view.camera.sizes[0][1] / 24
        places = torch.stack([row, column, row * column, torch.ones_like(row)], dim=-1)
        opaque = torch.full(flat.shape, self.opacity)
        rgb = self.opacity * (places @ self.matrix.T) + (1 - opaque)[..., None] * background
        depth = torch.full(flat.shape, self.distance if self.opacity else FAR)
        return Picture(rgb, depth, depth + 1, opaque, num_rays=flat.numel())


class Drifted(Shown):
    """Pictures of a scene that has drifted by half a unit along x while poses were refined."""

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        moved = poses.clone()
        moved[:, 0, 3] += 0.5
        return moved


def plain(red: float, green: float, blue: float, distance: float = 1.0, opacity: float = 1.0) -> Shown:
    """Pictures of one colour."""
    matrix = torch.zeros(3, 4)
    matrix[:, 3] = torch.tensor([red, green, blue])
    return Shown(matrix, distance, opacity)


def block(center: Vector, radius: float, cameras: tuple[int, ...] = (), color: Affine = IDENTITY) -> TrainedBlock:
    return TrainedBlock(center, radius, cameras, Path("run"), color)


def placement(scale: float, shift: Vector = (0.0, 0.0, 0.0), angle: float = 0.0) -> Placement:
    """A placement that turns the input about z, after that shifts it, and then scales it."""
    cosine, sine = math.cos(angle), math.sin(angle)
    rows = [[cosine, -sine, 0.0, shift[0]], [sine, cosine, 0.0, shift[1]], [0.0, 0.0, 1.0, shift[2]]]
    return Placement(torch.tensor(rows, dtype=torch.float64), scale)


def cameras(positions: list[Vector], model: str = "pinhole") -> Cameras:
    """Cameras of 24 x 24 pixels that look along -z."""
    count = len(positions)
    poses = torch.eye(3, 4).repeat(count, 1, 1)
    poses[:, :, 3] = torch.tensor(positions)
    values = [torch.full((count,), value) for value in (30.0, 30.0, 12.0, 12.0)]
    sizes = torch.full((count,), 24)
    return Cameras(poses, *values, sizes, sizes, model)
