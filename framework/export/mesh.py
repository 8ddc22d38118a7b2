"""Triangle meshes: their connected components, closedness, normals, and simplification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.export.texture import Texture
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.kernels.math import safe_normalize


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Tensor
    """(V, 3) float64 positions."""
    faces: Tensor
    """(F, 3) int64 indices of vertices, counterclockwise seen from outside."""
    normals: Tensor | None = None
    """(V, 3) unit normals, away from the matter; None if not computed."""
    colors: Tensor | None = None
    """(V, 3) colours in [0, 1]; None if not computed."""
    texture: Texture | None = None
    """The texture of its faces; None if there is none."""

    def with_faces(self, kept: Tensor) -> Mesh:
        """Return the mesh of its faces `kept` (F,) bool, with the vertices that they use, without texture."""
        faces = self.faces[kept]
        used = torch.zeros(len(self.vertices), dtype=torch.bool)
        used[faces.reshape(-1)] = True
        number = used.cumsum(0) - 1
        normals, colors = (None if part is None else part[used] for part in (self.normals, self.colors))
        return Mesh(self.vertices[used], number[faces], normals, colors)


def without_degenerate(mesh: Mesh) -> Mesh:
    """Return `mesh` without degenerate faces (two equal corners) and without unused vertices."""
    a, b, c = mesh.faces.unbind(-1)
    return mesh.with_faces((a != b) & (b != c) & (c != a))


def within(mesh: Mesh, regions: Sequence[Region]) -> Mesh:
    """Return the faces of `mesh` with all corners in all `regions`; all faces without regions.

    Raises:
        ConfigError: if there are none.
    """
    if not regions:
        return mesh
    kept = inside_all(mesh.vertices, regions)[mesh.faces].all(-1)
    if not bool(kept.any()):
        raise ConfigError("no face is in the region that is kept; take a larger region, or a higher --resolution")
    return mesh if bool(kept.all()) else mesh.with_faces(kept)


def vertex_normals(mesh: Mesh) -> Tensor:
    """Return the normals (V, 3) of the vertices of `mesh`, float32: means over faces, weighted by area."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(mesh.vertices)
    for corner in range(3):
        total.index_add_(0, mesh.faces[:, corner], areas)
    # Scaled first, because the squares of small areas underflow.
    return safe_normalize((total / total.abs().max().clamp(min=1e-300)).float())


@dataclass(frozen=True)
class Closedness:
    """The edges of a mesh by the number of their faces."""

    open_edges: int
    """Number of edges of one face."""
    crowded_edges: int
    """Number of edges of more than two faces."""

    @property
    def watertight(self) -> bool:
        """True if each edge belongs to two faces."""
        return not self.open_edges and not self.crowded_edges

    def sentence(self) -> str:
        """Return a description for people."""
        if self.watertight:
            return "watertight"
        crowded = f", {self.crowded_edges:,} edges of more than two faces" if self.crowded_edges else ""
        return f"not watertight: {self.open_edges:,} open edges{crowded}"


def closedness(mesh: Mesh) -> Closedness:
    """Count the edges of `mesh` that do not belong to two faces."""
    faces = mesh.faces.numpy()
    keys = np.empty((3, len(faces)), np.int64)
    for row, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        np.minimum(faces[:, a], faces[:, b], out=keys[row])
        keys[row] *= len(mesh.vertices)
        keys[row] += np.maximum(faces[:, a], faces[:, b])
    flat = keys.reshape(-1)
    flat.sort()
    starts = np.flatnonzero(np.diff(flat, prepend=-1))
    counts = np.diff(starts, append=len(flat))
    return Closedness(int((counts == 1).sum()), int((counts > 2).sum()))


def components(mesh: Mesh) -> Tensor:
    """Return the index (F,) of each face's connected component; the component with most faces is 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces.numpy()
    rows, columns = np.concatenate([faces[:, 0], faces[:, 1]]), np.concatenate([faces[:, 1], faces[:, 2]])
    ones, size = np.ones(len(rows), np.bool_), len(mesh.vertices)
    count, labels = connected_components(coo_matrix((ones, (rows, columns)), (size, size)), directed=False)
    owners = labels[faces[:, 0]]
    order = np.argsort(-np.bincount(owners, minlength=count), kind="stable")
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    return torch.from_numpy(rank[owners])


def cavities(mesh: Mesh, owners: Tensor, cameras: Tensor) -> Tensor:
    """Return the components (C,) bool that bound a cavity within matter, which no camera can see.

    The faces of a cavity face inwards, so its signed volume is negative. A component with an open edge bounds nothing.
    A room that holds a camera is not a cavity, although its volume is negative too.

    Args:
        owners: (F,) int64 component of each face.
        cameras: (M, 3) positions of cameras, in the frame of the mesh.
    """
    count = int(owners.max()) + 1
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    volume = torch.zeros(count, dtype=torch.float64)
    volume.index_add_(0, owners, (a * torch.linalg.cross(b, c)).sum(-1))
    hollow = volume < 0
    inwards = hollow[owners]
    candidates, members = mesh.faces[inwards], owners[inwards]
    edges = torch.cat([candidates[:, [0, 1]], candidates[:, [1, 2]], candidates[:, [2, 0]]]).sort(-1).values
    _, number, faces = (edges[:, 0] * len(mesh.vertices) + edges[:, 1]).unique(return_inverse=True, return_counts=True)
    hollow[members.repeat(3)[faces[number] != 2]] = False
    low = torch.full((count, 3), torch.inf, dtype=torch.float64)
    index = members[:, None].expand(-1, 3)
    low.scatter_reduce_(0, index, a[inwards], "amin")
    high = torch.full_like(low, -torch.inf).scatter_reduce_(0, index, a[inwards], "amax")
    for camera in cameras:
        hollow &= ~((camera >= low) & (camera <= high)).all(-1)
    return hollow


def largest_components(mesh: Mesh, most: int, least_share: float, cameras: Tensor) -> tuple[Mesh, int]:
    """Return the mesh of the largest components, without hollows, and the number of components that were dropped.

    Args:
        mesh: a mesh of at least one face.
        most: maximum number of components; 0 for any.
        least_share: minimum number of faces of a component, relative to the largest component.
        cameras: (M, 3) positions of cameras, in the frame of the mesh.
    """
    owners = components(mesh)
    sizes = owners.bincount()
    large = sizes >= least_share * sizes.max()
    # Few are left, and the sign of a volume means something for these only.
    mesh = mesh.with_faces(large[owners])
    owners = owners[large[owners]]
    kept = ~cavities(mesh, owners, cameras)
    if most and int(kept.sum()) > most:
        kept[kept.nonzero()[most:, 0]] = False
    return mesh.with_faces(kept[owners]), len(sizes) - int(kept.sum())


def simplified(mesh: Mesh, target_num_faces: int) -> Mesh:
    """Return the mesh with about `target_num_faces` faces, by quadric edge collapse (Garland and Heckbert 1997).

    Normals and colours are dropped. A mesh that has no more faces is returned as it is.

    Args:
        target_num_faces: number of faces to reach.

    Raises:
        ConfigError: if no face is left.
    """
    if len(mesh.faces) <= target_num_faces:
        return mesh
    import fast_simplification

    # In float32, as the library computes: relative to the middle, and of unit size.
    middle, size = mesh.vertices.mean(0), float((mesh.vertices - mesh.vertices.mean(0)).abs().max())
    vertices, faces = fast_simplification.simplify(
        ((mesh.vertices - middle) / size).float().numpy(),
        mesh.faces.to(torch.int32).numpy(),
        target_count=target_num_faces,
    )
    result = Mesh(torch.from_numpy(vertices).double() * size + middle, torch.from_numpy(faces).long())
    result = without_degenerate(result)
    if not len(result.faces):
        raise ConfigError(f"nothing is left of the mesh with --target-num-faces {target_num_faces}; give a larger one")
    return replace(result, normals=None, colors=None)
