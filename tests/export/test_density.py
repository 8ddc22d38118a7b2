"""The density of a model as a surface: levels, skipped cells, and the error without a surface."""

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.export.density import LatticeDensity, default_level
from nerfloom.export.lattice import lattice_of
from nerfloom.export.mesh import closedness
from nerfloom.export.meshing import level_set_mesh
from nerfloom.export.settings import MarchingCubesSettings
from nerfloom.geometry.points import Points
from nerfloom.samplers.occupancy import OccupancySampler

pytest.importorskip("skimage")
CUBE = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
numbers = torch.ones(1)
EYES = Cameras(torch.eye(4)[None, :3] + 5, *[numbers] * 4, *[numbers.long()] * 2)  # type: ignore[arg-type]


class Matter(nn.Module):
    """A model that only has a density."""

    device = torch.device("cpu")
    rendering = staticmethod(nullcontext)

    def __init__(self, function: Any, grid: OccupancySampler | None = None) -> None:
        super().__init__()
        self.function, self.grid = function, grid
        self.scene = SimpleNamespace(moving=False, box=CUBE)
        self.asked = 0

    def density(self, points: Points) -> Tensor:
        self.asked += len(points)
        return self.function(points.positions)


def soft(positions: Tensor) -> Tensor:
    """A ball with a density that falls by e in each 0.1 outwards, and is 10 at radius 0.5."""
    return 10 * ((0.5 - positions.norm(dim=-1)) / 0.1).exp()


def mesh_of(model: Any, level: float, resolution: int = 40) -> Any:
    return level_set_mesh(model, lattice_of(CUBE, resolution), EYES, MarchingCubesSettings(isosurface_threshold=level))


@pytest.mark.parametrize("level", [3.0, 10.0, 40.0])
def test_the_surface_is_where_the_density_is_the_level(level: float) -> None:
    mesh = mesh_of(Matter(soft), level)
    radius = 0.5 - 0.1 * math.log(level / 10)
    assert closedness(mesh).watertight
    assert float((mesh.vertices.norm(dim=-1) - radius).abs().max()) < 0.1 * 2 / 40
    assert bool(mesh.colors.isfinite().all())


def test_the_default_level_makes_a_fraction_of_the_box_half_opaque() -> None:
    assert 1 - math.exp(-default_level(CUBE) * 2 / 32) == pytest.approx(0.5)


def grid_of(kept: Any) -> OccupancySampler:
    grid = OccupancySampler(CUBE, resolution=16)
    centers = (torch.cartesian_prod(*[torch.arange(16)] * 3) + 0.5) / 8 - 1
    grid.occupied.copy_(kept(centers))
    return grid


def test_cells_that_the_renderer_skips_are_empty_and_not_evaluated() -> None:
    """The density there was never learnt: here it is a wall's."""

    def walled(positions: Tensor) -> Tensor:
        return torch.where(positions[:, 0] > 0.75, 1e4, soft(positions))

    everything = Matter(walled)
    assert float(mesh_of(everything, 10.0).vertices[:, 0].max()) > 0.7
    grid = grid_of(lambda centers: centers.norm(dim=-1) < 0.75)
    skipping = Matter(walled, grid)
    mesh = mesh_of(skipping, 10.0)
    assert closedness(mesh).watertight
    assert float((mesh.vertices.norm(dim=-1) - 0.5).abs().max()) < 0.1 * 2 / 40
    assert skipping.asked < 0.4 * everything.asked


def test_blocks_are_those_that_overlap_an_occupied_cell() -> None:
    grid = grid_of(lambda centers: ((centers > 0.1) & (centers < 0.2)).all(-1))
    assert int(grid.occupied.sum()) == 1
    field = LatticeDensity(Matter(soft, grid), lattice_of(CUBE, 256), 1.0)
    # The cell is from 0.125 to 0.25; block 4 from 0 to 0.25, and block 5 has points on the cell's far faces.
    assert [block.tolist() for block in field.blocks()] == torch.cartesian_prod(*[torch.tensor([4, 5])] * 3).tolist()
    none = LatticeDensity(Matter(soft, grid_of(lambda centers: centers[:, 0] > 5)), lattice_of(CUBE, 256), 1.0)
    assert none.blocks() == []


def test_cells_that_end_with_a_block_are_closed() -> None:
    """Random cells of one density; their surface is in neighbouring blocks too."""
    torch.manual_seed(0)
    grid = grid_of(lambda centers: (torch.rand(len(centers)) < 0.02) & (centers.abs() < 0.9).all(-1))
    for resolution in (64, 128):
        mesh = mesh_of(Matter(lambda positions: torch.full((len(positions),), 100.0), grid), 10.0, resolution)
        assert closedness(mesh).watertight


def test_the_coarse_pass_leaves_out_empty_blocks() -> None:
    def far_off(positions: Tensor) -> Tensor:
        return soft(4 * (positions - 0.7))  # a small ball in a corner

    model = Matter(far_off)
    field = LatticeDensity(model, lattice_of(CUBE, 128), 10.0)
    blocks = field.blocks()
    assert [3, 3, 3] in [block.tolist() for block in blocks]
    assert len(blocks) <= 8
    mesh = mesh_of(model, 10.0, 128)
    assert float(((mesh.vertices - 0.7).norm(dim=-1) - 0.125).abs().max()) < 1e-3


def test_there_is_a_reason_without_a_surface() -> None:
    with pytest.raises(ConfigError, match=r"between 3 and 3 .* 50"):
        mesh_of(Matter(lambda positions: torch.full((len(positions),), 3.0)), 50.0)
    with pytest.raises(ConfigError, match="NaN everywhere"):
        mesh_of(Matter(lambda positions: torch.full((len(positions),), torch.nan)), 5.0)
    with pytest.raises(ConfigError, match="no occupied cell"):
        mesh_of(Matter(soft, grid_of(lambda centers: centers[:, 0] > 5)), 5.0)
    with pytest.raises(ConfigError, match="'ns-export tsdf' makes a mesh"):
        LatticeDensity(nn.Linear(1, 1), lattice_of(CUBE, 4), 1.0)  # type: ignore[arg-type]


def test_nan_is_counted_and_leaves_a_hole(capsys: pytest.CaptureFixture[str]) -> None:
    def torn(positions: Tensor) -> Tensor:
        return torch.where(positions[:, 0] > 0.2, torch.nan, soft(positions))

    mesh = mesh_of(Matter(torn), 10.0)
    assert "the density is NaN at" in capsys.readouterr().err
    assert not closedness(mesh).watertight
    assert float(mesh.vertices[:, 0].max()) < 0.25


def test_numbers_out_of_range_are_refused() -> None:
    kind = MarchingCubesSettings
    for wrong in (kind(num_components=-1), kind(min_component_share=2.0), kind(target_num_faces=3)):
        with pytest.raises(ConfigError, match="must be at least"):
            wrong.check_ranges()
