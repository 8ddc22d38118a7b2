"""Marching cubes in blocks, against surfaces with known volume, area and distance."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.export import isosurface as module
from nerfloom.export.isosurface import isosurface
from nerfloom.export.lattice import Lattice, lattice_of
from nerfloom.export.mesh import Mesh, closedness, vertex_normals, without_degenerate

pytest.importorskip("skimage")
CUBE = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


def ball(points: Tensor, radius: float = 0.7) -> Tensor:
    return (radius - points.norm(dim=-1)).float()


def mesh_of(lattice: Lattice, function=ball, edge: int = 16) -> Mesh:
    def valued():
        for block in lattice.all_blocks(edge):
            points, _ = lattice.block_points(block, edge)
            yield block, function(lattice.positions(points))

    vertices, faces = isosurface(lattice, edge, valued())
    return without_degenerate(Mesh(lattice.positions(vertices), faces))


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("edge", [7, 16, 100])
def test_a_ball_has_its_volume_and_no_seam_whatever_the_blocks(edge: int) -> None:
    mesh = mesh_of(lattice_of(CUBE, 50), edge=edge)
    assert closedness(mesh).watertight
    assert len(mesh.vertices) - len(mesh.faces) // 2 == 2  # Euler's formula
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=3e-3)
    assert float((mesh.vertices.norm(dim=-1) - 0.7).abs().max()) < 2e-3
    outward = torch.nn.functional.normalize(mesh.vertices, dim=-1).float()
    assert float((vertex_normals(mesh) * outward).sum(-1).min()) > 0.99


def test_blocks_of_noise_meet_without_a_gap() -> None:
    """Noise has every case of marching cubes; values of lattice points are the same in all blocks that share them."""
    torch.manual_seed(0)
    noise = torch.rand(25, 25, 25) - 0.5
    noise[[0, -1]] = noise[:, [0, -1]] = noise[:, :, [0, -1]] = -0.3
    noise[3, 3, 3] = 0.0  # exactly on the surface
    lattice = lattice_of(torch.tensor([[0.0, 0, 0], [24, 24, 24]]), 24)

    def value(positions: Tensor) -> Tensor:
        return noise[tuple(positions.round().long().T)]

    whole, parts = mesh_of(lattice, value, 24), mesh_of(lattice, value, 5)
    assert len(whole.faces) == len(parts.faces) > 10_000
    assert closedness(whole).open_edges == closedness(parts).open_edges == 0
    assert volume(whole) == pytest.approx(volume(parts), rel=1e-6)
    np.testing.assert_allclose(np.sort(whole.vertices.numpy(), 0), np.sort(parts.vertices.numpy(), 0), atol=1e-4)


def test_where_nothing_is_known_there_is_no_surface() -> None:
    def half(points: Tensor) -> Tensor:
        return torch.where(points[:, 0] > 0.1, torch.nan, ball(points))

    mesh = mesh_of(lattice_of(CUBE, 40), half)
    assert float(mesh.vertices[:, 0].max()) < 0.15
    assert closedness(mesh).open_edges > 50
    assert float((mesh.vertices.norm(dim=-1) - 0.7).abs().max()) < 3e-3


def test_a_box_of_the_input_is_parallel_to_the_inputs_axes() -> None:
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0]]).double())
    placement = Placement(torch.cat([turn, torch.tensor([[1.0], [-2.0], [0.5]]).double()], -1), 0.25)
    lattice = lattice_of(CUBE, 20, placement, (1.0, 2.0, 3.0), (3.0, 3.0, 4.01))
    assert lattice.cells == (20, 10, 11)
    assert lattice.spacing == pytest.approx(0.1 * 0.25)
    corners = torch.tensor([[0, 0, 0], [20, 10, 10]])
    found = placement.original_points(lattice.positions(corners))
    torch.testing.assert_close(found, torch.tensor([[1.0, 2, 3], [3, 3, 4]]).double())
    torch.testing.assert_close(lattice.indices(lattice.positions(corners)), corners.double())


def test_what_cannot_be_a_lattice_is_refused() -> None:
    for resolution in (1, 1025):
        with pytest.raises(ConfigError, match="from 2 to 1024"):
            lattice_of(CUBE, resolution)
    placement = Placement(torch.eye(4)[:3], 1.0)
    with pytest.raises(ConfigError, match="belong together"):
        lattice_of(CUBE, 10, placement, (0, 0, 0))
    for high in ((1.0, 0.0, 1.0), (1.0, math.inf, 1.0), (1.0, math.nan, 1.0)):
        with pytest.raises(ConfigError, match="along each axis"):
            lattice_of(CUBE, 10, placement, (0, 0, 0), high)


def test_noise_ends_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_VERTICES", 5000)
    torch.manual_seed(0)
    with pytest.raises(ConfigError, match="more than 5,000 vertices: it is noise"):
        mesh_of(lattice_of(CUBE, 30), lambda points: torch.rand(len(points)) - 0.5)


@pytest.mark.parametrize("seed", [32, 75])
def test_beside_unknown_points_only_their_cells_are_left_out(seed: int) -> None:
    """These seeds' noise has triangles in the block's last face, where no cell begins."""
    noise = torch.from_numpy(np.random.default_rng(seed).uniform(-0.5, 0.5, (9, 9, 9)).astype(np.float32))
    lattice = lattice_of(torch.tensor([[0.0, 0, 0], [8, 8, 8]]), 8)

    def middles(corner: float) -> Tensor:
        noise[0, 0, 0] = corner
        mesh = mesh_of(lattice, lambda positions: noise[tuple(positions.round().long().T)], edge=8)
        return mesh.vertices[mesh.faces].mean(1)

    whole, holed = middles(-1.0), middles(math.nan)
    kept = whole[~(whole < 1).all(-1)]
    assert 0 < len(kept) < len(whole)
    assert torch.equal(holed, kept)
