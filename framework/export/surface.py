"""The surface of a trained model as a mesh in the input's frame, as `ns-eval` judges it by default."""

from __future__ import annotations

from typing import Literal

from nerfloom.base.errors import ConfigError
from nerfloom.export.lattice import lattice_of
from nerfloom.export.mesh import Mesh
from nerfloom.export.meshing import fused_mesh, in_input, level_set_mesh
from nerfloom.export.settings import MarchingCubesSettings, TsdfSettings
from nerfloom.renderable import HasDensity, HasSignedDistance, Renderable
from nerfloom.training.loaded import Loaded

SurfaceKind = Literal["marching-cubes", "tsdf"]
"""Export that makes the mesh."""


def kind_for(model: Renderable) -> SurfaceKind:
    """Return the export that suits a model.

    It is marching cubes of a signed distance, or of a density in a box, and otherwise fused depth.

    Args:
        model: the model.
    """
    if isinstance(model, HasSignedDistance):
        return "marching-cubes"
    return "marching-cubes" if isinstance(model, HasDensity) and not model.scene.unbounded else "tsdf"


def surface_mesh(
    loaded: Loaded,
    kind: SurfaceKind,
    resolution: int,
    low: tuple[float, float, float] | None = None,
    high: tuple[float, float, float] | None = None,
    whole: bool = False,
) -> Mesh:
    """Return the surface of a model, as `ns-export` writes it with its defaults.

    Args:
        loaded: the model and its data.
        kind: the export.
        resolution: number of cells along the longest edge of the box.
        low, high: corners of a box to use instead of the scene's, in the frame and unit of the input.
        whole: whether faces that no training camera sees stay in any case.

    Raises:
        ConfigError: if the model has no density, there is no surface, or it has no shape in space or time.
    """
    model = loaded.model
    if model.scene.warped:
        raise ConfigError("this run is in normalised device coordinates (--ndc), where lengths have no scale")
    if model.scene.moving:
        raise ConfigError("this scene moves: export the mesh of one time (ns-export), and pass it as --mesh")
    lattice = lattice_of(model.scene.box, resolution, loaded.placement, low, high)
    if kind == "tsdf":
        mesh = fused_mesh(model, loaded.dataset("train"), lattice, TsdfSettings())
    else:
        settings = MarchingCubesSettings(min_views=0 if whole else None)
        mesh = level_set_mesh(model, lattice, loaded.parsed("train").cameras, settings)
    return in_input(mesh, loaded.placement)
