"""First Gaussians: as large as their neighbours are far, coloured as the nearest images show them."""

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.blender import Blender
from nerfloom.kernels.splats.project import DC
from nerfloom.splats import start
from nerfloom.splats.start import (
    first_points,
    from_points,
    hull_points,
    morton,
    neighbour_distance,
    scene_size,
    seen_colors,
    thinned,
)


@pytest.mark.medium
@pytest.mark.parametrize("count", [2, 3, 5, 500, 20_000])
def test_distances_to_neighbours(count: int) -> None:
    torch.manual_seed(count)
    points = torch.randn(count, 3) * torch.tensor([1.0, 3.0, 0.02])
    found = neighbour_distance(points)
    some = torch.randperm(count)[:500]
    apart = torch.cdist(points[some].double(), points.double())
    true = apart.topk(min(count, 4), largest=False).values[:, 1:].mean(1)
    assert bool((found[some] >= true * (1 - 1e-4)).all())
    assert float((found[some].double() / true).mean()) < 1.15


def test_one_point_and_equal_points_have_a_size() -> None:
    assert neighbour_distance(torch.zeros(1, 3)).tolist() == [1.0]
    assert bool(from_points(torch.zeros(9, 3), torch.zeros(9, 3), 0).log_scales.isfinite().all())


def test_morton_interleaves_bits() -> None:
    cells = torch.tensor([*itertools.product((0, 1, 5, 2**20 - 1), repeat=3)])
    for cell, code in zip(cells.tolist(), morton(cells).tolist(), strict=True):
        bits = [(cell[i % 3] >> (i // 3) & 1) << i for i in range(60)]
        assert code == sum(bits)


def test_too_many_points_are_thinned_evenly() -> None:
    """Points are in a scanner's order, a tenth of them in a corner: 1 in 20 of every part of space is kept."""
    torch.manual_seed(0)
    points = torch.cat([torch.rand(18_000, 3), 0.1 * torch.rand(2_000, 3) + 5]).sort(0).values
    assert thinned(points, 20_000) is points
    some = thinned(points, 1_000)
    assert len(some) == 1_000 == len(some.unique(dim=0))
    assert set(map(tuple, some.tolist())) <= set(map(tuple, points.tolist()))
    assert int((some > 3).all(-1).sum()) == pytest.approx(100, abs=3)
    near = torch.cdist(points[::50], some).min(1).values
    assert float(near.max()) < 0.5


def test_a_reconstruction_starts_no_more_gaussians_than_asked(
    shared_tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = replace(load_dataset(Blender().parse(shared_tiny, "train"), "train"), points=torch.rand(900, 3))
    assert len(first_points("points", dataset, 1_000)) == 900
    assert not capsys.readouterr().err
    assert len(first_points("points", dataset, 300)) == 300
    assert "300 of 900 points" in capsys.readouterr().err


def test_points_become_round_gaussians_of_their_colour() -> None:
    points, colors = torch.rand(50, 3), torch.rand(50, 3)
    gaussians = from_points(points, colors, degree=2, opacity=0.3)
    assert gaussians.degree == 2
    torch.testing.assert_close(0.5 + DC * gaussians.colors, colors)
    torch.testing.assert_close(torch.sigmoid(gaussians.logits), torch.full((50,), 0.3))
    assert torch.equal(gaussians.log_scales[:, 0], gaussians.log_scales[:, 2])
    assert float(gaussians.harmonics.abs().sum()) == 0


def test_colours_are_those_of_the_nearest_image(shared_tiny: Path) -> None:
    dataset = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    image, height = dataset.image(0), int(dataset.cameras.heights[0])
    opaque = (image[..., 3] == 255).nonzero()
    row, column = opaque[len(opaque) // 2].tolist()
    pixel = torch.tensor([row * int(dataset.cameras.widths[0]) + column])
    assert height > row
    rays = dataset.cameras.pixel_rays(pixel, 0.1, 10.0)
    just_before = rays.origins + 0.05 * rays.directions  # no other camera is as near
    found = seen_colors(just_before, dataset, views=1)[0]
    torch.testing.assert_close(found, image[row, column, :3].float() / 255)


def test_colours_are_means_over_the_nearest_images_that_show_a_point(
    shared_tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    monkeypatch.setattr(start, "PAIRS", 3 * len(dataset.cameras))  # distances in parts of three points
    points, views = torch.rand(40, 3) * 2 - 1, 2
    expected = []
    for point in points:
        away = (dataset.cameras.camera_to_worlds[:, :, 3].double() - point.double()).norm(dim=-1)
        colors = {}
        for index in away.argsort()[: 4 * views].tolist():
            column, row, front = (part[0] for part in dataset.cameras.project(point[None], index))
            column, row = round(float(column)), round(float(row))
            image = dataset.image(index)
            if (
                bool(front)
                and 0 <= row < image.shape[0]
                and 0 <= column < image.shape[1]
                and image[row, column, 3] > 127
            ):
                colors[index] = image[row, column, :3].double() / 255
        expected.append(colors)
    found = seen_colors(points, dataset, views)
    means = torch.cdist(points, dataset.cameras.camera_to_worlds[:, :, 3]).double().mean(0)
    for color, colors in zip(found, expected, strict=True):
        chosen = [colors[index] for index in sorted(colors, key=lambda i: float(means[i]))[:views]]
        wanted = torch.stack(chosen).mean(0) if chosen else torch.full((3,), 0.5, dtype=torch.float64)
        torch.testing.assert_close(color.double(), wanted, atol=1e-6, rtol=0)
    assert sum(map(bool, expected)) > 5


def test_what_no_image_shows_is_grey(shared_tiny: Path) -> None:
    dataset = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    assert seen_colors(torch.full((1, 3), 1e5), dataset).tolist() == [[0.5] * 3]


def test_points_on_a_hull_lie_in_its_outer_cells() -> None:
    n = 8
    cells = torch.zeros(n, n, n, dtype=torch.bool)
    cells[2:6, 2:6, 2:6] = True
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    points = hull_points(cells.flatten(), box, n, 500)
    at = ((points + 1) / 2 * n).long()
    assert bool(((at >= 2) & (at < 6)).all())
    assert bool(((at == 2) | (at == 5)).any(1).all())


@pytest.mark.parametrize(("focal", "width"), [(50.0, 1.0), (200.0, 1.0), (2_000.0, 0.1)])
def test_a_scene_is_as_large_as_images_show_it(focal: float, width: float, shared_tiny: Path) -> None:
    """A lens of 200 pixels for images of 100 is the longest that sees a scene as large as it is far."""
    dataset = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    size = torch.full_like(dataset.cameras.fx, 100)
    cameras = replace(dataset.cameras, fx=torch.full_like(size, focal), widths=size.long())
    distance = float(dataset.cameras.camera_to_worlds[0, :, 3].norm())
    found = scene_size(dataset.scene, torch.zeros(1, 3), cameras)
    assert found == pytest.approx(1.3 * width * distance, rel=1e-5)
    assert scene_size(dataset.scene, torch.zeros(1, 3)) == pytest.approx(1.3 * distance, rel=1e-5)
