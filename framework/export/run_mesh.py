"""Meshes of a run as files, in the frame and units of the input."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import require
from nerfloom.cameras.poses import Placement
from nerfloom.export.density import default_level
from nerfloom.export.lattice import Lattice, lattice_of
from nerfloom.export.mesh import Mesh, closedness
from nerfloom.export.mesh_files import write_mesh
from nerfloom.export.meshing import Cleaning, density_mesh, distance_mesh, fused_mesh, in_input
from nerfloom.export.seen import default_min_views
from nerfloom.export.settings import MarchingCubesSettings, MeshSettings, TsdfSettings
from nerfloom.export.texture import Texturing
from nerfloom.geometry.regions import Region, bounds_of_all
from nerfloom.renderable import HasDensity, HasSignedDistance
from nerfloom.training.loaded import Loaded


def export_level_set(
    loaded: Loaded, path: Path, settings: MarchingCubesSettings, regions: Sequence[Region] = ()
) -> None:
    """Write a mesh of a level of density, or of distance zero.

    Args:
        loaded: the run.
        path: file to write.
        settings: settings of the mesh.
        regions: the mesh keeps their intersection, in the frame of exports; none for the scene's box.

    Raises:
        ConfigError: if a setting is out of range, the method has no density, or there is no surface.
    """
    lattice, cleaning, texturing = _prepared(settings, loaded, path, regions, default_min_views(loaded.model))
    model, level, start = loaded.model, settings.isosurface_threshold, time.monotonic()
    if isinstance(model, HasSignedDistance):
        if level is not None:
            raise FlagError(f"--isosurface-threshold: the surface of {loaded.method} is where its distance is 0")
        cameras = loaded.parsed("train").cameras
        _write(distance_mesh(model, lattice, cameras, cleaning, texturing), loaded.placement, path, start)
        return
    if not isinstance(model, HasDensity):
        raise ConfigError(f"ns-export marching-cubes: {loaded.method} has no density; 'ns-export tsdf' makes a mesh")
    if level is not None and not 0 < level < float("inf"):
        raise FlagError(f"--isosurface-threshold is {level:g}; it must be above zero")
    if not 0 <= settings.time <= 1:
        raise FlagError(f"--time is {settings.time:g}; it must be from 0 to 1")
    if level is None:
        level = default_level(model.scene.box)
        say(f"the surface is where the density is {level:.4g} per scene unit (--isosurface-threshold)")
    cameras = loaded.parsed("train").cameras
    mesh = density_mesh(model, lattice, level, settings.time, cameras, cleaning, texturing)
    _write(mesh, loaded.placement, path, start)


def export_fused(loaded: Loaded, path: Path, settings: TsdfSettings, regions: Sequence[Region] = ()) -> None:
    """Write a mesh of fused depth images, in the frame of the input.

    Args:
        loaded: the run, or a file with photographs.
        path: file to write.
        settings: settings of the mesh.
        regions: as in `export_level_set`.

    Raises:
        ConfigError: if a setting is out of range, or there is no surface.
    """
    lattice, cleaning, texturing = _prepared(settings, loaded, path, regions, min_views=0)  # no view has fused the rest
    if settings.max_num_views < 1:
        raise FlagError(f"--max-num-views is {settings.max_num_views}; it must be at least 1")
    start = time.monotonic()
    dataset = loaded.dataset("train")
    mesh = fused_mesh(loaded.model, dataset, lattice, settings.truncation, settings.max_num_views, cleaning, texturing)
    _write(mesh, loaded.placement, path, start)


def _prepared(
    settings: MeshSettings, loaded: Loaded, path: Path, regions: Sequence[Region], min_views: int
) -> tuple[Lattice, Cleaning, Texturing | None]:
    """Return the lattice and the settings of cleaning and texture, after checks of settings and installed packages.

    `min_views` replaces the setting if it is open.
    """
    require("export", "a mesh needs")
    cleaning = Cleaning(
        settings.num_components,
        settings.min_component_share,
        settings.target_num_faces,
        min_views if settings.min_views is None else settings.min_views,
        tuple(region.moved(*loaded.placement.similarity()) for region in regions),
    )
    cleaning.check()
    texturing = None
    if settings.texture_size is not None:
        if path.suffix.lower() == ".ply":
            raise ConfigError("--texture-size: a PLY file has no texture; take --format obj or --format glb")
        texturing = Texturing(settings.texture_size, settings.texture_seconds)
        texturing.check()
    corners = bounds_of_all(regions) or (None, None)
    lattice = lattice_of(loaded.model.scene.box, settings.resolution, loaded.placement, *corners)
    return lattice, cleaning, texturing


def _write(mesh: Mesh, placement: Placement, path: Path, start: float) -> None:
    """Write a mesh, in a .glb file with y up, and report its size."""
    write_mesh(path, in_input(mesh, placement.y_up() if path.suffix.lower() == ".glb" else placement))
    counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, {closedness(mesh).sentence()}"
    say(f"{counts}; {path.stat().st_size / 1e6:.1f} MB after {time.monotonic() - start:.1f} s: {path}")
