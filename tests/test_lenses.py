"""Lenses against closed forms, autograd, brute force and themselves turned round."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.geometry.lenses import LENSES, Distortion, distort, panorama, project, undistort, unproject
from tests.kernels.compiled import needs_kernels

GOPRO = [-0.23, 0.04, 1.2e-3, -8e-4, 6e-3, 0.02, -0.01, 1e-3, 5e-4]
"""A wide opencv lens, all nine coefficients."""
FISHEYE = [-0.02, 6e-3, -2e-3, 2e-4]
WIDTH, HEIGHT = 96, 64


def cameras(model: str, lens: list[float] | None = None, count: int = 2, dtype: torch.dtype = torch.float32) -> Cameras:
    """Turned and moved cameras; a horizontal field of view of about 90 degrees, 150 for fisheye."""
    generator = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    turn[:, :, 0] *= torch.linalg.det(turn)[:, None]
    poses = torch.cat([turn, torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)], dim=-1)
    numbers = {
        "fisheye": (36.0, 37.0, WIDTH / 2 + 1, HEIGHT / 2 - 2),
        "equirectangular": panorama(WIDTH, HEIGHT),
        "orthographic": (12.0, 13.0, WIDTH / 2, HEIGHT / 2 + 3),
    }.get(model, (48.0, 49.0, WIDTH / 2 + 1, HEIGHT / 2 - 2))
    fx, fy, cx, cy = (torch.full((count,), value, dtype=dtype) for value in numbers)
    sizes = torch.full((count,), WIDTH), torch.full((count,), HEIGHT)
    coefficients = None if lens is None else torch.tensor([lens] * count, dtype=dtype)
    return Cameras(poses.to(dtype), fx, fy, cx, cy, *sizes, model, coefficients)


ALL = [
    ("pinhole", None),
    ("opencv", None),
    ("opencv", GOPRO),
    ("fisheye", None),
    ("fisheye", FISHEYE),
    ("equirectangular", None),
    ("orthographic", None),
]


def at(camera: Cameras, column: float, row: float) -> tuple[list[float], list[float]]:
    """Origin and direction of the first camera's ray at a place counted from the image's corner, in its frame."""
    camera = replace(camera, camera_to_worlds=torch.eye(4)[None, :3].to(camera.fx).repeat(len(camera), 1, 1))
    columns, rows = (torch.tensor([place], dtype=camera.fx.dtype) - 0.5 for place in (column, row))
    rays = camera.rays(torch.tensor([0]), columns, rows, 0, 1)
    return rays.origins[0].tolist(), rays.directions[0].tolist()


def test_opencv_by_hand() -> None:
    """A ray of tangents (0.3, -0.4), r^2 = 0.25, put through OpenCV's formula term by term."""
    k1, k2, p1, p2, k3, k4, k5, k6, k7 = lens = [0.1, -0.2, 0.01, 0.02, 0.3, 0.05, -0.04, 0.02, 0.5]
    x, y, q = 0.3, -0.4, 0.25
    radial = (1 + k1 * q + k2 * q**2 + k3 * q**3 + k7 * q**4) / (1 + k4 * q + k5 * q**2 + k6 * q**3)
    u = x * radial + 2 * p1 * x * y + p2 * (q + 2 * x * x)
    v = y * radial + p1 * (q + 2 * y * y) + 2 * p2 * x * y
    camera = cameras("opencv", lens, dtype=torch.float64)
    _, direction = at(camera, float(camera.cx[0]) + 48 * u, float(camera.cy[0]) + 49 * v)
    expected = torch.nn.functional.normalize(torch.tensor([x, -y, -1.0], dtype=torch.float64), dim=0).tolist()
    assert direction == pytest.approx(expected, abs=1e-9)


def test_fisheye_by_hand() -> None:
    """Without coefficients pixels from the centre are radians; with them the angle's polynomial. Beyond 90 degrees."""
    for lens in ([0.0] * 4, FISHEYE):
        angle, k = 1.9, lens
        bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
        camera = cameras("fisheye", lens, dtype=torch.float64)
        _, direction = at(camera, float(camera.cx[0]) + 36 * bent * 0.6, float(camera.cy[0]) + 37 * bent * 0.8)
        expected = [math.sin(angle) * 0.6, -math.sin(angle) * 0.8, -math.cos(angle)]
        assert direction == pytest.approx(expected, abs=1e-9)
        assert direction[2] > 0  # behind the camera


def test_panorama_by_hand() -> None:
    camera = cameras("equirectangular")
    for place, expected in (
        ((0.5, 0.5), (0, 0, -1)),
        ((0.75, 0.5), (1, 0, 0)),
        ((0.25, 0.5), (-1, 0, 0)),
        ((1.0, 0.5), (0, 0, 1)),
        ((0.5, 0.0), (0, 1, 0)),
        ((0.3, 1.0), (0, -1, 0)),
        ((0.625, 0.25), (0.5, 0.5**0.5, -0.5)),
    ):
        _, direction = at(camera, place[0] * WIDTH, place[1] * HEIGHT)
        assert direction == pytest.approx(expected, abs=1e-6)


def test_orthographic_by_hand() -> None:
    origin, direction = at(cameras("orthographic"), WIDTH / 2 + 24, HEIGHT / 2 + 3 + 26)
    assert origin == pytest.approx([2, -2, 0])
    assert direction == [0, 0, -1]


@pytest.mark.parametrize(("model", "lens"), ALL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_rays_are_seen_where_the_rays_start(model: str, lens: list[float] | None, dtype: torch.dtype) -> None:
    """Every pixel of the image, its outermost corners too."""
    camera = cameras(model, lens, dtype=dtype)
    columns, rows = torch.meshgrid(torch.arange(WIDTH), torch.arange(HEIGHT), indexing="xy")
    edges = torch.tensor([[-0.49, -0.49], [WIDTH - 0.51, HEIGHT - 0.51]], dtype=dtype)
    columns = torch.cat([columns.reshape(-1).to(dtype), edges[:, 0], edges[:, 0]])
    rows = torch.cat([rows.reshape(-1).to(dtype), edges[:, 1], edges[:, 1].flip(0)])
    indices = torch.arange(len(columns)) % 2
    rays = camera.rays(indices, columns, rows, 0, 1)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones_like(columns))
    distance = torch.linspace(0.5, 20, len(columns), dtype=dtype)
    found_columns, found_rows, in_front = camera.project(rays.origins + distance[:, None] * rays.directions, indices)
    off = found_columns - columns
    if model == "equirectangular":  # columns are close together at the poles
        off = off * ((rows + 0.5) * math.pi / HEIGHT).sin()
    error = torch.maximum(off.abs(), (found_rows - rows).abs()).max().item()
    print(f"{model}{' with a lens' if lens else ''}, {dtype}: a ray's points are seen within {error:.1e} pixels of it")
    assert in_front.all()
    assert error < (1e-3 if dtype is torch.float32 else 1e-7)


def test_one_camera_by_its_number() -> None:
    camera = cameras("opencv", GOPRO)
    points = torch.randn(20, 3)
    one = camera.project(points, 1)
    for a, b in zip(one, camera.project(points, torch.ones(20, dtype=torch.long)), strict=True):
        torch.testing.assert_close(a, b)
    assert one[2].any()
    assert not one[2].all()


@pytest.mark.parametrize(("model", "lens"), ALL)
def test_what_is_not_seen_is_told_and_finite(model: str, lens: list[float] | None) -> None:
    camera = cameras(model, lens, count=1)
    camera = replace(camera, camera_to_worlds=torch.eye(4)[None, :3])
    points = torch.tensor([[0.0, 0, 1], [0.1, 0.2, 3], [0, 0, 0], [0, 0, -2]])
    columns, rows, in_front = camera.project(points, 0)
    assert columns.isfinite().all()
    assert rows.isfinite().all()
    behind = model in ("equirectangular", "fisheye")  # at 176 degrees; at 180 a fisheye has a circle, not a position
    assert in_front.tolist() == [model == "equirectangular", behind, False, True]


@pytest.mark.parametrize(("model", "lens"), ALL)
def test_positions_of_points_have_gradients(model: str, lens: list[float] | None) -> None:
    """Also of a point on the axis, where the angle to it has none, and beyond the reach, by finite differences."""
    distortion = cameras(model, lens, count=1, dtype=torch.float64).distortion
    points = torch.tensor([[0.3, -0.2, -1.5], [0, 0, -2], [-0.5, 0.4, -1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda local: project(model, local, distortion)[:2], points)
    x, _, seen = project(model, points, distortion)
    assert seen.all()
    (slope,) = torch.autograd.grad(x[1], points)
    assert slope[1].tolist() == pytest.approx([1 if model == "orthographic" else 0.5, 0, 0], abs=1e-12)
    edge = torch.tensor([[30.0, 20.0, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda local: project(model, local, distortion)[:2], edge)


def lenses(count: int) -> Tensor:
    """Random opencv lenses in float64, from mild to absurd."""
    generator = torch.Generator().manual_seed(1)
    spread = torch.tensor([0.3, 0.2, 0.02, 0.02, 0.1, 0.2, 0.1, 0.05, 0.05], dtype=torch.float64)
    strength = torch.logspace(-2, 0.7, count, dtype=torch.float64)[:, None]
    return torch.randn(count, 9, generator=generator, dtype=torch.float64) * spread * strength


def test_the_jacobian_is_autograds() -> None:
    coefficients = lenses(50)
    x, y = torch.randn(2, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 0.4
    x.requires_grad_()
    y.requires_grad_()
    u, v, (uu, uv, vv) = distort(x, y, coefficients)
    ux, uy = torch.autograd.grad(u.sum(), (x, y), retain_graph=True)
    vx, vy = torch.autograd.grad(v.sum(), (x, y))
    for found, expected in ((uu, ux), (uv, uy), (uv, vx), (vv, vy)):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "lens", "reach"),
    [
        ("opencv", {"k1": -0.5}, (2 / 3) ** 0.5),  # r - r^3 / 2 turns where 1 = 1.5 r^2
        ("opencv", {"k4": -1.0}, 0.99**0.5),  # next to the denominator's zero, which is at 1
        ("opencv", {"k1": 0.5}, math.tan(math.radians(89.9))),
        ("opencv", {"p1": 0.03, "p2": 0.04}, 1 / 0.3),  # 1 = 6 |p| r
        ("fisheye", {"k1": -0.1}, (1 / 0.3) ** 0.5),
        ("fisheye", {}, math.pi),
    ],
)
def test_how_far_a_lens_reaches(model: str, lens: dict[str, float], reach: float) -> None:
    values = torch.tensor([[lens.get(name, 0.0) for name in LENSES[model]]], dtype=torch.float64)
    assert Distortion.of(model, values).reach.item() == pytest.approx(reach, rel=1e-9)


def test_newton_finds_the_one_root_of_any_lens() -> None:
    """Points anywhere on the disk, almost to its edge, bent and straightened; the disk's image holds no other root."""
    coefficients = lenses(400)
    every = Distortion.of("opencv", coefficients)
    generator = torch.Generator().manual_seed(3)
    angle = torch.rand(400, 50, generator=generator, dtype=torch.float64) * 2 * math.pi
    share = torch.linspace(0, 0.9999, 50, dtype=torch.float64)
    radius = share * every.reach.clamp(max=3)[:, None]
    x, y = (radius * angle.cos()).reshape(-1), (radius * angle.sin()).reshape(-1)
    index = torch.arange(400).repeat_interleave(50)
    u, v, _ = distort(x, y, coefficients[index])
    found_x, found_y, found = undistort(u, v, every[index])
    again_u, again_v, (uu, uv, vv) = distort(found_x, found_y, coefficients[index])
    places = torch.hypot(again_u - u, again_v - v) / (1 + torch.hypot(u, v))
    points = torch.hypot(found_x - x, found_y - y)
    inner = (share < 0.99).repeat(400)  # at the edge the Jacobian vanishes: places 1e-9 apart are points 1e-4 apart
    print(f"straightened: {int((~found).sum())} of {len(found)} not found, places off by {places.max():.1e}, ", end="")
    print(f"points by {points[inner].max():.1e}, next to the edge by {points.max():.1e}")
    assert found.all()
    assert places.max() < 1.1e-9
    assert points[inner].max() < 1e-6
    assert points.max() < 1e-4
    assert ((uu > 0) & (uu * vv > uv * uv)).all()


def test_beyond_the_turning_point_there_is_no_ray() -> None:
    """k1 = -0.5: r - r^3 / 2 has its maximum at sqrt(2/3). Every place has a wrong root beyond it."""
    lens = [-0.5] + [0.0] * 8
    edge = (2 / 3) ** 0.5 * (1 - 1 / 3)
    distance = torch.linspace(0, 1.5, 3001, dtype=torch.float64)
    distance = distance[(distance - edge).abs() > 1e-6]
    angle = torch.arange(len(distance)).double()
    x, y = distance * angle.cos(), distance * angle.sin()
    index = torch.zeros(len(x), dtype=torch.long)
    seen = unproject("opencv", x, y, Distortion.of("opencv", torch.tensor([lens], dtype=torch.float64))[index])
    assert torch.equal(seen.valid, distance < edge)
    assert seen.directions.isfinite().all()
    assert seen.spread.isfinite().all()
    torch.testing.assert_close(seen.directions.norm(dim=-1), torch.ones_like(x))
    tangent = seen.directions[:, :2].norm(dim=-1) / -seen.directions[:, 2]
    assert tangent.max() <= (2 / 3) ** 0.5 + 1e-9  # the root nearest the axis, nowhere another


@needs_kernels
@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("opencv", None),
        ("opencv", GOPRO),
        ("opencv", [-0.5] + [0.0] * 8),
        ("opencv", [-0.3, 0.0, 0.01, -0.02] + [0.0] * 5),
        ("fisheye", None),
        ("fisheye", FISHEYE),
        ("fisheye", [-0.3, 0.0, 0.0, 0.0]),
    ],
)
@pytest.mark.parametrize("count", [1, 4])
def test_compiled_rays_are_those_of_torch(model: str, lens: list[float] | None, count: int) -> None:
    """Some lenses do not reach the corners."""
    camera = cameras(model, lens)
    if lens is not None:  # two lenses that differ
        camera = replace(camera, lens=torch.tensor([lens, [0.9 * value for value in lens]]))
    flat = torch.arange(2 * WIDTH * HEIGHT)
    one = camera.pixel_rays(flat, 0.1, 9.0, None, subpixels(count))
    two = camera.pixel_rays_reference(flat, 0.1, 9.0, None, subpixels(count))
    assert one.pixel_radii is not None
    error = (one.directions - two.directions).abs().max().item()
    print(f"{model} {lens}: compiled directions off by {error:.1e}")
    for name, value in vars(two).items():
        if isinstance(value, torch.Tensor):
            assert value.isfinite().all()
            torch.testing.assert_close(getattr(one, name), value, rtol=2e-5, atol=2e-6)
        else:
            assert getattr(one, name) == value


@pytest.mark.medium
@needs_kernels
def test_compiled_rays_of_any_lens() -> None:
    """400 lenses; most fold the picture over somewhere."""
    coefficients = lenses(400).float()
    camera = replace(cameras("opencv", count=400).scaled(1 / 8), lens=coefficients)
    flat = torch.arange(int(camera.offsets[-1]))
    one, two = camera.pixel_rays(flat, 0, 1), camera.pixel_rays_reference(flat, 0, 1)
    assert one.pixel_radii is not None
    assert one.pixel_radii.isfinite().all()
    torch.testing.assert_close(one.directions, two.directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(one.pixel_radii, two.pixel_radii, rtol=1e-3, atol=0)


@pytest.mark.parametrize(("model", "lens"), ALL)
def test_cones_are_as_wide_as_pixels(model: str, lens: list[float] | None) -> None:
    """The radius, squared, against the cross product of the differences to the neighbours' rays."""
    camera = cameras(model, lens, count=1, dtype=torch.float64)
    indices, columns, rows = (
        torch.zeros(3, dtype=torch.long),
        torch.tensor([20.0, 48, 80]),
        torch.tensor([10.0, 33, 50]),
    )
    rays = camera.rays(indices, columns.double(), rows.double(), 0, 1)
    assert rays.pixel_radii is not None
    step, sides = 1e-4, []
    for across, down in ((step, 0), (0, step)):
        other = camera.rays(indices, columns.double() + across, rows.double() + down, 0, 1)
        if model == "orthographic":
            sides.append((other.origins - rays.origins) / step)
        elif model in ("pinhole", "opencv"):  # Mip-NeRF measures on the plane of the picture
            axis = -camera.camera_to_worlds[0, :, 2]
            depth, its = (r.directions @ axis for r in (rays, other))
            sides.append((other.directions / its[:, None] - rays.directions / depth[:, None]) * depth[:, None] / step)
        else:
            sides.append((other.directions - rays.directions) / step)
    area = torch.linalg.cross(*sides).norm(dim=-1) * camera.fy / camera.fx  # a cone's radius is its horizontal one
    torch.testing.assert_close(rays.pixel_radii.square() * 3, area, rtol=1e-3, atol=0)


@pytest.mark.parametrize(("model", "lens"), [("opencv", GOPRO), ("fisheye", FISHEYE)])
def test_a_lens_stays_with_its_cameras(model: str, lens: list[float]) -> None:
    camera = cameras(model, lens, count=3)
    camera = replace(camera, lens=torch.tensor([lens] * 3) * torch.tensor([[1.0], [0.5], [0.0]]))
    for index in (torch.tensor([2, 0]), torch.tensor([True, False, True]), slice(0, 2)):
        chosen = camera[index]
        assert camera.lens is not None
        assert chosen.lens is not None
        assert chosen.model == model
        assert torch.equal(chosen.lens, camera.lens[index])
    assert camera.to("cpu").lens is not None
    large, small = camera.to(torch.device("cpu")), camera.scaled(0.5)
    assert torch.equal(small.lens, large.lens)  # type: ignore[arg-type]
    assert at(large, 30, 20)[1] == pytest.approx(at(small, 15, 10)[1], abs=1e-6)


def test_coefficients_must_fit_the_model() -> None:
    with pytest.raises(ValueError, match="fisheye takes 4 distortion coefficients, not 9"):
        cameras("fisheye", GOPRO)
    with pytest.raises(ValueError, match="unknown camera model 'fish'"):
        cameras("fish")
