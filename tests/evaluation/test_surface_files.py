"""Surfaces from files: ours, trimesh's, and damaged ones."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.ply import write_columns, write_points
from nerfloom.evaluation.surface_files import read_mesh, read_points
from nerfloom.evaluation.surfaces import Surface
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import write_mesh
from tests.evaluation.surfaces import sphere, square

trimesh = pytest.importorskip("trimesh")


def written(surface: Surface, file: Path) -> Path:
    assert surface.faces is not None
    write_mesh(file, Mesh(surface.points, surface.faces, surface.normals))
    return file


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_a_mesh_comes_back(kind: str, tmp_path: Path) -> None:
    ball = sphere(2.0, level=2)
    found = read_mesh(written(ball, tmp_path / f"ball.{kind}"))
    assert found.faces is not None
    torch.testing.assert_close(found.corners, ball.corners, atol=1e-6, rtol=0)
    assert found.normals is None


def test_normals_are_those_of_a_ply_file(tmp_path: Path) -> None:
    flat = square()
    leaning = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 1]] * 4).double(), dim=-1)
    found = read_mesh(written(Surface(flat.points, flat.faces, leaning), tmp_path / "flat.ply"))
    assert found.normals is not None
    torch.testing.assert_close(found.normals, leaning, atol=1e-6, rtol=0)


def test_parts_of_a_glb_file_are_placed(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    shift = np.eye(4)
    shift[:3, 3] = [5, 0, 0]
    scene.add_geometry(trimesh.creation.box((1, 1, 1)))
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=shift)
    scene.export(tmp_path / "two.glb")
    found = read_mesh(tmp_path / "two.glb")
    assert found.side == pytest.approx(6)
    assert len(found.corners) == 24


def test_quadrilaterals_are_divided(tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    text += (
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    )
    (tmp_path / "quad.ply").write_text(text)
    assert len(read_mesh(tmp_path / "quad.ply").corners) == 2


def test_other_files_are_not_read(tmp_path: Path) -> None:
    """A material library that cannot be read, were it tried."""
    (tmp_path / "it.mtl").mkdir()
    (tmp_path / "it.obj").write_text("mtllib it.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    assert len(read_mesh(tmp_path / "it.obj").corners) == 1


def test_points_with_and_without_normals(tmp_path: Path) -> None:
    positions = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    normals = torch.nn.functional.normalize(positions, dim=-1)
    write_points(tmp_path / "points.ply", positions, torch.zeros(50, 3), normals)
    found = read_points(tmp_path / "points.ply")
    assert found.normals is not None
    torch.testing.assert_close(found.normals, normals, atol=1e-6, rtol=0)
    write_points(tmp_path / "bare.ply", positions, torch.zeros(50, 3))
    assert read_points(tmp_path / "bare.ply").normals is None
    with pytest.raises(DataError, match=r"has no faces; pass points as --reference-points"):
        read_mesh(tmp_path / "bare.ply")


def test_what_cannot_be_used_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0]], np.float32)
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 1]])
    write_columns(tmp_path / "it.ply", list(zip("xyz", points.T, strict=True)), faces)
    assert len(read_mesh(tmp_path / "it.ply").corners) == 1
    said = capsys.readouterr().err
    assert "left out: 1 points with coordinates that are not finite, 1 faces without a finite area" in said
    assert len(read_points(tmp_path / "it.ply").points) == 3


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("it.ply", b"not a mesh", "cannot read"),
        ("it.ply", b"", "cannot read"),
        ("it.obj", b"v 0 0 0\nf 1 2 9\n", "cannot read|no faces|no face"),
        ("it.obj", b"\x00\xff\xfe" * 50, "cannot read|no faces"),
        ("it.glb", b"glTF\x02\x00\x00\x00", "cannot read"),
        ("it.stl", b"solid", "its name must end in .ply, .obj or .glb"),
    ],
)
def test_what_is_no_mesh(name: str, content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=reason) as found:
        read_mesh(tmp_path / name)
    assert name in str(found.value)


def test_files_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot read .*gone.ply: No such file"):
        read_mesh(tmp_path / "gone.ply")
    with pytest.raises(DataError, match=r"cannot read .*gone.ply"):
        read_points(tmp_path / "gone.ply")
