"""Fusion of depth, against scenes with known depth and surface."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.export.isosurface import isosurface
from nerfloom.export.lattice import lattice_of
from nerfloom.export.mesh import Mesh, closedness, vertex_normals
from nerfloom.export.tsdf import BLOCK, FusedDistance, rendered_views, stride_for
from nerfloom.rendering.rendered import Picture

pytest.importorskip("skimage")
CUBE = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
RADIUS = 0.6


class Ball:
    """A model that only renders pictures: a ball coloured by position, in empty space."""

    scene = SimpleNamespace(far=100.0)

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise

    def render_view(self, view: View, background: Tensor) -> Picture:
        rays = view.camera.pixel_rays(view.pixels().reshape(-1), 0.0, 1.0)
        along = -(rays.origins * rays.directions).sum(-1)
        across = (rays.origins + along[:, None] * rays.directions).square().sum(-1)
        hit = across < RADIUS**2
        depth = torch.where(hit, along - (RADIUS**2 - across).clamp(min=0).sqrt(), 100.0)
        depth = depth + self.noise * torch.randn(len(depth))
        rgb = torch.where(hit[:, None], 0.5 + 0.5 * (rays.origins + depth[:, None] * rays.directions), background)
        shape = (view.height, view.width)
        return Picture(rgb.view(*shape, 3), depth.view(shape), depth.view(shape), hit.float().view(shape))


def around(model: str = "pinhole", lens: list[float] | None = None, count: int = 14, size: int = 90) -> Cameras:
    """Cameras at distance 3 on a Fibonacci sphere, all looking at the origin."""
    index = torch.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, 2.399963 * index
    back = torch.stack([(1 - height**2).sqrt() * turn.cos(), (1 - height**2).sqrt() * turn.sin(), height], -1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(torch.tensor([[0.0, 0.1, 1]]).expand_as(back), back), dim=-1
    )
    poses = torch.stack([right, torch.linalg.cross(back, right), back, 3 * back], -1)
    focal = torch.full((count,), 190.0 if model != "orthographic" else 50.0)
    middle, sides = torch.full((count,), size / 2), torch.full((count,), size)
    lenses = None if lens is None else torch.tensor(lens).expand(count, -1)
    return Cameras(poses, focal, focal, middle, middle, sides, sides, model, lenses)


def fused(cameras: Cameras, resolution: int = 40, stride: int = 1, noise: float = 0.0) -> tuple[FusedDistance, Mesh]:
    model: Any = Ball(noise)
    lattice = lattice_of(CUBE, resolution)
    field = FusedDistance(lattice, list(rendered_views(model, cameras, None, torch.ones(3), stride)), 4.0)
    vertices, faces = isosurface(lattice, BLOCK, field.valued(field.blocks()))
    return field, Mesh(lattice.positions(vertices), faces)


LENS = [-0.1, 0.02, 1e-3, -1e-3, 0, 0, 0, 0, 0]


@pytest.mark.medium
@pytest.mark.parametrize(
    ("model", "lens", "stride"),
    [
        ("pinhole", None, 1),
        ("pinhole", None, 2),
        ("opencv", LENS, 1),
        ("fisheye", [0.01, 0, 0, 0], 1),
        ("orthographic", None, 1),
    ],
)
def test_the_surface_of_a_ball_is_found(model: str, lens: list[float] | None, stride: int) -> None:
    field, mesh = fused(around(model, lens), stride=stride)
    cell = field.lattice.spacing
    assert closedness(mesh).watertight
    error = mesh.vertices.norm(dim=-1) - RADIUS
    mean, most = float(error.abs().mean() / cell), float(error.abs().max() / cell)
    print(f"{model} stride {stride}: mean {mean:.3f}, most {most:.3f} cells")
    assert float(error.abs().mean()) < 0.12 * cell * stride
    assert float(error.abs().max()) < cell * stride
    normals = vertex_normals(mesh)
    colors = field.colors(mesh.vertices, normals)
    assert bool(colors.isfinite().all())
    assert float((colors - (0.5 + 0.5 * mesh.vertices)).abs().mean()) < 0.02


def test_noise_of_single_views_is_averaged() -> None:
    torch.manual_seed(0)
    noise = 0.04
    _, mesh = fused(around(count=30), noise=noise)
    error = (mesh.vertices.norm(dim=-1) - RADIUS).abs()
    assert float(error.mean()) < noise / 3


def test_half_a_ball_that_no_view_sees_stays_open() -> None:
    cameras = around(count=40)
    above = cameras[cameras.camera_to_worlds[:, 2, 3] > 2.5]
    _, mesh = fused(above)
    assert not closedness(mesh).watertight
    assert float((mesh.vertices.norm(dim=-1) - RADIUS).abs().max()) < 0.1
    assert float(mesh.vertices[:, 2].max()) > 0.55
    assert float(mesh.vertices[:, 2].min()) > -0.45


def test_pixels_are_as_coarse_as_cells() -> None:
    cameras = around(size=800)
    # A cell of 2/30 at distance 3 is 4.2 pixels wide for a focal length of 190.
    assert stride_for(cameras, lattice_of(CUBE, 30)) == 4
    assert stride_for(cameras, lattice_of(CUBE, 480)) == 1
    assert stride_for(cameras, lattice_of(CUBE, 480), most_pixels=14 * 400 * 400) == 2


def test_nothing_in_the_box_makes_no_blocks() -> None:
    lattice = lattice_of(CUBE + 5, 16)
    model: Any = Ball()
    views = list(rendered_views(model, around(count=4), None, torch.ones(3), 1))
    assert FusedDistance(lattice, views, 4.0).blocks() == []
    with pytest.raises(ConfigError, match="from 1 to 64 cells"):
        FusedDistance(lattice, views, 0.5)
