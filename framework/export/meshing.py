"""Meshes of a trained model: its surface, cleaned and simplified, with normals and colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.dataset import Dataset
from nerfloom.export import density, tsdf
from nerfloom.export.colors import seen_colors, spread_colors
from nerfloom.export.isosurface import isosurface
from nerfloom.export.lattice import Lattice
from nerfloom.export.mesh import Mesh, largest_components, simplified, vertex_normals, within, without_degenerate
from nerfloom.export.seen import default_min_views, seen_part
from nerfloom.export.settings import MarchingCubesSettings, MeshSettings, TsdfSettings
from nerfloom.export.texture import painted
from nerfloom.geometry.points import Points
from nerfloom.geometry.regions import Region
from nerfloom.kernels.math import safe_normalize
from nerfloom.renderable import HasSignedDistance, Renderable, RendersRays

ColorFunction = Callable[[Tensor, Tensor], Tensor]
"""Function from vertices and normals (V, 3) in scene coordinates to colours (V, 3), NaN for a vertex without."""
Onto = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Function that moves vertices (V, 3) onto a surface, and returns them and their normals (V, 3)."""
COLOURED = 2**16
"""Number of vertices that are coloured at once."""
ROUNDING = 1e-4
"""Distance from a region that counts as in it, in cells."""
NEWTON_STEPS, LEAST_SLOPE = 3, 0.1
"""Number of Newton steps onto a surface, and the minimum length of a gradient that a step divides by."""


def level_set_mesh(
    model: Renderable,
    lattice: Lattice,
    cameras: Cameras,
    settings: MarchingCubesSettings,
    regions: Sequence[Region] = (),
) -> Mesh:
    """Return the surface where a model's signed distance is 0, or else where its density passes a level.

    Vertices on a signed distance are moved onto the surface by Newton steps, and normals are its gradients.

    Args:
        model: the model in evaluation mode.
        lattice: where the distance or the density is evaluated.
        cameras: the training cameras.
        settings: settings of the mesh; an open level of density is `default_level`.
        regions: the mesh keeps their intersection, scene coordinates; none for everything on the lattice.

    Returns:
        The mesh in scene coordinates.

    Raises:
        ConfigError: if the model has neither, or there is no surface; the message says why.
    """
    field: density.LatticeDensity
    onto: Onto | None = None
    if isinstance(model, HasSignedDistance):
        field, onto = density.LatticeDistance(model, lattice), partial(_onto, model, lattice)
    else:
        level = settings.isosurface_threshold
        level = density.default_level(model.scene.box) if level is None else level
        field = density.LatticeDensity(model, lattice, level, settings.time)
    blocks = field.blocks()
    found = isosurface(lattice, density.BLOCK, track(field.valued(blocks), "Looking for the surface", len(blocks)))
    if nan := field.seen.nan:
        of_all = f"{nan:,} of {field.seen.evaluated:,} positions"
        say(f"warning: the {field.quantity} is NaN at {of_all}; there the mesh has holes")
    if not len(found[1]):
        raise ConfigError(field.without_surface())
    least = default_min_views(model) if settings.min_views is None else settings.min_views
    visible = seen_part(_mesh(found, lattice), cameras, least)
    return _finished(visible, lattice, cameras, settings, regions, _colors(model, lattice, field.time), onto)


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
    settings: TsdfSettings,
    regions: Sequence[Region] = (),
) -> Mesh:
    """Return the surface that the rendered depth images of the training views agree on, in scene coordinates.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device.
        lattice: where distances are fused.
        settings: settings of the mesh.
        regions: as in `level_set_mesh`.

    Raises:
        ConfigError: if no view sees a surface in the box.
    """
    chosen = torch.tensor(evenly_spread(len(dataset), settings.max_num_views), device=dataset.device)
    cameras, times = dataset.cameras[chosen], None if dataset.times is None else dataset.times[chosen]
    stride = tsdf.stride_for(cameras, lattice)
    rendered = tsdf.rendered_views(model, cameras, times, model.background, stride)
    depths = list(track(rendered, "Rendering depth", total=len(cameras)))
    fused = tsdf.FusedDistance(lattice, depths, settings.truncation)
    blocks = fused.blocks()
    if not blocks:
        raise ConfigError(
            "no training view sees a surface in the box; is the run trained, and is the box the right one?"
        )
    found = isosurface(lattice, tsdf.BLOCK, track(fused.valued(blocks), "Fusing depth", total=len(blocks)))
    if not len(found[1]):
        raise ConfigError("the training views agree on no surface in the box; a larger --truncation may find one")
    visible = seen_part(_mesh(found, lattice), dataset.cameras, settings.min_views or 0)  # no view has fused the rest
    return _finished(visible, lattice, dataset.cameras, settings, regions, fused.colors)


def in_input(mesh: Mesh, placement: Placement) -> Mesh:
    """Return a `mesh` in scene coordinates in the frame and units of the input, which has a `placement`."""
    normals = None if mesh.normals is None else placement.original_directions(mesh.normals).float()
    return replace(mesh, vertices=placement.original_points(mesh.vertices), normals=normals)


def _mesh(found: tuple[Tensor, Tensor], lattice: Lattice) -> Mesh:
    """Return a surface in lattice coordinates as a mesh in scene coordinates."""
    return without_degenerate(Mesh(lattice.positions(found[0]), found[1]))


def _finished(
    mesh: Mesh,
    lattice: Lattice,
    cameras: Cameras,
    settings: MeshSettings,
    regions: Sequence[Region],
    colors: ColorFunction,
    onto: Onto | None = None,
) -> Mesh:
    """Return the cleaned mesh, with normals, of the faces without `onto`, with colours and perhaps a texture."""
    # Vertices on a face of a region are in it, however they are rounded.
    mesh = within(mesh, [region.grown(ROUNDING * lattice.spacing) for region in regions])
    eyes = cameras.camera_to_worlds[:, :, 3].double().cpu()
    mesh, dropped = largest_components(mesh, settings.num_components, settings.min_component_share, eyes)
    if not len(mesh.faces):
        raise ConfigError("the surface bounds only cavities; another --isosurface-threshold may find more")
    if dropped:
        say(f"{dropped:,} small or hidden pieces are left out (--num-components, --min-component-share)")
    if settings.target_num_faces is not None:
        mesh = simplified(mesh, settings.target_num_faces)
    if onto is None:
        normals = vertex_normals(mesh)
    else:
        vertices, normals = onto(mesh.vertices)
        mesh = replace(mesh, vertices=vertices)
    pieces = list(zip(mesh.vertices.split(COLOURED), normals.split(COLOURED), strict=True))
    seen = [colors(*piece) for piece in track(pieces, "Colouring the vertices", total=len(pieces))]
    of_vertices = spread_colors(torch.cat(seen), mesh.faces)
    texture, size = None, settings.texture_size
    if size is not None:
        texture = painted(mesh.vertices, normals, of_vertices, mesh.faces, colors, size, settings.texture_seconds)
    return replace(mesh, normals=normals, colors=of_vertices, texture=texture)
