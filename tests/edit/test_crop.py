"""Crops of clouds with a known inside and outside."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom import edit
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.outline import outlined
from nerfloom.edit.edited import Edited
from nerfloom.geometry.regions import (
    Box,
    Polygon,
    Region,
    Sphere,
    bounds_of_all,
    inside_all,
    inside_polygon,
    read_regions,
    write_regions,
)
from nerfloom.splats.files import write_gaussians
from nerfloom.training.load import load
from tests.dataparsers.captures import HEIGHT, POINTS, WIDTH, poses, seen_at, write_capture
from tests.edit.clouds import at, scattered


def test_a_box_keeps_what_numpy_finds_in_it() -> None:
    edited = scattered()
    low, high = (-0.5, -1.0, 0.0), (1.0, 0.3, 2.0)
    means = edited.gaussians.means.numpy()
    truth = np.all((means >= low) & (means <= high), axis=1)
    assert 0 < truth.sum() < len(truth)
    np.testing.assert_array_equal(edit.crop_box(edited, low, high).gaussians.means, means[truth])
    np.testing.assert_array_equal(edit.crop_box(edited, low, high, keep=False).gaussians.means, means[~truth])


def test_a_sphere_keeps_what_numpy_finds_in_it() -> None:
    edited, center = scattered(), (0.3, -0.2, 0.5)
    means = edited.gaussians.means.numpy()
    truth = np.linalg.norm(means - center, axis=1) <= 1.2
    assert 0 < truth.sum() < len(truth)
    np.testing.assert_array_equal(edit.crop_sphere(edited, center, 1.2).gaussians.means, means[truth])
    np.testing.assert_array_equal(edit.crop_sphere(edited, center, 1.2, False).gaussians.means, means[~truth])


def test_every_column_of_a_gaussian_stays_with_it() -> None:
    edited = scattered(terms=8)
    kept = edit.crop_box(edited, (-9, -9, 0), (9, 9, 9)).gaussians
    index = (edited.gaussians.means[:, 2] >= 0).nonzero()[:, 0]
    for name, values in edited.gaussians.columns.items():
        assert torch.equal(kept.columns[name], values[index]), name


def test_regions_of_files(tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text('{"box": {"low": [-1, -2, -3], "high": [1, 2, 3.5]}}')
    (tmp_path / "ball.yml").write_text("sphere:\n  center: [0, 1e-3, 1]\n  radius: 2\n")
    (box,), (ball,) = read_regions(tmp_path / "box.json"), read_regions(tmp_path / "ball.yml")
    assert box == Box((-1.0, -2.0, -3.0), (1.0, 2.0, 3.5))
    assert ball == Sphere((0.0, 1e-3, 1.0), 2.0)
    edited = scattered()
    found = edit.crop_region(edited, tmp_path / "ball.yml").gaussians.means
    assert torch.equal(found, edit.crop_sphere(edited, (0.0, 1e-3, 1.0), 2.0).gaussians.means)
    points = torch.tensor([[0.0, 0, 0], [0, 0, 3.4], [2, 0, 1]])
    assert inside_all(points, [box, ball]).tolist() == [True, False, False]
    assert inside_all(points, []).all()
    with pytest.raises(ConfigError, match="nothing is in the region"):
        inside_all(points + 100, [box])
    write_regions(tmp_path / "both.yml", [box, ball])
    assert read_regions(tmp_path / "both.yml") == [box, ball]
    in_both = inside_all(edited.gaussians.means, [box, ball])
    for keep in (True, False):
        kept = edit.crop_region(edited, tmp_path / "both.yml", keep)
        assert torch.equal(kept.gaussians.means, edited.gaussians.means[in_both == keep])


ROTATION = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
"""A rotation matrix of fractions; its rows are unit vectors at right angles."""
TRIANGLE = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


def test_a_turned_box_keeps_what_numpy_finds_in_it() -> None:
    low, high = (-0.5, -1.0, 0.0), (1.0, 0.3, 2.0)
    means = scattered().gaussians.means.double()
    along = means.numpy() @ np.array(ROTATION).T
    truth = np.all((along >= low) & (along <= high), axis=1)
    assert 0 < truth.sum() < len(truth)
    np.testing.assert_array_equal(Box(low, high, ROTATION).contains(means), truth)


def test_a_box_moves_with_what_is_in_it() -> None:
    box = Box((-0.5, -1.0, 0.0), (1.0, 0.3, 2.0), ROTATION)
    points = scattered().gaussians.means.double()
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double() @ torch.tensor(ROTATION, dtype=torch.float64)
    shift = torch.tensor([3.0, -20.0, 0.7], dtype=torch.float64)
    moved = box.moved(turn, 2.5, shift)
    assert torch.equal(moved.contains(2.5 * points @ turn.T + shift), box.contains(points))
    back = moved.moved(turn.T, 1 / 2.5, -(turn.T @ shift) / 2.5)
    np.testing.assert_allclose([back.low, back.high], [box.low, box.high], atol=1e-12)
    np.testing.assert_allclose(back.axes, box.axes, atol=1e-12)


@pytest.mark.parametrize(
    "region",
    [
        Box((-1.0, -2.0, 1e-7), (1.0, 2.0, 3.5)),
        Box((-1.0, -2.0, -3.0), (1.0, 2.0, 1e7), ROTATION),
        Sphere((0.1, 0.2, 0.3), 1 / 3),
        Polygon((1e6, 0.1, 2.0), ROTATION, ((0.1, 1 / 3), (-1e-7, 0.0), (2.0, -1.0), (0.5, 0.5))),
        Polygon((0.0, 0.0, 0.0), ROTATION, TRIANGLE, False, "fisheye", (0.1, -0.02, 1e-9, 0.0)),
    ],
)
def test_a_written_region_is_read_as_the_same_one(region: Region, tmp_path: Path) -> None:
    write_regions(tmp_path / "r.yml", [region])
    assert read_regions(tmp_path / "r.yml") == [region]
    text = (tmp_path / "r.yml").read_text()
    assert ("axes" in text) == (getattr(region, "axes", None) == ROTATION)
    assert ("lens" in text) == ("keep" in text) == ("model: fisheye" in text)


@pytest.mark.parametrize(
    "text",
    [
        *("[]", "box: 3", "box: {low: [0, 0, 0]}", "cube: {}", "box: {low: [0, 0, 0], high: [1, 1, 0]}"),
        *("sphere: {center: [0, 0], radius: 1}", "sphere: {center: [0, 0, 0], radius: -1}", "{"),
        *("sphere: {center: [0, 0, .nan], radius: 1}", "sphere: {center: [0, 0, 0], radius: 1, side: 2}"),
        "sphere: {center: [0, 0, 0], radius: 1}\nbox: {low: [0, 0, 0], high: [1, 1, 1]}",
        *("regions:", "regions: []", "regions: 3", "regions: [box]", "regions: [sphere: {center: [0, 0, 0]}]"),
        "regions: [{sphere: {center: [0, 0, 0], radius: 1}, box: {low: [0, 0, 0], high: [1, 1, 1]}}]",
        "regions: [sphere: {center: [0, 0, 0], radius: 1}, regions: []]",
        "regions: [sphere: {center: [0, 0, 0], radius: 1}]\nsphere: {center: [0, 0, 0], radius: 1}",
        "polygon: {position: [0, 0, 0], corners: [[0, 0], [1, 0], [0, 1]]}",
        *(
            f"polygon: {{position: [0, 0, 0], axes: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], corners: {rest}}}"
            for rest in (
                *("[[0, 0], [1, 0]]", "[[0, 0], [1, 0], [0, .inf]]", "[[0, 0], [1, 0], [0, 1, 2]]", "3"),
                *(f"[[0, 0], [1, 0], [0, 1]], {more}" for more in ("model: mirror", "lens: [0.1]", "keep: 3")),
                "[[0, 0], [1, 0], [0, 1]], model: opencv, lens: [1, 2]",
            )
        ),
        "box: {low: [0, 0, 0], high: [1, 1, 1], axes: [[1, 0, 0], [0, 1, 0]]}",
        "box: {low: [0, 0, 0], high: [1, 1, 1], axes: [[1, 0, 0], [0, 1, 0], [0, 0.1, 1]]}",
        "box: {low: [0, 0, 0], high: [1, 1, 1], axes: [[1, 0, 0], [0, 1, 0], [0, 0, 1e200]]}",
    ],
)
def test_files_that_hold_no_region_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "r.yml").write_text(text)
    with pytest.raises(ConfigError) as error:
        read_regions(tmp_path / "r.yml")
    assert "\n" not in str(error.value)


REGIONS: list[Region] = [
    Box((-0.5, -1.0, 0.0), (1.0, 0.3, 2.0)),
    Box((-0.5, -1.0, 0.0), (1.0, 0.3, 2.0), ((0.6, 0.8, 0.0), (-0.8, 0.6, 0.0), (0.0, 0.0, 1.0))),
    Sphere((0.3, -0.2, 0.5), 1.2),
]


@pytest.mark.parametrize("region", REGIONS, ids=["box", "turned", "sphere"])
def test_bounds_hold_a_region_and_are_tight(region: Region) -> None:
    random = torch.Generator().manual_seed(0)
    points = 6 * torch.rand(400_000, 3, generator=random, dtype=torch.float64) - 3
    inside = points[region.contains(points)]
    low, high = torch.tensor(region.bounds(), dtype=torch.float64)
    assert ((inside >= low) & (inside <= high)).all()
    assert float((inside.amin(0) - low).max()) < 0.15
    assert float((high - inside.amax(0)).max()) < 0.15


@pytest.mark.parametrize("region", REGIONS, ids=["box", "turned", "sphere"])
def test_a_grown_region_holds_what_is_near_and_a_moved_one_what_moved(region: Region) -> None:
    random = torch.Generator().manual_seed(1)
    points = 6 * torch.rand(20_000, 3, generator=random, dtype=torch.float64) - 3
    inside, offset = points[region.contains(points)], torch.randn(3, generator=random, dtype=torch.float64)
    near = inside + 0.1 * offset / offset.norm()
    assert not region.contains(near).all()
    assert region.grown(0.1 + 1e-9).contains(near).all()
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0]]).double())
    moved = region.grown(1e-9).moved(turn, 2.5, offset)
    assert torch.equal(moved.contains(2.5 * points @ turn.T + offset), region.contains(points))


def test_regions_apart_have_no_bounds() -> None:
    with pytest.raises(ConfigError, match="nothing is in all"):
        bounds_of_all([Sphere((0.0, 0.0, 0.0), 1.0), Box((2.0, -1.0, -1.0), (3.0, 1.0, 1.0))])
    view = Polygon((0.0, 0.0, 0.0), ROTATION, TRIANGLE)
    both = [Sphere((0.0, 0.0, 0.0), 1.0), Box((0.5, -9.0, -9.0), (9.0, 0.5, 9.0))]
    assert bounds_of_all(both) == bounds_of_all([view, *both]) == ((0.5, -1.0, -1.0), (1.0, 0.5, 1.0))
    assert bounds_of_all([view]) is bounds_of_all([]) is None


L_SHAPE = ((-0.3, -0.2), (0.5, -0.2), (0.5, 0.1), (0.0, 0.1), (0.0, 0.4), (-0.3, 0.4))
"""A polygon on the image plane: the union of two rectangles."""


def in_l_shape(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    upper, left = (x > -0.3) & (x < 0.5) & (y < 0.1), (x > -0.3) & (x < 0.0) & (y < 0.4)
    return np.asarray((upper | left) & (y > -0.2))


def test_a_polygon_holds_what_its_view_shows_in_it() -> None:
    """By perspective in NumPy; what is behind the camera is outside, and so are its mirrored positions."""
    position, means = np.array([0.4, -0.3, 1.0]), scattered(4000).gaussians.means
    right, up, back = ((means.numpy() - position) @ np.array(ROTATION).T).T
    with np.errstate(divide="ignore"):
        truth = (back < 0) & in_l_shape(right / -back, -up / -back)
    mirrored = (back > 0) & in_l_shape(right / -back, -up / -back)
    assert 50 < truth.sum() < 2000
    assert mirrored.sum() > 10
    polygon = Polygon((0.4, -0.3, 1.0), ROTATION, L_SHAPE)
    np.testing.assert_array_equal(polygon.contains(means), truth)
    np.testing.assert_array_equal(dataclasses.replace(polygon, keep=False).contains(means), ~truth)
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double() @ torch.tensor(ROTATION, dtype=torch.float64)
    shift = torch.tensor([3.0, -20.0, 0.7], dtype=torch.float64)
    moved = polygon.moved(turn, 2.5, shift)
    np.testing.assert_array_equal(moved.contains(2.5 * means @ turn.T + shift), truth)
    assert polygon.corners == moved.corners


CAMERAS = {
    "pinhole": (60.0, None),
    "opencv": (60.0, [-0.25, 0.08, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "fisheye": (40.0, [-0.02, 4e-3, 0.0, 0.0]),
    "equirectangular": (20.0, None),
    "orthographic": (30.0, None),
}
"""Focal length and distortion of each model."""


@pytest.mark.parametrize("model", CAMERAS)
def test_an_outline_holds_the_points_of_the_pixels_inside(model: str) -> None:
    """Points on rays of pixels, with each lens, before and after a move; the rays have an independent test."""
    focal, lens = CAMERAS[model]
    pose = torch.cat([torch.tensor(ROTATION).T, torch.tensor([[0.3], [-2.0], [0.5]])], 1)[None]
    one = torch.ones(1)
    camera = Cameras(
        *(pose, focal * one, focal * one, 40 * one, 30 * one, 80 * one.long(), 60 * one.long(), model),
        lens=None if lens is None else torch.tensor([lens]),
    ).in_float64()
    columns, rows = (values.flatten().double() for values in torch.meshgrid(
        torch.arange(80), torch.arange(60), indexing="xy"
    ))  # fmt: skip
    rays = camera.rays(torch.zeros(len(rows), dtype=torch.int64), columns, rows, 0.0, 10.0)
    distances = 0.5 + 4 * torch.rand(len(rows), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = rays.origins + distances * rays.directions
    corners = tuple((40.25 + 50 * x, 30.25 + 50 * y) for x, y in L_SHAPE)
    truth = torch.from_numpy(in_l_shape((columns.numpy() - 40.25) / 50, (rows.numpy() - 30.25) / 50))
    region = outlined(camera, corners)
    assert 300 < truth.sum() < 1500
    assert torch.equal(region.contains(points), truth)
    turn, shift = torch.tensor(ROTATION, dtype=torch.float64), torch.tensor([3.0, -20.0, 0.7], dtype=torch.float64)
    assert torch.equal(region.moved(turn, 2.5, shift).contains(2.5 * points @ turn.T + shift), truth)
    if model != "equirectangular":  # no other camera sees what is behind it
        behind = rays.origins - distances * rays.directions
        assert not region.contains(behind).any()
        assert outlined(camera, corners, keep=False).contains(behind).all()


def test_rays_cross_a_polygon_where_they_enter_and_leave_it() -> None:
    """Between two crossings, points of a ray are all inside or all outside."""
    random, polygon = torch.Generator().manual_seed(3), Polygon((0.4, -0.3, 1.0), ROTATION, L_SHAPE)
    origins, directions = torch.randn(2, 300, 3, generator=random, dtype=torch.float64)
    found = polygon.crossings(origins, directions)
    assert found.shape == (300, 7)
    ends = torch.cat([found, torch.tensor([[-30.0, 30.0]]).double().expand(300, 2)], 1).clamp(-30, 30).sort(1).values
    steps = torch.linspace(0.01, 0.99, 9, dtype=torch.float64)
    t = ends[:, :-1, None] + (ends[:, 1:] - ends[:, :-1])[..., None] * steps
    inside = polygon.contains((origins[:, None, None] + t[..., None] * directions[:, None, None]).view(-1, 3))
    inside = inside.view(t.shape)[(ends[:, 1:] - ends[:, :-1]) > 1e-6]
    assert torch.equal(inside, inside[:, :1].expand(-1, 9))
    assert 100 < inside[:, 0].sum() < len(inside) - 100


def test_inside_of_a_polygon() -> None:
    """The inside of an L is the union of two rectangles, by brute force on a lattice of no corner's coordinates."""
    corners = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))
    rows, columns = torch.meshgrid(torch.arange(-1.05, 5, 0.2), torch.arange(-1.05, 5, 0.2), indexing="ij")
    x, y = columns.flatten().double(), rows.flatten().double()
    truth = ((x > 0) & (x < 4) & (y > 0) & (y < 1)) | ((x > 0) & (x < 1) & (y > 0) & (y < 3))
    assert torch.equal(inside_polygon(x, y, corners), truth)
    assert torch.equal(inside_polygon(x, y, corners[::-1]), truth)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Edited:
    """Four Gaussians at the known points of a capture, with its photographs."""
    folder = tmp_path_factory.mktemp("seen")
    data = write_capture(folder / "capture")
    write_gaussians(folder / "four.ply", at(torch.from_numpy(POINTS)).map(torch.Tensor.float))
    return Edited.of(load(folder / "four.ply", data=data))


def pixels(image: int) -> np.ndarray:
    """Columns and rows (4, 2) of the points in a photograph; (0, 0) is the centre of the top left pixel."""
    return np.array([seen_at(poses()[image], point) for point in POINTS]) - 0.5


def test_a_polygon_around_a_point_of_a_photograph_selects_it(seen: Edited) -> None:
    """After the Gaussians have been moved and turned, too."""
    (column, row), *others = pixels(2)
    reach = 0.4 * min(np.linalg.norm(other - (column, row)) for other in others)
    around = tuple((column + reach * dx, row + reach * dy) for dx, dy in ((-1, 0), (0, -1), (1, 0), (0, 1)))
    moved = edit.scale(edit.rotate(edit.move(seen, (1.0, 2.0, 3.0)), (1.0, 1.0, 0.0), 70.0), 2.5)
    for given in (seen, moved):
        kept = edit.crop_polygon(given, "002.png", around)
        assert torch.equal(kept.gaussians.means, given.gaussians.means[:1])
        removed = edit.crop_polygon(given, "002.png", around, keep=False)
        assert torch.equal(removed.gaussians.means, given.gaussians.means[1:])


def test_a_mask_of_a_photograph_selects_what_is_white(seen: Edited, tmp_path: Path) -> None:
    at_pixels = pixels(4).round().astype(int)
    white = np.zeros((HEIGHT, WIDTH), np.uint8)
    white[at_pixels[1, 1], at_pixels[1, 0]] = 255
    white[at_pixels[3, 1], at_pixels[3, 0]] = 255
    Image.fromarray(white).save(tmp_path / "mask.png")
    truth = torch.tensor([bool(white[row, column]) for column, row in at_pixels])
    assert truth[1]
    assert truth[3]
    kept = edit.crop_mask(seen, "004.png", tmp_path / "mask.png").gaussians
    assert torch.equal(kept.means, seen.gaussians.means[truth])


def test_what_cannot_be_cropped(seen: Edited, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no photograph is named 02\.png"):
        edit.crop_polygon(seen, "02.png", ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    with pytest.raises(ConfigError, match="3 corners"):
        edit.crop_polygon(seen, "002.png", ((0.0, 0.0), (1.0, 0.0)))
    with pytest.raises(ConfigError, match="--data DIR"):
        edit.crop_polygon(scattered(), "002.png", ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    Image.new("L", (7, 9)).save(tmp_path / "odd.png")
    with pytest.raises(DataError, match="integer multiple"):
        edit.crop_mask(seen, "002.png", tmp_path / "odd.png")
    with pytest.raises(ConfigError, match="is empty"):
        edit.crop_box(seen, (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
