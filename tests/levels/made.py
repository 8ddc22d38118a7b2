"""Clouds of Gaussians, files of levels made of them, and cameras that look at them."""

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.scene import Scene
from nerfloom.geometry.lenses import panorama
from nerfloom.levels.building import build_levels
from nerfloom.levels.files import Bits, LevelsFile, read_levels
from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.stream import GaussianStream
from tests.kernels.splat_truth import LENSES

CHUNK = 100
FAR = 50.0


def cloud(count: int = 3000, degree: int = 1, random: torch.Generator | None = None) -> Gaussians:
    """Gaussians in the cube from -1 to 1, of similar colours, most of them small."""
    random = random or torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=random)

    means = 2 * torch.rand(count, 3, generator=random) - 1
    scales, rest = math.log(0.02) + 0.4 * normal(3), 0.05 * normal(3, (degree + 1) ** 2 - 1)
    return Gaussians(means, scales, normal(4), 1 + normal(), 0.3 * normal(3), rest)


def built(
    file: Path, gaussians: Gaussians, chunk_size: int = CHUNK, bits: Bits = 32, memory: float = 0.5, look: Look = OURS
) -> LevelsFile:
    """The memory is so small that there are several buckets."""
    stream = GaussianStream.of(Splats(gaussians, look))
    build_levels(file, stream, torch.zeros(3, dtype=torch.float64), chunk_size, bits, memory)
    return read_levels(file)


def leaves(file: LevelsFile) -> list[int]:
    return file.nodes.is_leaf.nonzero()[:, 0].tolist()


def scene() -> Scene:
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return Scene(box, 0.05, FAR, num_cameras=0, has_alpha=False, moving=False, image_size=64)


def camera(distance: float = 3.0, model: str = "pinhole", turn: float = 0.0, size: int = 64) -> Cameras:
    """A camera at a distance on the z axis that looks along -z, or is turned about y by an angle."""
    pose = torch.eye(3, 4)[None].clone()
    cosine, sine = math.cos(turn), math.sin(turn)
    pose[0, :, :3] = torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    pose[0, 2, 3] = distance
    length, middle, pixels = torch.tensor([float(size)]), torch.tensor([size / 2]), torch.tensor([size])
    lens = torch.tensor([LENSES[model]]) if model in LENSES else None
    return Cameras(pose, length, length, middle, middle, pixels, pixels, model, lens)


def all_around(model: str, distance: float) -> Cameras:
    """A camera, placed as `camera` does, that sees in all directions: a panorama, or an ideal fisheye."""
    if model == "fisheye":  # 2.3 radians from the axis at the middle of an edge
        length = torch.tensor([14.0])
        return replace(camera(distance, "fisheye", turn=0.5), fx=length, fy=length, lens=None)
    fx, fy, cx, cy = (torch.tensor([value]) for value in panorama(64, 32))
    sides = {"widths": torch.tensor([64]), "heights": torch.tensor([32])}
    return replace(camera(distance, turn=0.5), fx=fx, fy=fy, cx=cx, cy=cy, model="equirectangular", **sides)
