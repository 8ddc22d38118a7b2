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
from nerfloom.export.meshing import fused_mesh, in_input, level_set_mesh
from nerfloom.export.settings import MarchingCubesSettings, MeshSettings, TsdfSettings
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
    lattice, placed = _prepared(settings, loaded, path, regions)
    model, start = loaded.model, time.monotonic()
    if isinstance(model, HasSignedDistance):
        if settings.isosurface_threshold is not None:
            raise FlagError(f"--isosurface-threshold: the surface of {loaded.method} is where its distance is 0")
    elif not isinstance(model, HasDensity):
        raise ConfigError(f"ns-export marching-cubes: {loaded.method} has no density; 'ns-export tsdf' makes a mesh")
    elif settings.isosurface_threshold is None:
        level = default_level(model.scene.box)
        say(f"the surface is where the density is {level:.4g} per scene unit (--isosurface-threshold)")
    mesh = level_set_mesh(model, lattice, loaded.parsed("train").cameras, settings, placed)
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
    lattice, placed = _prepared(settings, loaded, path, regions)
    start = time.monotonic()
    mesh = fused_mesh(loaded.model, loaded.dataset("train"), lattice, settings, placed)
    _write(mesh, loaded.placement, path, start)


def _prepared(
    settings: MeshSettings, loaded: Loaded, path: Path, regions: Sequence[Region]
) -> tuple[Lattice, list[Region]]:
    """Return the lattice, and the regions in scene coordinates, after checks of settings and installed packages."""
    require("export", "a mesh needs")
    settings.check_ranges()
    if settings.texture_size is not None and path.suffix.lower() == ".ply":
        raise ConfigError("--texture-size: a PLY file has no texture; take --format obj or --format glb")
    corners = bounds_of_all(regions) or (None, None)
    lattice = lattice_of(loaded.model.scene.box, settings.resolution, loaded.placement, *corners)
    return lattice, [region.moved(*loaded.placement.similarity()) for region in regions]


def _write(mesh: Mesh, placement: Placement, path: Path, start: float) -> None:
    """Write a mesh, in a .glb file with y up, and report its size."""
    write_mesh(path, in_input(mesh, placement.y_up() if path.suffix.lower() == ".glb" else placement))
    counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, {closedness(mesh).sentence()}"
    say(f"{counts}; {path.stat().st_size / 1e6:.1f} MB after {time.monotonic() - start:.1f} s: {path}")
