"""Shiny solids with exact normals: a mirror, rough metal, varnish over texture, and the three together.

`python -m nerfloom.dataparsers.procedural.shiny FOLDER` writes four scenes in the layout of Shiny Blender (Verbin
et al. 2022): images in NeRF-Synthetic's format, and beside each a `*_normal.png` with its normals. Held-out views also
have `*_light.npz` with diffuse and specular light and the roughness. Surfaces reflect the environment alone, not each
other, so their colour depends on place and reflected direction in closed form. `--environment N` lights the same solids
with other lamps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import FlagError
from nerfloom.cli.common import run_command
from nerfloom.dataparsers.procedural.environment import Environment, make_environment
from nerfloom.dataparsers.procedural.scene import Colour, Part, checks, trace_rows
from nerfloom.dataparsers.procedural.shapes import Box, Shape, Sphere, Torus, dot
from nerfloom.dataparsers.procedural.solids import SolidsFlags, flags_of, poses_around
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, complete_folder, in_parallel, lay_out
from nerfloom.kernels.color import to_srgb

SUPERSAMPLE = 3
"""Rays along each side of a pixel."""
DIFFUSE_ROUGHNESS = 0.6
"""Roughness of the mean light on a matt surface: the distribution is about as wide as the cosine's."""


class Material(NamedTuple):
    """Reflection of light by a solid.

    Args:
        reflectance: share of light that it mirrors head-on; the rest is diffuse. More at grazing angles (Schlick 1994).
        roughness: inverse concentration of the reflected directions.
        texture: function from positions (3, R) around the solid's origin to diffuse albedo (3, R).
    """

    reflectance: Colour
    roughness: float
    texture: Callable[[Tensor], Tensor]


class Solid(NamedTuple):
    """A solid: a `shape` around its own origin, at `centre`, turned by `yaw` radians about z, of a `material`."""

    shape: Shape
    centre: Colour
    yaw: float
    material: Material


class Light(NamedTuple):
    """Light of R rays, linear.

    Args:
        diffuse, specular: (3, R) light; 0 without a surface.
        roughness: (R,) roughness of the surface; 0 without one.
        normals: (3, R) outward unit normals; 0 without a surface.
        hit: (R,) bool, whether there is a surface.
    """

    diffuse: Tensor
    specular: Tensor
    roughness: Tensor
    normals: Tensor
    hit: Tensor


def _black(p: Tensor) -> Tensor:
    return torch.zeros_like(p)


MIRROR = Material((0.92, 0.93, 0.95), 0.0, _black)
GOLD = Material((0.95, 0.70, 0.32), 0.03, _black)
VARNISH = Material((0.06, 0.06, 0.06), 5e-4, partial(checks, (0.85, 0.45, 0.30), (0.10, 0.22, 0.45), math.pi / 0.22))
SCENES: Mapping[str, tuple[Solid, ...]] = {
    "mirror": (Solid(Sphere(0.95), (0.0, 0.0, 0.0), 0.0, MIRROR),),
    "metal": (Solid(Torus(0.75, 0.34), (0.0, 0.0, 0.0), 0.5, GOLD),),
    "varnish": (Solid(Box((0.62, 0.5, 0.55)), (0.0, 0.0, 0.0), 0.4, VARNISH),),
    "together": (
        Solid(Sphere(0.42), (-0.55, -0.45, 0.15), 0.0, MIRROR),
        Solid(Torus(0.38, 0.16), (0.55, -0.35, 0.1), -0.6, GOLD),
        Solid(Sphere(0.45), (0.05, 0.6, -0.1), 0.0, VARNISH),
    ),
}
"""Solids of each scene."""


@torch.no_grad()
def light_along(origin: Tensor, directions: Tensor, solids: tuple[Solid, ...], environment: Environment) -> Light:
    """Return the light of the first of `solids` along `directions` (3, R) from `origin` (3, 1), in `environment`."""
    parts = {str(i): Part(s.shape, s.centre, s.yaw, s.material.texture, 0.0) for i, s in enumerate(solids)}
    hit = trace_rows(origin, directions, 0.0, colour=False, parts=parts)
    diffuse, specular, roughness = (torch.zeros_like(each) for each in (directions, directions, directions[0]))
    for index, solid in enumerate(solids):
        rays = (hit.part == index).nonzero()[:, 0]
        material, view, normal = solid.material, directions[:, rays], hit.normals[:, rays]
        offset = origin + hit.depth[rays] * view - view.new_tensor(solid.centre)[:, None]
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        local = torch.stack([c * offset[0] + s * offset[1], c * offset[1] - s * offset[0], offset[2]])
        head_on = view.new_tensor(material.reflectance)[:, None]
        slope = dot(normal, view)
        mirrored = head_on + (1 - head_on) * (1 + slope).clamp(0, 1) ** 5
        rough = torch.full_like(slope, material.roughness)
        specular[:, rays] = mirrored * environment.light(view - 2 * slope * normal, rough)
        matt = environment.light(normal, torch.full_like(slope, DIFFUSE_ROUGHNESS))
        diffuse[:, rays] = (1 - head_on) * material.texture(local) * matt
        roughness[rays] = rough
    return Light(diffuse, specular, roughness, hit.normals, hit.hit)


def _rays(pose: npt.NDArray[np.float64], size: int, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return origin (3, 1) and unit directions (3, R) of rays through pixel coordinates x, y (R,)."""
    axes = torch.from_numpy(pose[:3]).to(x)
    focal = 0.5 * size / math.tan(0.5 * CAMERA_ANGLE)
    local = torch.stack([(x - 0.5 * size) / focal, (0.5 * size - y) / focal, torch.full_like(x, -1.0)])
    directions = axes[:, :3] @ local
    return axes[:, 3:], directions / dot(directions, directions).sqrt()


def render_shiny(
    pose: npt.NDArray[np.float64], size: int, solids: tuple[Solid, ...], environment: Environment, exact: bool = True
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8], Light | None]:
    """Render a view.

    Args:
        pose: (4, 4) camera-to-world matrix, OpenGL axes.
        size: width and height, pixels.
        solids: the solids.
        environment: the light around them.
        exact: whether to return the light at pixel centres.

    Returns:
        rgba (H, W, 4) and normals (H, W, 4), straight colours and coverage, with (normal + 1) / 2 for red, green and
        blue; and the light through the H W pixel centres, float64, or None.
    """
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    step = (torch.arange(SUPERSAMPLE) + 0.5) / SUPERSAMPLE
    image, normals = torch.zeros(2, 4, size * size)
    for dy in step:
        for dx in step:
            found = light_along(*_rays(pose, size, column.flatten() + dx, row.flatten() + dy), solids, environment)
            covered = found.hit[None].float()
            image += torch.cat([to_srgb(found.diffuse + found.specular).clamp(max=1) * covered, covered])
            normals += torch.cat([found.normals, covered])
    alpha = image[3:] / SUPERSAMPLE**2
    colors = image[:3] / image[3:].clamp(min=1e-6)
    facing = normals[:3] / dot(normals[:3], normals[:3]).sqrt().clamp(min=1e-6)
    files = [torch.cat([each, alpha]) for each in (colors, torch.where(alpha > 0, (facing + 1) / 2, 0.0))]
    rgba, encoded = ((each * 255).round().to(torch.uint8).T.reshape(size, size, 4).numpy() for each in files)
    if not exact:
        return rgba, encoded, None
    centres = _rays(pose, size, column.flatten().double() + 0.5, row.flatten().double() + 0.5)
    return rgba, encoded, light_along(*centres, solids, environment)


def _write_view(
    path: Path, pose: npt.NDArray[np.float64], size: int, solids: tuple[Solid, ...], environment: Environment
) -> None:
    rgba, normals, light = render_shiny(pose, size, solids, environment, exact=path.parent.name != "train")
    iio.imwrite(path, rgba)
    iio.imwrite(path.with_name(f"{path.stem}_normal.png"), normals)
    if light is not None:
        known = {
            name: rows.view(-1, size, size).movedim(0, -1).float().numpy()
            for name, rows in (("diffuse", light.diffuse), ("specular", light.specular), ("roughness", light.roughness))
        }
        np.savez_compressed(path.with_name(f"{path.stem}_light.npz"), **known)  # type: ignore[arg-type]


def write_shiny(
    folder: Path,
    size: int = 400,
    num_train: int = 100,
    num_test: int = 20,
    environment: int = 0,
) -> None:
    """Write the scenes, each with 8 images for validation, completely or not at all.

    Args:
        folder: folder to create; each scene is a folder within it.
        size: width and height of the images, pixels.
        num_train: number of training images of a scene.
        num_test: number of test images of a scene.
        environment: seed of the lamps.

    Raises:
        OSError: if the folder cannot be written.
    """
    turns = {"train": (num_train, 0.0), "val": (8, 1.0), "test": (num_test, 2.0)}
    lamps = make_environment(environment)
    with complete_folder(folder) as temporary:
        jobs = [
            (path, pose, size, solids, lamps)
            for name, solids in SCENES.items()
            for split, turn in turns.items()
            for path, pose, _ in lay_out(temporary / name, split, poses_around(*turn), moving=False)
        ]
        in_parallel(_write_view, jobs, "Rendering the shiny scenes")


@dataclass(frozen=True)
class ShinyFlags(SolidsFlags):
    """Write data sets of shiny solids with exact normals, each into a folder within --folder."""

    environment: int = 0
    """Seed of the lamps that light the solids."""


def _command(arguments: list[str]) -> None:
    flags = flags_of(ShinyFlags, "shiny", arguments)
    if flags.environment < 0:
        raise FlagError("--environment must be at least 0")
    write_shiny(flags.folder, flags.size, flags.num_train, flags.num_test, flags.environment)
    say(f"{flags.folder}: {', '.join(SCENES)}; ns-train METHOD --data {flags.folder}/{next(iter(SCENES))}")


if __name__ == "__main__":
    run_command(_command)
