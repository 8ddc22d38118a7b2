"""Mesh files: PLY, GLB, and OBJ, which trimesh writes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.data.offsets import write_offset
from nerfloom.data.ply import coordinate_columns, in_full, write_columns
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_glb import encoded_mesh
from nerfloom.export.texture import Texture
from nerfloom.geometry.local_origin import local_origin

MeshFormat = Literal["ply", "obj", "glb"]
"""Suffix of a mesh file."""
DECIMALS = 8
"""Minimum number of decimals of a coordinate in an OBJ file."""


def write_mesh(file: Path, mesh: Mesh) -> None:
    """Write a mesh in the format of the file's suffix, under a temporary name until it is complete.

    Coordinates are written unchanged. Viewers take y as up in a GLB file, so its mesh must be given with y up
    (`Placement.y_up`). A texture is inside a GLB file, and beside an OBJ file as NAME.mtl and NAME.png.

    Far from the origin, where float32 is too coarse, PLY and OBJ files have double precision. A GLB file holds float32
    alone, and is written about a local origin with its offset beside it (`data.offsets`). A line says so.

    Args:
        file: path of the file, with a suffix of `MeshFormat`.
        mesh: a mesh on the CPU. With a texture it has no vertex colours in the file, and PLY files have no texture.

    Raises:
        ConfigError: if a GLB file would be larger than 4 GiB.
        OSError: if the file cannot be written.
    """
    if file.suffix == ".ply":
        _write_ply(file, mesh)
        return
    origin = local_origin(mesh.vertices)
    if origin is not None and file.suffix == ".glb":
        mesh = replace(mesh, vertices=mesh.vertices - origin)
    if file.suffix == ".glb":
        write_atomically(file, partial(_put, encoded_mesh(mesh)))
        if sentence := write_offset(file, origin):
            say(sentence)
        return
    if mesh.texture is None:
        _write_colored(file, mesh)
    else:
        _write_textured(file, mesh, mesh.texture)
    if origin is not None:
        say(f"{file.name}: {in_full(mesh.vertices)}")


def _write_ply(file: Path, mesh: Mesh) -> None:
    columns = coordinate_columns(file, mesh.vertices)
    if mesh.normals is not None:
        columns += zip(("nx", "ny", "nz"), mesh.normals.float().numpy().T, strict=True)
    if (colors := _bytes(mesh)) is not None:
        columns += zip(("red", "green", "blue", "alpha"), colors.T, strict=True)
    write_columns(file, columns, mesh.faces)


def _bytes(mesh: Mesh) -> np.ndarray | None:
    """Return the colours (V, 4) uint8 of the vertices; None if they have none."""
    if mesh.colors is None:
        return None
    stored = (mesh.colors.clamp(0, 1) * 255).round().numpy().astype(np.uint8)
    return np.concatenate([stored, np.full((len(stored), 1), 255, np.uint8)], axis=1)


def decimals(vertices: Tensor) -> int:
    """Return the decimals for writing `vertices` (V, 3) as text: 1e-7 of their extent or finer."""
    extent = float((vertices.amax(0) - vertices.amin(0)).max()) if len(vertices) else 0.0
    return DECIMALS if not extent > 0 else max(DECIMALS, math.ceil(7 - math.log10(extent)))


def _write_colored(file: Path, mesh: Mesh) -> None:
    import trimesh

    made = trimesh.Trimesh(
        vertices=mesh.vertices.numpy(),
        faces=mesh.faces.numpy(),
        vertex_normals=None if mesh.normals is None else mesh.normals.numpy(),
        vertex_colors=_bytes(mesh),
        process=False,
        validate=False,
    )
    flags = {"include_normals": mesh.normals is not None, "digits": decimals(mesh.vertices)}
    write_atomically(file, lambda stream: made.export(stream, file_type="obj", **flags))


def _write_textured(file: Path, mesh: Mesh, texture: Texture) -> None:
    """Write a mesh with separate corners for each face, because each face has its own place in the texture."""
    import trimesh
    from PIL import Image

    corners = mesh.faces.reshape(-1)
    material = trimesh.visual.material.SimpleMaterial(
        image=Image.fromarray(texture.image.numpy()), name=file.stem, diffuse=(255, 255, 255, 255)
    )
    made = trimesh.Trimesh(
        vertices=mesh.vertices[corners].numpy(),
        faces=np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=None if mesh.normals is None else mesh.normals[corners].numpy(),
        visual=trimesh.visual.TextureVisuals(texture.coordinates.reshape(-1, 2).numpy(), material),
        process=False,
        validate=False,
    )
    text, beside = trimesh.exchange.obj.export_obj(
        made,
        include_normals=mesh.normals is not None,
        return_texture=True,
        write_texture=False,
        mtl_name=f"{file.stem}.mtl",
        digits=decimals(mesh.vertices),
    )
    for name, content in (*beside.items(), (file.name, text.encode())):
        write_atomically(file.parent / name, partial(_put, content))


def _put(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)
