"""Outliers and normals of point clouds, of methods with rays and without, and the export of occupancy grids."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom import Scene
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.ply import read_points
from nerfloom.export.mesh import closedness
from nerfloom.export.neighbors import inliers, mean_distances, plane_normals
from nerfloom.export.occupancy import boxes_mesh, cell_centers, write_cells, write_grid
from nerfloom.export.points import joined, picture_points, surface_points
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import RendersRays
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.testing.scenes import ball_in_a_box
from tests.export.test_tsdf import RADIUS, Ball, around

pytest.importorskip("scipy")


@pytest.mark.medium
def test_points_far_from_others_are_outliers() -> None:
    torch.manual_seed(0)
    surface = torch.nn.functional.normalize(torch.randn(3000, 3), dim=-1)
    stray = 3 * torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    kept = inliers(torch.cat([surface, stray]), 2.0)
    assert int(kept[:3000].sum()) > 2990
    assert int(kept[3000:].sum()) == 0
    assert bool(inliers(surface[:2], 0.0).all())
    distances = torch.cdist(surface.double(), surface.double()).sort(-1).values[:, 1:21].mean(-1)
    torch.testing.assert_close(mean_distances(surface), distances)


def test_normals_of_a_ball_point_to_who_sees_them() -> None:
    torch.manual_seed(0)
    outward = torch.nn.functional.normalize(torch.randn(5000, 3), dim=-1)
    found = plane_normals(2.0 * outward, outward + 0.5 * torch.randn(5000, 3))
    cosine = (found * outward).sum(-1).abs()
    assert float(cosine.quantile(0.01)) > 0.99
    assert (
        float(((found * outward).sum(-1) > 0).float().mean()) > 0.9
    )  # a third of the directions are off by 45 degrees


class Drawn(Ball):
    """A method that draws whole images, and casts no rays."""

    background = torch.ones(3)
    device = torch.device("cpu")
    scene = SimpleNamespace(far=100.0, near=0.0, has_alpha=True, box=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))


class Data(SimpleNamespace):
    """The part of a data set that points need."""

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View.of(self.cameras, index)

    def kept_of(self, index: int) -> Any:
        return self.kept


def test_points_of_pictures_lie_on_the_surface() -> None:
    data: Any = Data(cameras=around(count=6, size=60), kept=None)
    model: Any = Drawn()
    parts = list(picture_points(model, data, 2000, 2.0))
    found = joined(iter(parts))
    assert len(parts) == 6
    assert 300 < len(found.positions) < 2000
    torch.testing.assert_close(
        found.positions.norm(dim=-1), torch.full((len(found.positions),), RADIUS), atol=1e-4, rtol=0
    )
    torch.testing.assert_close(found.colors, 0.5 + 0.5 * found.positions, atol=1e-4, rtol=0)
    assert float((found.directions * found.positions).sum(-1).max()) < 0  # seen from outside
    near = joined(picture_points(model, data, 2000, 0.5)).positions
    assert len(near) > 100
    assert float(near.abs().max()) <= 0.5
    masked: Any = Data(cameras=data.cameras, kept=torch.zeros(60, 60, dtype=torch.bool))
    assert not len(joined(picture_points(model, masked, 2000, 2.0)).positions)


class InItsLight(RendersRays):
    """Black in the mean light, and lighter in that of an image."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    @property
    def rays_at_once(self) -> int:
        return 300

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        shade = torch.zeros(len(rays)) if rays.camera_indices is None else torch.full((len(rays),), 0.5)
        ones = torch.ones(len(rays))
        return Rendered(shade[:, None].expand(-1, 3), ones, ones, ones, 0)

    def render_view(self, view: View, background: Tensor) -> Picture:
        raise AssertionError


def test_points_have_the_light_of_no_image() -> None:
    dataset = ball_in_a_box(16)
    found = joined(surface_points(InItsLight(dataset.scene), dataset, 1000, None))
    assert len(found.colors) == 1000
    assert not found.colors.any()


def grid_of(box: list[list[float]]) -> OccupancySampler:
    grid = OccupancySampler(torch.tensor(box).float(), resolution=4)
    occupied = torch.zeros(4, 4, 4, dtype=torch.bool)
    occupied[1, 2, 3] = occupied[2, 2, 3] = occupied[0, 0, 0] = True
    grid.occupied.copy_(occupied.reshape(-1))
    return grid


QUARTER = Placement(torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]]).double(), 2.0)


def test_an_occupancy_grid_is_in_the_frame_of_the_input(tmp_path: Path) -> None:
    grid = grid_of([[-1, -2, -3], [1, 2, 3]])
    scene = torch.tensor([[-0.25, 0.5, 2.25], [0.25, 0.5, 2.25], [-0.75, -1.5, -2.25]]).double()
    expected = QUARTER.original_points(scene)
    found = cell_centers(grid, QUARTER)
    assert float(torch.cdist(found, expected).amin(0).max()) < 1e-6
    write_grid(tmp_path / "occupancy.npz", grid, QUARTER)
    with np.load(tmp_path / "occupancy.npz", allow_pickle=False) as read:
        assert read["occupied"].dtype == np.bool_
        cells = np.argwhere(read["occupied"])
        places = (cells + 0.5) / 4 @ read["cube_to_input"][:3, :3].T + read["cube_to_input"][:3, 3]
        np.testing.assert_allclose(places, found.numpy())
        np.testing.assert_allclose(read["box"], [[-1, -2, -3], [1, 2, 3]])
    write_cells(tmp_path / "occupancy.ply", grid, QUARTER, boxes=False)
    torch.testing.assert_close(read_points(tmp_path / "occupancy.ply"), found.float().double())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["occupancy.npz", "occupancy.ply"]


def test_boxes_of_cells_enclose_their_volume(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    grid = grid_of([[-1, -1, -1], [1, 1, 1]])
    mesh = boxes_mesh(grid)
    assert closedness(mesh).watertight
    assert len(mesh.faces) == 2 * (6 + 10)  # no faces between the two that touch
    write_cells(tmp_path / "occupancy.ply", grid, QUARTER, boxes=True)
    read = trimesh.load(tmp_path / "occupancy.ply", process=False)
    assert read.volume == pytest.approx(3 * (0.5 / 2) ** 3)  # cells of 0.5, in units of half that size
