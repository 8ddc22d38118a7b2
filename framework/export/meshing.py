"""Meshes of a trained model: its surface, cleaned and simplified, with normals and colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.dataset import Dataset
from nerfloom.export import density, tsdf
from nerfloom.export.colors import seen_colors, spread_colors
from nerfloom.export.isosurface import isosurface
from nerfloom.export.lattice import Lattice
from nerfloom.export.mesh import Mesh, largest_components, simplified, vertex_normals, within, without_degenerate
from nerfloom.export.seen import seen_part
from nerfloom.export.texture import Texturing, painted
from nerfloom.geometry.points import Points
from nerfloom.geometry.regions import Region
from nerfloom.kernels.math import safe_normalize
from nerfloom.renderable import HasSignedDistance, Renderable, RendersRays

ColorFunction = Callable[[Tensor, Tensor], Tensor]
"""Function from vertices and normals (V, 3) in scene coordinates to colours (V, 3), NaN for a vertex without."""
COLOURED = 2**16
"""Number of vertices that are coloured at once."""
ROUNDING = 1e-4
"""Distance from a region that counts as in it, in cells."""
NEWTON_STEPS, LEAST_SLOPE = 3, 0.1
"""Number of Newton steps onto a surface, and the minimum length of a gradient that a step divides by."""


@dataclass(frozen=True)
class Cleaning:
    """The parts of a surface that are kept."""

    num_components: int = 0
    """Maximum number of connected components; 0 for any."""
    min_component_share: float = 0.001
    """Minimum number of faces of a component, relative to the largest component."""
    target_num_faces: int | None = None
    """Number of faces that the mesh is simplified to; None for no simplification."""
    min_views: int = 0
    """Minimum number of training cameras that see a face; 0 for any (`default_min_views`)."""
    regions: tuple[Region, ...] = ()
    """Regions; the mesh keeps their intersection, scene coordinates; none for everything on the lattice."""

    def check(self) -> None:
        """Raise ConfigError if a number is out of range."""
        if self.min_views < 0:
            raise FlagError(f"--min-views is {self.min_views}; it must be at least 0")
        if self.num_components < 0 or not 0 <= self.min_component_share <= 1:
            raise FlagError("--num-components must be at least 0, and --min-component-share from 0 to 1")
        if self.target_num_faces is not None and self.target_num_faces < 4:
            raise FlagError(f"--target-num-faces is {self.target_num_faces}; it must be at least 4")


def density_mesh(
    model: Renderable,
    lattice: Lattice,
    level: float,
    time: float,
    cameras: Cameras,
    cleaning: Cleaning,
    texturing: Texturing | None = None,
) -> Mesh:
    """Return the isosurface of a model's density, in scene coordinates.

    Args:
        model: the model in evaluation mode.
        lattice: where the density is evaluated.
        level: the density, 1/scene unit.
        time: time in [0, 1] of a scene that moves.
        cameras: the training cameras.
        cleaning: which parts are kept.
        texturing: settings of the texture; None for none.

    Raises:
        ConfigError: if the model has no density, or there is no surface; the message says why.
    """
    field = density.LatticeDensity(model, lattice, level, time)
    blocks = field.blocks()
    found = isosurface(lattice, density.BLOCK, track(field.valued(blocks), "Looking for the surface", len(blocks)))
    seen = field.seen
    if seen.nan:
        say(f"warning: the density is NaN at {seen.nan:,} of {seen.evaluated:,} positions; there the mesh has holes")
    if not len(found[1]):
        raise ConfigError(_without_surface(seen, level))
    return _finished(found, lattice, cameras, cleaning, _colors(model, lattice, time), texturing)


def distance_mesh(
    model: Renderable,
    lattice: Lattice,
    cameras: Cameras,
    cleaning: Cleaning,
    texturing: Texturing | None = None,
) -> Mesh:
    """Return the surface where a model's signed distance is 0, in scene coordinates.

    Vertices of marching cubes are moved onto the surface by Newton steps, and normals are the distance's gradients.

    Args:
        model: the model in evaluation mode, which has a signed distance.
        lattice: where the distance is evaluated.
        cameras: the training cameras.
        cleaning: which parts are kept.
        texturing: settings of the texture; None for none.

    Raises:
        ConfigError: if there is no surface.
    """
    field = density.LatticeDistance(model, lattice)
    blocks = field.blocks()
    found = isosurface(lattice, density.BLOCK, track(field.valued(blocks), "Looking for the surface", len(blocks)))
    if not len(found[1]):
        raise ConfigError(
            "there is no surface: the signed distance does not change its sign in the box; train longer, or set "
            "another box"
        )
    return _finished(
        found, lattice, cameras, cleaning, _colors(model, lattice, 0.0), texturing, partial(_onto, model, lattice)
    )


def _onto(model: Renderable, lattice: Lattice, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Return vertices (V, 3) moved onto the zero level set by Newton steps of at most a cell, and their normals."""
    assert isinstance(model, HasSignedDistance)
    moved, normals = vertices.clone(), torch.zeros_like(vertices, dtype=torch.float32)
    for piece in range(0, len(vertices), COLOURED):
        part = slice(piece, piece + COLOURED)
        for step in range(NEWTON_STEPS + 1):
            distances, gradients = model.signed_distance(Points(moved[part].float().to(model.device)))
            distances, gradients = distances.double().cpu(), gradients.double().cpu()
            if step == NEWTON_STEPS:
                normals[part] = safe_normalize(gradients).float()
                break
            by = -distances[:, None] * gradients / gradients.square().sum(-1, keepdim=True).clamp(min=LEAST_SLOPE**2)
            moved[part] += by.clamp(-lattice.spacing, lattice.spacing).nan_to_num()  # unknown: it stays
    near = (moved - vertices).norm(dim=-1) <= lattice.spacing  # a step that went astray is not taken
    return torch.where(near[:, None], moved, vertices), normals


def _colors(model: Renderable, lattice: Lattice, time: float) -> ColorFunction:
    """Return the function that colours vertices by the model's renders along their normals."""

    def colors(vertices: Tensor, normals: Tensor) -> Tensor:
        if not isinstance(model, RendersRays):
            return torch.full((len(vertices), 3), torch.nan)
        return seen_colors(model, vertices, normals, lattice.spacing, time)

    return colors


def fused_mesh(
    model: Renderable,
    dataset: Dataset,
    lattice: Lattice,
    truncation: float,
    views: int,
    cleaning: Cleaning,
    texturing: Texturing | None = None,
) -> Mesh:
    """Return the surface that the rendered depth images of the training views agree on, in scene coordinates.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device.
        lattice: where distances are fused.
        truncation: truncation distance, in cells.
        views: maximum number of views, evenly spaced in the data set.
        cleaning: which parts are kept.
        texturing: settings of the texture; None for none.

    Raises:
        ConfigError: if no view sees a surface in the box.
    """
    chosen = torch.linspace(0, len(dataset) - 1, min(views, len(dataset)), dtype=torch.float64).round().long()
    chosen = chosen.to(dataset.device)
    cameras, times = dataset.cameras[chosen], None if dataset.times is None else dataset.times[chosen]
    stride = tsdf.stride_for(cameras, lattice)
    rendered = tsdf.rendered_views(model, cameras, times, model.background, stride)
    depths = list(track(rendered, "Rendering depth", total=len(cameras)))
    fused = tsdf.FusedDistance(lattice, depths, truncation)
    blocks = fused.blocks()
    if not blocks:
        raise ConfigError(
            "no training view sees a surface in the box; is the run trained, and is the box the right one?"
        )
    found = isosurface(lattice, tsdf.BLOCK, track(fused.valued(blocks), "Fusing depth", total=len(blocks)))
    if not len(found[1]):
        raise ConfigError("the training views agree on no surface in the box; a larger --truncation may find one")
    return _finished(found, lattice, dataset.cameras, cleaning, fused.colors, texturing)


def in_input(mesh: Mesh, placement: Placement) -> Mesh:
    """Return a `mesh` in scene coordinates in the frame and units of the input, which has a `placement`."""
    normals = None if mesh.normals is None else placement.original_directions(mesh.normals).float()
    return replace(mesh, vertices=placement.original_points(mesh.vertices), normals=normals)


def _finished(
    found: tuple[Tensor, Tensor],
    lattice: Lattice,
    cameras: Cameras,
    cleaning: Cleaning,
    colors: ColorFunction,
    texturing: Texturing | None,
    onto: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None,
) -> Mesh:
    """Return the cleaned mesh of a surface in lattice coordinates, with normals, colours and perhaps a texture.

    `onto` moves vertices onto the surface and returns their normals; None for normals of the faces.
    """
    visible = seen_part(without_degenerate(Mesh(lattice.positions(found[0]), found[1])), cameras, cleaning.min_views)
    # Vertices on a face of a region are in it, however they are rounded.
    mesh = within(visible, [region.grown(ROUNDING * lattice.spacing) for region in cleaning.regions])
    eyes = cameras.camera_to_worlds[:, :, 3].double().cpu()
    mesh, dropped = largest_components(mesh, cleaning.num_components, cleaning.min_component_share, eyes)
    if not len(mesh.faces):
        raise ConfigError("the surface bounds only cavities; another --isosurface-threshold may find more")
    if dropped:
        say(f"{dropped:,} small or hidden pieces are left out (--num-components, --min-component-share)")
    if cleaning.target_num_faces is not None:
        mesh = simplified(mesh, cleaning.target_num_faces)
    if onto is None:
        normals = vertex_normals(mesh)
    else:
        vertices, normals = onto(mesh.vertices)
        mesh = replace(mesh, vertices=vertices)
    pieces = list(zip(mesh.vertices.split(COLOURED), normals.split(COLOURED), strict=True))
    seen = [colors(*piece) for piece in track(pieces, "Colouring the vertices", total=len(pieces))]
    of_vertices = spread_colors(torch.cat(seen), mesh.faces)
    texture = painted(mesh.vertices, normals, of_vertices, mesh.faces, colors, texturing) if texturing else None
    return replace(mesh, normals=normals, colors=of_vertices, texture=texture)


def _without_surface(seen: density.DensityRange, level: float) -> str:
    """Return why the density has no surface."""
    if not seen.evaluated:
        return "there is no surface: the occupancy grid has no occupied cell in the box; is the run trained?"
    if seen.nan == seen.evaluated:
        return "there is no surface: the density is NaN everywhere in the box; train the run again"
    return (
        f"there is no surface: the density is between {seen.low:.3g} and {seen.high:.3g} per scene unit in the box and "
        f"never passes {level:.4g}; set --isosurface-threshold, or another box"
    )
