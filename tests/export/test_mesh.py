"""Meshes: components, hollows, simplification, and files read back by trimesh."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.cameras.poses import Placement
from nerfloom.export.colors import spread_colors
from nerfloom.export.mesh import (
    Mesh,
    closedness,
    components,
    largest_components,
    simplified,
    vertex_normals,
)
from nerfloom.export.mesh_files import write_mesh
from nerfloom.export.run_mesh import _write
from nerfloom.export.texture import Texture
from tests.splats.test_gltf import read as read_glb

trimesh = pytest.importorskip("trimesh")


def sphere(radius: float, center: tuple[float, float, float] = (0, 0, 0), level: int = 3, inward: bool = False) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    faces = torch.from_numpy(np.array(made.faces)).long()
    return Mesh(torch.from_numpy(np.array(made.vertices)) + torch.tensor(center), faces.flip(1) if inward else faces)


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + int(start) for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))


NOWHERE = torch.zeros(0, 3, dtype=torch.float64)


def test_components_are_ordered_by_size_and_small_ones_dropped() -> None:
    mesh = together(sphere(0.1, (3, 0, 0), 1), sphere(1.0), sphere(0.5, (-3, 0, 0), 2))
    assert components(mesh).bincount().tolist() == [1280, 320, 80]
    kept, dropped = largest_components(mesh, 0, 0.1, NOWHERE)
    assert (len(kept.faces), dropped) == (1600, 1)
    assert len(kept.vertices) == 642 + 162
    kept, dropped = largest_components(mesh, 1, 0.0, NOWHERE)
    assert (len(kept.faces), dropped) == (1280, 2)
    assert float(kept.vertices.norm(dim=-1).max()) == pytest.approx(1)


def test_hollows_are_dropped_unless_a_camera_is_inside() -> None:
    shell = together(sphere(1.0), sphere(0.8, inward=True))
    kept, dropped = largest_components(shell, 0, 0.0, torch.tensor([[3.0, 0, 0]]).double())
    assert dropped == 1
    assert float(kept.vertices.norm(dim=-1).min()) == pytest.approx(1)
    room, dropped = largest_components(shell, 0, 0.0, torch.tensor([[0.1, 0, 0]]).double())
    assert dropped == 0
    assert len(room.faces) == 2560


def test_a_surface_that_is_open_is_no_hollow_whatever_its_volume() -> None:
    """The signed volume of a wall that leaves the box depends on the origin."""
    open_ = sphere(1.0, inward=True)
    open_ = open_.with_faces(open_.vertices[open_.faces].mean(1)[:, 2] < 0.5)
    kept, dropped = largest_components(together(sphere(0.5, (5, 0, 0)), open_), 0, 0.0, NOWHERE)
    assert dropped == 0
    assert len(kept.faces) == 1280 + len(open_.faces)


def test_open_and_crowded_edges_are_counted() -> None:
    mesh = sphere(1.0)
    assert closedness(mesh).sentence() == "watertight"
    hole = mesh.with_faces(torch.arange(len(mesh.faces)) > 0)
    assert closedness(hole).sentence() == "not watertight: 3 open edges"
    extra = Mesh(torch.cat([mesh.vertices, torch.zeros(1, 3)]), torch.cat([mesh.faces, torch.tensor([[0, 0, 642]])]))
    extra.faces[-1, :2] = mesh.faces[0, :2]
    assert closedness(extra).crowded_edges == 1
    assert not closedness(extra).watertight


def test_a_simplified_ball_is_still_a_ball() -> None:
    pytest.importorskip("fast_simplification")
    center = (1e4, -2e4, 5e3)  # where float32 has steps of 2 mm
    mesh = simplified(sphere(0.01, center, 5), 2000)
    assert 1500 < len(mesh.faces) <= 2000
    assert closedness(mesh).watertight
    radii = (mesh.vertices - torch.tensor(center).double()).norm(dim=-1)
    assert float((radii / 0.01 - 1).abs().max()) < 0.01
    small = sphere(1.0)
    assert simplified(small, 5000) is small


def test_normals_of_a_tiny_mesh_are_unit_normals() -> None:
    mesh = sphere(1.0)
    normals = vertex_normals(Mesh(1e-30 * mesh.vertices, mesh.faces))
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(642))


def test_colors_spread_to_vertices_without() -> None:
    faces = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7]])
    colors = torch.full((8, 3), torch.nan)
    colors[0], colors[1] = torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0])
    found = spread_colors(colors, faces)
    torch.testing.assert_close(found[2], torch.tensor([1 / 3, 2 / 3, 0]))  # vertex 1 is beside it in two faces
    assert bool(found.isfinite().all())
    torch.testing.assert_close(found[5], found[:5].mean(0))  # nothing reaches them
    assert float((spread_colors(torch.full((8, 3), torch.nan), faces) - 0.5).abs().max()) == 0


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_files_are_read_back(kind: str, tmp_path: Path) -> None:
    mesh = sphere(0.5, (1, 2, 3))
    normals = vertex_normals(mesh)
    colors = torch.rand(len(mesh.vertices), 3)
    write_mesh(tmp_path / f"ball.{kind}", Mesh(mesh.vertices, mesh.faces, normals, colors))
    options = {"skip_materials": True} if kind == "glb" else {}  # beside a material, trimesh loses colours of vertices
    read = trimesh.load(tmp_path / f"ball.{kind}", process=False, force="mesh", **options)
    assert read.is_watertight
    assert read.volume == pytest.approx(4 / 3 * math.pi * 0.125, rel=0.02)
    np.testing.assert_allclose(np.sort(read.vertices, 0), np.sort(mesh.vertices.numpy(), 0), atol=1e-6)
    shown = colors.numpy()
    if kind == "glb":  # linear light, by the transfer function of sRGB
        shown = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(read.visual.vertex_colors[:, :3], 255 * shown, atol=1.01)
    np.testing.assert_allclose(read.vertex_normals, normals.numpy(), atol=0.01)  # PLY's and OBJ's are computed anew
    assert {"ply": b"property float nx", "obj": b"\nvn ", "glb": b'"NORMAL"'}[kind] in (
        tmp_path / f"ball.{kind}"
    ).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"ball.{kind}"]


@pytest.mark.parametrize("part", ["nothing", "colors", "texture"])
def test_colours_in_glb_files_are_not_lit_again(part: str, tmp_path: Path) -> None:
    """Photographs contain the light. A mesh without colours is lit, and not of metal, which is black without a sky."""
    mesh = sphere(0.5)
    texture = Texture(torch.zeros(4, 4, 3, dtype=torch.uint8), torch.rand(len(mesh.faces), 3, 2))
    given = {"nothing": {}, "colors": {"colors": torch.rand(len(mesh.vertices), 3)}, "texture": {"texture": texture}}
    write_mesh(tmp_path / "ball.glb", replace(mesh, **given[part]))
    described, attributes = read_glb(tmp_path / "ball.glb")
    assert described.get("extensionsUsed", []) == ([] if part == "nothing" else ["KHR_materials_unlit"])
    (material,) = described["materials"]
    assert list(material.get("extensions", {})) == described.get("extensionsUsed", [])
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert described["meshes"][0]["primitives"][0]["material"] == 0
    if part == "texture":
        u, v = texture.coordinates.reshape(-1, 2).T.numpy()
        np.testing.assert_allclose(attributes["TEXCOORD_0"], np.stack([u, 1 - v], -1), rtol=0, atol=1e-7)
        (sampler,) = described["samplers"]
        assert sampler["minFilter"] == 9729  # without mipmaps, which mix triangles


@pytest.mark.parametrize(("kind", "center"), [("ply", (2, 0, 0)), ("obj", (2, 0, 0)), ("glb", (0, 2, 0))])
def test_ns_export_turns_up_to_y_in_glb_files(kind: str, center: tuple[int, int, int], tmp_path: Path) -> None:
    """A ball is above the middle of the scene; the input has x up and twice the size."""
    up_is_x = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    mesh = sphere(0.5, (0, 0, 1))
    mesh = Mesh(mesh.vertices, mesh.faces, vertex_normals(mesh))
    _write(mesh, Placement(up_is_x, 0.5), tmp_path / f"ball.{kind}", 0.0)
    read = trimesh.load(tmp_path / f"ball.{kind}", process=False, force="mesh")
    np.testing.assert_allclose(np.mean(read.vertices, 0), center, atol=1e-5)
    assert read.volume == pytest.approx(4 / 3 * math.pi, rel=0.02)  # not turned inside out


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "ball.ply"
    file.write_bytes(b"before")
    monkeypatch.setattr("os.fsync", lambda number: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        write_mesh(file, sphere(1.0))
    assert file.read_bytes() == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]
