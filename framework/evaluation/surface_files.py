"""Surfaces read from files: meshes in PLY, OBJ and GLB files, and points with or without normals in PLY files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError, one_line
from nerfloom.data.ply import read_columns, read_header, vertices
from nerfloom.evaluation.surfaces import Surface, usable

SUFFIXES = (".ply", ".obj", ".glb")
"""Suffixes of files of meshes."""


def read_mesh(file: Path) -> Surface:
    """Read a mesh from a PLY, OBJ or GLB `file`. Unusable vertices and faces are left out and counted.

    Normals at vertices come from a PLY file. A GLB file's parts are placed by its scene and joined. Nothing else is
    read, such as materials or textures beside the file.

    Raises:
        DataError: if the file cannot be read or has no face with an area.
    """
    kind = file.suffix.lower()
    if kind not in SUFFIXES:
        raise DataError(f"{file} is not a mesh: its name must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    positions, faces = _triangles(file, kind[1:])
    if not len(faces):
        hint = "; pass points as --reference-points" if kind == ".ply" else ""
        raise DataError(f"{file} is not a mesh: it has no faces{hint}")
    normals = _normals(file) if kind == ".ply" else None
    if normals is not None and len(normals) != len(positions):
        normals = None
    return _said(Surface(positions, faces, normals), file)


def read_points(file: Path) -> Surface:
    """Read points, with normals if given, from a PLY `file`. Unusable points are left out and counted.

    Raises:
        DataError: if the file cannot be read or has no points.
    """
    columns = read_columns(file, vertices(file, read_header(file)), "xyz")
    return _said(Surface(_stacked(columns), None, _normals(file)), file)


def _said(surface: Surface, file: Path) -> Surface:
    """Return the usable part of a surface, and report the rest."""
    found, notes = usable(surface, str(file))
    if notes:
        say(f"{file}: left out: {', '.join(notes)}")
    return found


def _normals(file: Path) -> Tensor | None:
    """Return the normals (V, 3) float64 of a PLY file; None if it has none."""
    element = vertices(file, read_header(file))
    if not {"nx", "ny", "nz"} <= set(element.names):
        return None
    return _stacked(read_columns(file, element, ("nx", "ny", "nz")))


def _stacked(columns: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack([column.astype(np.float64) for column in columns], axis=-1))


def _triangles(file: Path, kind: str) -> tuple[Tensor, Tensor]:
    """Return the vertices (V, 3) float64 and the triangles (F, 3) int64 of a file."""
    import trimesh

    options: dict[str, Any] = {"ply": {"fix_texture": False}, "obj": {"skip_materials": True}}.get(kind, {})
    try:
        # An open file is passed, so that no other file is read.
        with file.open("rb") as stream:
            loaded: Any = trimesh.load(stream, file_type=kind, process=False, **options)
        scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
        positions, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if not isinstance(mesh, trimesh.Trimesh):
                continue
            local = np.asarray(mesh.vertices, np.float64)
            members = np.asarray(mesh.faces, np.int64)
            if len(members) and not 0 <= members.min() <= members.max() < len(local):
                raise ValueError("a face has a vertex that does not exist")
            positions.append(local @ transform[:3, :3].T + transform[:3, 3])
            faces.append(members + count)
            count += len(local)
        return torch.from_numpy(np.concatenate(positions)), torch.from_numpy(np.concatenate(faces))
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except Exception as error:  # trimesh reports damage by any exception
        raise DataError(f"cannot read {file} as a mesh: {one_line(error)}") from error
