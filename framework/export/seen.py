"""The part of a mesh that training cameras see.

Photographs say nothing about the rest: the ground below a floor, the back of a wall, the end of the box inside of
matter. A mesh of a capture without masks would have an outer shell of such faces.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.evaluation.surfaces import Samples, Surface, drawn
from nerfloom.evaluation.visibility import count_sightings
from nerfloom.export.mesh import Mesh, vertex_normals
from nerfloom.renderable import HasSignedDistance, Renderable

OCCLUDERS = 1_000_000
"""Number of points on the mesh that may hide others."""
RINGS = 3
"""Vertices up to this many edges from one that is seen count as seen, which closes small holes."""


def default_min_views(model: Renderable) -> int:
    """Return the number of training cameras that must see a face of a model's surface.

    It is 1 for a signed distance in a scene that may extend beyond its box. Its surface is cut open at the background's
    sphere anyway. Other surfaces stay whole, so that a closed mesh is not opened where an object stands.

    Args:
        model: the model.
    """
    return int(isinstance(model, HasSignedDistance) and model.scene.unbounded)


def seen_part(mesh: Mesh, cameras: Cameras, least: int) -> Mesh:
    """Return the faces of a mesh that training cameras see, and say how many are left out.

    Args:
        mesh: a mesh in scene coordinates, with at least one face.
        cameras: the training cameras.
        least: minimum number of cameras that see a face; 0 for all faces.

    Raises:
        ConfigError: if no face is left.
    """
    if least == 0:
        return mesh
    kept = seen_faces(mesh, cameras, least)
    named = "no training camera sees" if least == 1 else f"fewer than {least} training cameras see"
    if not bool(kept.any()):
        raise ConfigError(f"{named} a face of the surface; --min-views 0 keeps all of it")
    if dropped := int((~kept).sum()):
        say(f"{dropped:,} of {len(kept):,} faces are left out, which {named} (--min-views)")
    return mesh.with_faces(kept)


def seen_faces(mesh: Mesh, cameras: Cameras, least: int) -> Tensor:
    """Return the faces (F,) bool of a mesh that at least `least` of the cameras see, and those close to them.

    Args:
        mesh: a mesh in scene coordinates.
        cameras: the training cameras.
    """
    occluders = drawn(Surface(mesh.vertices, mesh.faces), OCCLUDERS)
    vertices = Samples(mesh.vertices, vertex_normals(mesh))
    points, occluders = (_single(each) for each in (vertices, occluders))
    found = count_sightings(points, occluders, cameras.to("cpu"), lambda index: None, "Looking from the cameras")
    near = found.seen >= least
    for _ in range(RINGS):
        near.index_fill_(0, mesh.faces[near[mesh.faces].any(-1)].reshape(-1), True)
    return near[mesh.faces].all(-1)


def _single(samples: Samples) -> Samples:
    """Return samples in float32, as cameras are."""
    normals = None if samples.normals is None else samples.normals.float()
    return replace(samples, positions=samples.positions.float(), normals=normals)
