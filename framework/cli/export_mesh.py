"""The meshes of `ns-export`: flags and output of `marching-cubes` and `tsdf`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import install_command
from nerfloom.cli.export_flags import ExportFlags

if TYPE_CHECKING:
    from nerfloom.cameras.poses import Placement
    from nerfloom.export.lattice import Lattice
    from nerfloom.export.mesh import Mesh
    from nerfloom.export.meshing import Cleaning
    from nerfloom.export.texture import Texturing
    from nerfloom.training.loaded import Loaded


@dataclass(frozen=True, kw_only=True)
class MeshFlags(ExportFlags):
    """Flags of every mesh."""

    format: Literal["ply", "obj", "glb"] = "ply"
    """File format; ply is the smallest and fastest. In glb, y is up."""
    resolution: int = 256
    """Number of cells along the longest edge of the box, up to 1024."""
    bounding_box_min: tuple[float, float, float] | None = None
    """Minimum corner x y z of the searched box, in the frame and units of the input. Default: the scene's box."""
    bounding_box_max: tuple[float, float, float] | None = None
    """Maximum corner x y z of that box."""
    num_components: int = 0
    """Maximum number of separate pieces to keep, largest first; 0: all."""
    min_component_share: float = 0.001
    """Remove pieces with fewer faces than this fraction of the largest piece's."""
    target_num_faces: int | None = None
    """Simplify the mesh to this number of faces. Default: no simplification."""
    texture_size: int | None = None
    """Edge length of a texture for obj and glb, texels, such as 4096. Default: no texture, colours at vertices."""
    texture_seconds: float = 300.0
    """Maximum seconds for the texture; the rest of it gets the vertices' colours."""


@dataclass(frozen=True, kw_only=True)
class MarchingCubesFlags(MeshFlags):
    """Write a mesh of the surface of a field, with colours and normals.

    The surface is where the density passes a level, or where a signed distance is zero.
    """

    isosurface_threshold: float | None = None
    """Density of the surface, per scene unit. Default: the density at which 1/32 of the scene's box is half opaque."""
    time: float = 0.0
    """Time of a moving scene, 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class TsdfFlags(MeshFlags):
    """Write a mesh of what the training cameras see, from their fused depth images; works with every method."""

    truncation: float = 4.0
    """Depth images count up to this distance from the surface, cells; larger is smoother, smaller keeps thin
    parts."""
    max_num_views: int = 200
    """Maximum number of rendered training views, evenly spaced."""


def marching_cubes(flags: MarchingCubesFlags, loaded: Loaded, path: Path) -> None:
    """Write a mesh of a level of the density, or of where a signed distance is zero, in the frame of the input.

    Args:
        flags: flags of the command.
        loaded: what is exported.
        path: file to write.

    Raises:
        ConfigError: if a flag is out of range, the method has no density, or there is no surface.
    """
    lattice, cleaning, texturing = _prepared(flags, loaded)
    from nerfloom.base.console import say
    from nerfloom.export.density import default_level
    from nerfloom.export.meshing import density_mesh, distance_mesh
    from nerfloom.renderable import HasDensity, HasSignedDistance

    model, level, start = loaded.model, flags.isosurface_threshold, time.monotonic()
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
    if not 0 <= flags.time <= 1:
        raise FlagError(f"--time is {flags.time:g}; it must be from 0 to 1")
    if level is None:
        level = default_level(model.scene.box)
        say(f"the surface is where the density is {level:.4g} per scene unit (--isosurface-threshold)")
    cameras = loaded.parsed("train").cameras
    mesh = density_mesh(model, lattice, level, flags.time, cameras, cleaning, texturing)
    _write(mesh, loaded.placement, path, start)


def tsdf(flags: TsdfFlags, loaded: Loaded, path: Path) -> None:
    """Write a mesh of fused depth images, in the frame of the input.

    Args:
        flags: flags of the command.
        loaded: what is exported.
        path: file to write.

    Raises:
        ConfigError: if a flag is out of range, or there is no surface.
    """
    lattice, cleaning, texturing = _prepared(flags, loaded)
    if flags.max_num_views < 1:
        raise FlagError(f"--max-num-views is {flags.max_num_views}; it must be at least 1")
    from nerfloom.export.meshing import fused_mesh

    start = time.monotonic()
    dataset = loaded.dataset("train")
    mesh = fused_mesh(loaded.model, dataset, lattice, flags.truncation, flags.max_num_views, cleaning, texturing)
    _write(mesh, loaded.placement, path, start)


def _prepared(flags: MeshFlags, loaded: Loaded) -> tuple[Lattice, Cleaning, Texturing | None]:
    """Return the lattice and the settings of cleaning and texture, after checks of flags and installed packages."""
    if (advice := install_command("export")) is not None:
        raise ConfigError(f"a mesh needs packages that are not installed: {advice}")
    from nerfloom.export.lattice import lattice_of
    from nerfloom.export.meshing import Cleaning
    from nerfloom.export.texture import Texturing

    cleaning = Cleaning(flags.num_components, flags.min_component_share, flags.target_num_faces)
    cleaning.check()
    texturing = None
    if flags.texture_size is not None:
        if flags.format == "ply":
            raise ConfigError("--texture-size: a PLY file has no texture; take --format obj or --format glb")
        texturing = Texturing(flags.texture_size, flags.texture_seconds)
        texturing.check()
    box, low, high = loaded.model.scene.box, flags.bounding_box_min, flags.bounding_box_max
    return lattice_of(box, flags.resolution, loaded.placement, low, high), cleaning, texturing


def _write(mesh: Mesh, placement: Placement, path: Path, start: float) -> None:
    """Write a mesh, in a .glb file with y up, and say what it is."""
    from nerfloom.base.console import say
    from nerfloom.export.mesh import closedness
    from nerfloom.export.mesh_files import write_mesh
    from nerfloom.export.meshing import in_input

    write_mesh(path, in_input(mesh, placement.y_up() if path.suffix == ".glb" else placement))
    counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, {closedness(mesh).sentence()}"
    say(f"{counts}; {path.stat().st_size / 1e6:.1f} MB after {time.monotonic() - start:.1f} s: {path}")
