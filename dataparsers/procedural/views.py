"""Views of solids, such as the embedded scene, and the data set made of them."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.dataparsers.procedural.scene import DAYLIGHT, PARTS, Light, Parts, trace_rows
from nerfloom.kernels.native import torch_on_one_thread

T = TypeVar("T")
CAMERA_ANGLE = 0.6911
"""Horizontal field of view, radians, as in NeRF-Synthetic."""
RADIUS = 4.0
"""Distance of the cameras from the origin, scene units."""
SUPERSAMPLE = 3
"""Rays along each side of a pixel."""
_CHUNK_RAYS = 128_000  # fewer at once take longer to start operations, more leave the cache


def _camera_rays(
    camera_to_world: npt.ArrayLike, camera_angle_x: float, size: tuple[int, int], x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor]:
    """Return origin (3, 1) and unit directions (3, R) of rays through pixel coordinates x, y (R,)."""
    pose = torch.as_tensor(np.asarray(camera_to_world, dtype=np.float64)).to(x)
    focal = 0.5 * size[0] / math.tan(0.5 * camera_angle_x)
    u, v = (x - 0.5 * size[0]) / focal, (0.5 * size[1] - y) / focal
    scale = (u * u + v * v + 1.0).rsqrt()
    axes = pose[:3, :3, None]
    return pose[:3, 3:4], (axes[:, 0] * u + axes[:, 1] * v - axes[:, 2]) * scale


def _pixel_grid(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return column and row (H W,) of every pixel, float64."""
    row, column = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size[::-1]), indexing="ij")
    return column.flatten(), row.flatten()


def _render_geometry(
    camera_to_world: npt.ArrayLike, camera_angle_x: float, size: tuple[int, int], time: float, parts: Parts
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return depth (H, W) and normals (H, W, 3) at the pixel centres, computed in float64."""
    column, row = _pixel_grid(size)
    depth, normals = [], []
    for x, y in zip(column.split(_CHUNK_RAYS), row.split(_CHUNK_RAYS), strict=True):
        rays = _camera_rays(camera_to_world, camera_angle_x, size, x + 0.5, y + 0.5)
        hit = trace_rows(*rays, time, colour=False, parts=parts)
        depth.append(hit.depth)
        normals.append(hit.normals)
    shape = size[::-1]
    return torch.cat(depth).float().reshape(shape).numpy(), torch.cat(normals, 1).T.float().reshape(*shape, 3).numpy()


def _render_rgba(
    camera_to_world: npt.ArrayLike,
    camera_angle_x: float,
    size: tuple[int, int],
    time: float,
    supersample: int,
    parts: Parts,
    lit: Light,
) -> npt.NDArray[np.uint8]:
    """Return straight colour and coverage (H, W, 4) from supersample^2 float32 rays on a grid in every pixel."""
    column, row = (c.float() for c in _pixel_grid(size))
    image = torch.zeros(4, column.numel())
    steps = (torch.arange(supersample, dtype=torch.float32) + 0.5) / supersample
    dy, dx = (c.flatten() for c in torch.meshgrid(steps, steps, indexing="ij"))
    for pixels in torch.arange(column.numel()).split(max(1, _CHUNK_RAYS // supersample**2)):
        x, y = ((c[pixels, None] + d).flatten() for c, d in ((column, dx), (row, dy)))
        hit = trace_rows(*_camera_rays(camera_to_world, camera_angle_x, size, x, y), time, parts=parts, lit=lit)
        samples = torch.cat([hit.rgb, hit.hit[None]]).reshape(4, -1, supersample**2)
        image[:, pixels] = samples.mean(2)
    image[:3] /= image[3].clamp(min=1e-6)
    return (image * 255.0).round().to(torch.uint8).T.reshape(size[1], size[0], 4).numpy()


@torch.no_grad()
def render_view(
    camera_to_world: npt.ArrayLike,
    camera_angle_x: float,
    width: int,
    height: int,
    time: float = 0.0,
    supersample: int = SUPERSAMPLE,
    geometry: bool = True,
    parts: Parts = PARTS,
    lit: Light = DAYLIGHT,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32] | None, npt.NDArray[np.float32] | None]:
    """Render one view of the scene.

    Args:
        camera_to_world: (3, 4) or (4, 4), OpenGL axes (x right, y up, looking along -z), outside of the solids.
        camera_angle_x: horizontal field of view in radians. The vertical focal length is the same, the principal point
            is the image centre, and pixel centres are at +0.5.
        width, height: size of the image, pixels.
        time: in [0, 1].
        supersample: rays along each side of a pixel.
        geometry: whether to compute depth and normals.
        parts: the solids of the scene.
        lit: the light of the image.

    Returns:
        rgba (H, W, 4) uint8, straight colour and covered fraction of the pixel; depth (H, W) float32 along the rays
        through the pixel centres, inf for background; and world normals (H, W, 3) float32 there. Depth and normals are
        None without `geometry`.
    """
    size = (width, height)
    rgba = _render_rgba(camera_to_world, camera_angle_x, size, time, supersample, parts, lit)
    if not geometry:
        return rgba, None, None
    return rgba, *_render_geometry(camera_to_world, camera_angle_x, size, time, parts)


def visible_parts(
    camera_to_world: npt.ArrayLike, size: tuple[int, int], parts: Parts
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return depth and index of the part, both (H, W), at the centres of `size` pixels; inf and -1 for background.

    `camera_to_world` is (3, 4) or (4, 4), as for `render_view`, with `CAMERA_ANGLE`; `parts` are the solids at time
    0.
    """
    column, row = _pixel_grid(size)
    rays = _camera_rays(camera_to_world, CAMERA_ANGLE, size, column + 0.5, row + 0.5)
    hit = trace_rows(*rays, 0.0, colour=False, parts=parts)
    shape = size[::-1]
    return hit.depth.reshape(shape).numpy(), hit.part.reshape(shape).numpy()


def camera_pose(azimuth: float, elevation: float, radius: float = RADIUS) -> npt.NDArray[np.float64]:
    """Return the camera-to-world matrix (4, 4) of a camera that looks at the origin from a distance `radius`.

    `azimuth` around z and `elevation` above the horizon are in radians, the radius in scene units.
    """
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, radius * back], axis=1)
    return pose


def camera_poses(split: str, count: int, seed: int) -> list[npt.NDArray[np.float64]]:
    """Return the poses of a split: training cameras jittered over the upper hemisphere, test cameras on an orbit.

    Training and validation cameras are a Fibonacci lattice from 5 degrees below the horizon to 75 above it, rotated and
    jittered by the seed; test cameras circle once while their elevation oscillates.

    Args:
        split: train, val or test.
        count: number of cameras.
        seed: seed of rotation and jitter.
    """
    turns = np.arange(count) / count
    if split == "test":
        return [camera_pose(2 * math.pi * t, math.radians(30 + 22 * math.sin(4 * math.pi * t))) for t in turns]
    random = np.random.default_rng([seed, len(split)])
    low, high = math.sin(math.radians(-5.0)), math.sin(math.radians(75.0))
    heights = low + (high - low) * (np.arange(count) + random.uniform(0.2, 0.8, count)) / count
    golden = math.pi * (3.0 - math.sqrt(5.0))
    azimuths = random.uniform(0, 2 * math.pi) + golden * np.arange(count) + random.uniform(-0.2, 0.2, count)
    order = random.permutation(count)  # a moving scene is seen from high and low at all times
    return [camera_pose(azimuths[index], math.asin(heights[index])) for index in order]


def write_dataset(
    folder: Path,
    *,
    size: int = 200,
    counts: dict[str, int] | None = None,
    moving: bool = False,
    seed: int = 0,
) -> None:
    """Write a data set of the embedded scene, completely or not at all; its files are as from `write_views`.

    Args:
        folder: folder to create. If another process creates it meanwhile, its content is kept.
        size: width and height of the images, pixels.
        counts: number of images of the splits train, val and test.
        moving: whether each frame has a time; otherwise the scene is static, at time 0.
        seed: seed of the camera positions. The same seed gives the same bytes.

    Raises:
        OSError: if the folder cannot be written.
    """
    counts = counts or {"train": 80, "val": 8, "test": 16}
    poses = {split: camera_poses(split, count, seed) for split, count in counts.items()}
    with complete_folder(folder) as temporary:
        write_views(temporary, poses, PARTS, size, "Rendering the embedded scene", moving)


def write_views(
    folder: Path,
    poses: Mapping[str, Sequence[npt.NDArray[np.float64]]],
    parts: Parts,
    size: int,
    title: str,
    moving: bool = False,
) -> None:
    """Write images of solids in NeRF-Synthetic's format.

    Each split has `transforms_{split}.json` and RGBA images; val and test also have `r_000_geometry.npz` with the exact
    depth (H, W) along the ray, inf for background, and the world normals (H, W, 3).

    Args:
        folder: folder to write to.
        poses: camera-to-world matrices (4, 4) of each split.
        parts: the solids.
        size: width and height of the images, pixels.
        title: title of the progress bar.
        moving: whether each frame has a time; otherwise the scene is static, at time 0.
    """
    jobs = [job for split, of_split in poses.items() for job in lay_out(folder, split, of_split, moving)]
    in_parallel(partial(_write_view, size=size, parts=parts), jobs, title)


def in_parallel(work: Callable[..., T], jobs: Sequence[tuple[Any, ...]], title: str) -> list[T]:
    """Return `work(*job)` for all `jobs`, one on each core, and show the progress under a `title`."""
    with torch_on_one_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(track(pool.map(lambda job: work(*job), jobs), title, total=len(jobs)))


@contextmanager
def complete_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, renamed to `folder` on success, if no process made it meanwhile, and else removed.

    Raises:
        OSError: if the folder cannot be written.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        try:
            temporary.rename(folder)
        except OSError:
            if not folder.is_dir():  # otherwise another process was faster and wrote the same bytes
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def lay_out(
    folder: Path, split: str, poses: Sequence[npt.NDArray[np.float64]], moving: bool
) -> list[tuple[Path, npt.NDArray[np.float64], float]]:
    """Write the JSON file of a `split` in `folder`, with times if `moving`; return file, pose and time of `poses`."""
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames, jobs = [], []
    for index, pose in enumerate(poses):
        time = index / max(len(poses) - 1, 1) if moving else 0.0
        frame: dict[str, Any] = {"file_path": f"./{split}/r_{index:03d}", "transform_matrix": pose.tolist()}
        frames.append({**frame, "time": time} if moving else frame)
        jobs.append((folder / split / f"r_{index:03d}.png", pose, time))
    content = {"camera_angle_x": CAMERA_ANGLE, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    return jobs


def _write_view(path: Path, pose: npt.NDArray[np.float64], time: float, *, size: int, parts: Parts) -> None:
    exact = path.parent.name != "train"
    rgba, depth, normals = render_view(pose, CAMERA_ANGLE, size, size, time, geometry=exact, parts=parts)
    iio.imwrite(path, rgba)
    if depth is not None and normals is not None:
        np.savez_compressed(path.with_name(f"{path.stem}_geometry.npz"), depth=depth, normals=normals)
