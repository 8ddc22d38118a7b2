"""Mesh files: PLY, OBJ and GLB, written by trimesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from framework.export.mesh import Mesh
from framework.training.checkpoint import write_atomically

MeshFormat = Literal["ply", "obj", "glb"]
"""Suffix of a file that meshes are written to."""


def write_mesh(file: Path, mesh: Mesh) -> None:
    """Write a mesh in the format of the file's suffix, under a temporary name until it is complete.

    Coordinates are written as they are: a GLB file too has the axes of the mesh, although viewers take its y for up.

    Args:
        file: path of the file, with a suffix of `MeshFormat`.
        mesh: a mesh on the CPU.

    Raises:
        OSError: if the file cannot be written.
    """
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
