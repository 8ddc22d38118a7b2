"""Textures: interpolation within a triangle, and files read back by trimesh."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.export.mesh import Mesh, vertex_normals
from nerfloom.export.mesh_files import write_mesh
from nerfloom.export.settings import MeshSettings
from nerfloom.export.texture import Atlas, painted

trimesh = pytest.importorskip("trimesh")


def ball(level: int = 2) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=level, radius=0.5)
    mesh = Mesh(torch.from_numpy(np.array(made.vertices)), torch.from_numpy(np.array(made.faces)).long())
    return replace(mesh, normals=vertex_normals(mesh))


def by_place(points: Tensor, normals: Tensor) -> Tensor:
    """A colour that is linear in the position, which interpolation must return."""
    return (points + 0.5).float()


def textured(mesh: Mesh, colors: Callable[[Tensor, Tensor], Tensor], size: int, seconds: float) -> Mesh:
    grey = torch.full((len(mesh.vertices), 3), 0.25)
    assert mesh.normals is not None
    texture = painted(mesh.vertices, mesh.normals, grey, mesh.faces, colors, size, seconds)
    return replace(mesh, colors=grey, texture=texture)


def looked_up(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate an image (S, S, C) at places (N, 2) from the left and the bottom, in [0, 1], as graphics cards do."""
    size = len(image)
    x, y = places[:, 0] * size - 0.5, (1 - places[:, 1]) * size - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros((len(places), image.shape[2]))
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - (x - left)) * np.abs(1 - j - (y - top))
            total += weight[:, None] * image[np.clip(top + j, 0, size - 1), np.clip(left + i, 0, size - 1)]
    return total


def random_weights(count: int) -> np.ndarray:
    return np.random.default_rng(0).dirichlet((0.4, 0.4, 0.4), count)  # many near edges and corners


@pytest.mark.parametrize(("size", "faces"), [(64, 1), (64, 2), (64, 7), (101, 200), (65, 338), (128, 1000)])
def test_interpolation_in_a_triangle_reads_no_texel_of_another(size: int, faces: int) -> None:
    atlas = Atlas(size, faces)
    atlas.check()
    places, owners, weights = atlas.texels(0, faces)
    assert len(places.unique()) == len(places)
    assert int(places.max()) < size**2
    assert owners.unique().tolist() == list(range(faces))
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(weights)).double())
    assert float(weights.min()) >= 0
    image = torch.full((size * size, 1), -1e9)
    image[places, 0] = owners.float()
    for face in range(0, faces, max(faces // 50, 1)):
        corners = atlas.coordinates()[face].numpy()
        found = looked_up(image.view(size, size, 1).numpy(), random_weights(200) @ corners)
        np.testing.assert_allclose(found, face, atol=1e-2)


def test_texels_of_some_faces_are_among_those_of_all() -> None:
    atlas = Atlas(128, 77)
    everything = atlas.texels(0, 77)
    parts = [atlas.texels(first, min(first + 10, 77)) for first in range(0, 77, 10)]
    for whole, pieces in zip(everything, zip(*parts, strict=True), strict=True):
        assert torch.equal(whole, torch.cat(pieces))


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_a_file_has_the_colours_of_the_surface(kind: str, tmp_path: Path) -> None:
    mesh = textured(ball(), by_place, 512, 60)
    write_mesh(tmp_path / f"ball.{kind}", mesh)
    expected = [f"ball.{kind}"] if kind == "glb" else ["ball.mtl", "ball.obj", "ball.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == expected
    read = trimesh.load(tmp_path / f"ball.{kind}", process=False, force="mesh")
    material = read.visual.material
    picture = material.image if kind == "obj" else material.baseColorTexture
    image = np.asarray(picture.convert("RGB")).astype(float)
    assert image.shape == (512, 512, 3)
    weights = random_weights(len(read.faces))[:, :, None]
    points = (weights * read.vertices[read.faces]).sum(1)
    places = (weights * read.visual.uv[read.faces]).sum(1)
    np.testing.assert_allclose(looked_up(image, places) / 255, points + 0.5, atol=0.004)
    assert len(read.faces) == len(mesh.faces)
    assert read.volume == pytest.approx(0.5, rel=0.05)


def test_texels_without_a_colour_have_that_of_the_vertices() -> None:
    def half(points: Tensor, normals: Tensor) -> Tensor:
        torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)))
        return torch.where(points[:, :1] > 0, torch.ones(len(points), 3), torch.nan)

    mesh = textured(ball(), half, 256, 60)
    assert mesh.texture is not None
    middles = mesh.vertices[mesh.faces].mean(1)[:, 0]
    places = mesh.texture.coordinates.mean(1).numpy()
    found = looked_up(mesh.texture.image.numpy().astype(float), places)[:, 0]
    far = (middles.abs() > 0.1).numpy()
    np.testing.assert_allclose(found[far], np.where(middles.numpy() > 0, 255, 64)[far], atol=1)


def test_the_time_limit_is_kept_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    def never(points: Tensor, normals: Tensor) -> Tensor:
        raise AssertionError("there was no time for this")

    mesh = textured(ball(), never, 256, 1e-9)
    assert mesh.texture is not None
    assert "320 of 320 faces" in capsys.readouterr().err
    found = looked_up(mesh.texture.image.numpy().astype(float), mesh.texture.coordinates.mean(1).numpy())
    np.testing.assert_allclose(found, 64, atol=1)


def test_an_image_that_is_too_small_is_refused_with_what_would_do() -> None:
    with pytest.raises(ConfigError, match="--texture-size 115 or --target-num-faces 800"):
        Atlas(100, 1000).check()
    Atlas(115, 1000).check()
    Atlas(100, 800).check()


@pytest.mark.parametrize(("size", "seconds"), [(63, 1.0), (16_385, 1.0), (64, 0.0), (64, float("nan"))])
def test_sizes_and_times_out_of_range_are_refused(size: int, seconds: float) -> None:
    with pytest.raises(ConfigError, match="--texture-s"):
        MeshSettings(texture_size=size, texture_seconds=seconds).check_ranges()
