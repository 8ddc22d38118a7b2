"""Mesh files: PLY, OBJ and GLB, written by trimesh."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from framework.export.mesh import Mesh
from framework.export.texture import Texture
from framework.training.checkpoint import write_atomically

MeshFormat = Literal["ply", "obj", "glb"]
"""Suffix of a file that meshes are written to."""


def write_mesh(file: Path, mesh: Mesh) -> None:
    """Write a mesh in the format of the file's suffix, under a temporary name until it is complete.

    Coordinates are written as they are: a GLB file too has the axes of the mesh, although viewers take its y for up. A
    texture is inside a GLB file, and beside an OBJ file as NAME.mtl and NAME.png.

    Args:
        file: path of the file, with a suffix of `MeshFormat`.
        mesh: a mesh on the CPU. With a texture it has no vertex colours in the file, and PLY files have no texture.

    Raises:
        OSError: if the file cannot be written.
    """
    if mesh.texture is not None and file.suffix != ".ply":
        _write_textured(file, mesh, mesh.texture)
    else:
        _write_colored(file, mesh)


def _write_colored(file: Path, mesh: Mesh) -> None:
    import trimesh

    colors = None
    if mesh.colors is not None:
        stored = (mesh.colors.clamp(0, 1) * 255).round().numpy().astype(np.uint8)
        colors = np.concatenate([stored, np.full((len(stored), 1), 255, np.uint8)], axis=1)
    made = trimesh.Trimesh(
        vertices=mesh.vertices.numpy(),
        faces=mesh.faces.numpy(),
        vertex_normals=None if mesh.normals is None else mesh.normals.numpy(),
        vertex_colors=colors,
        process=False,
        validate=False,
    )
    flags: dict[str, Any] = {"include_normals": mesh.normals is not None}
    if file.suffix == ".ply":
        flags = {"vertex_normal": mesh.normals is not None}
    write_atomically(file, lambda stream: made.export(stream, file_type=file.suffix[1:], **flags))


def _write_textured(file: Path, mesh: Mesh, texture: Texture) -> None:
    """Write a mesh whose faces have corners of their own, as each has its place in the texture."""
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
    normals = mesh.normals is not None
    if file.suffix == ".glb":
        write_atomically(file, lambda stream: made.export(stream, file_type="glb", include_normals=normals))
        return
    text, beside = trimesh.exchange.obj.export_obj(
        made, include_normals=normals, return_texture=True, write_texture=False, mtl_name=f"{file.stem}.mtl"
    )
    for name, content in (*beside.items(), (file.name, text.encode())):
        write_atomically(file.parent / name, partial(_put, content))


def _put(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)
