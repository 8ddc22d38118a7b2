"""Gaussians through any lens by the unscented transform: against EWA, samples, rays, and panoramas turned round."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.geometry.lenses import Distortion, panorama
from nerfloom.kernels.splats.packed import pack_gaussians, project_packed
from nerfloom.kernels.splats.project import DC, RECORD, Record, SplatCamera, project_gaussians
from nerfloom.kernels.splats.seam import copies
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.rasteriser import RASTERISER
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.splat_truth import LENSES, NAMES, camera, leaves, real_harmonics, scene, turned

COEFFICIENTS = {"opencv": LENSES["opencv"], "fisheye": (-0.02, 6e-3, -2e-3, 2e-4)}
"""Coefficients of each lens; the fisheye shows all directions."""
SMOOTH = [*range(Record.CUT), Record.RED, Record.GREEN, Record.BLUE, Record.DISTANCE]
"""Columns of a record that pass gradients on."""
DISTANCE = 3.0
PLACES = [
    ("pinhole", (20.0, -10.0)),
    ("opencv", (15.0, 10.0)),
    ("fisheye", (0.0, 0.0)),
    ("fisheye", (100.0, 30.0)),
    ("fisheye", (-120.0, 0.0)),
    ("equirectangular", (0.0, 0.0)),
    ("equirectangular", (179.0, 20.0)),
    ("equirectangular", (-60.0, -55.0)),
]
"""Lenses, and longitudes and latitudes (down), degrees, that they show."""


def view(model: str, blur: float = 1e-6, **settings: Any) -> SplatCamera:
    """Return an unscented camera in the scene's frame."""
    pose, given = torch.eye(3, 4, dtype=torch.float64), COEFFICIENTS.get(model)
    lens = None if given is None else Distortion.of(model, torch.tensor([given], dtype=torch.float64))
    settings |= {"near": 0.1, "blur": blur, "lens": lens, "model": model, "unscented": True}
    if model == "equirectangular":
        return SplatCamera(pose, panorama(360, 180), 360, 180, **settings)
    focal = 60.0 if model == "fisheye" else 200.0
    return SplatCamera(pose, (focal, 1.03 * focal, 250.0, 240.0), 500, 500, **settings)


def toward(longitude: float, latitude: float, distance: float = DISTANCE) -> list[float]:
    """Return the point of a direction, degrees: x right, y down, z forward."""
    around, down = math.radians(longitude), math.radians(latitude)
    level = distance * math.cos(down)
    return [level * math.sin(around), distance * math.sin(down), level * math.cos(around)]


def gaussians(places: list[list[float]], size: float = 0.04, harmonics: int = 3) -> list[Tensor]:
    """Return parameters of turned Gaussians in float64; their size is an angle at DISTANCE, radians."""
    chance, count = torch.Generator().manual_seed(1), len(places)

    def some(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=chance, dtype=torch.float64)

    return [
        torch.tensor(places, dtype=torch.float64), math.log(size * DISTANCE) + 0.3 * some(count, 3), some(count, 4),
        1 + some(count) / 2, 0.3 * some(count, 3), some(count, 3, harmonics) / 10,
    ]  # fmt: skip


def seen_at(points: np.ndarray, by: SplatCamera) -> np.ndarray:
    """Return where the lens shows points (N, 3): (N, 2) pixels, by its formula."""
    x, y, z = points.T
    if by.model == "equirectangular":
        at = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    elif by.model == "fisheye":
        k1, k2, k3, k4 = COEFFICIENTS["fisheye"]
        off = np.hypot(x, y)
        angle = np.arctan2(off, z)
        scale = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8) / off
        at = x * scale, y * scale
    else:
        at = x / z, y / z
        if by.model == "opencv":
            k1, k2, p1, p2, k3, k4, k5, k6, _ = COEFFICIENTS["opencv"]
            u, v = at
            q = u**2 + v**2
            scale = (1 + k1 * q + k2 * q**2 + k3 * q**3) / (1 + k4 * q + k5 * q**2 + k6 * q**3)
            at = (
                u * scale + 2 * p1 * u * v + p2 * (q + 2 * u**2),
                v * scale + p1 * (q + 2 * v**2) + 2 * p2 * u * v,
            )
    fx, fy, cx, cy = by.intrinsics
    return np.stack([fx * at[0] + cx, fy * at[1] + cy], 1)


def covariance(record: Tensor) -> Tensor:
    """Return the covariance (2, 2) of a record, pixels^2, with the blur."""
    zero = torch.zeros_like(record[0])
    factor = torch.stack([record[Record.U_X], record[Record.U_Y], zero, record[Record.V_Y]]).view(2, 2)
    return torch.linalg.inv(2 * factor.T @ factor)


# -- projection ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["", "opencv", "fisheye"])
def test_small_gaussians_are_those_of_ewa(lens: str) -> None:
    """Centre, shape, opacity, colour, distance and normal."""
    torch.manual_seed(0)
    *rows, pose = (each.double() for each in scene(80))
    rows[1] = 0.3 * rows[1].tanh() - 7
    ewa = replace(camera(43, 38, lens, antialiased=True, blur=1e-6), pose=pose)
    truth, found = (project_gaussians(*rows, each)[0] for each in (ewa, replace(ewa, unscented=True)))
    shown = truth[:, Record.CUT] > 0
    assert 10 < int(shown.sum()) < 80
    assert torch.equal(found[:, Record.CUT] > 0, shown)
    for column in Record:
        assert relative_error(found[:, column], truth[:, column]) < 1e-3, column.name


@pytest.mark.parametrize(("model", "place"), PLACES)
def test_mean_and_covariance_are_those_of_samples(model: str, place: tuple[float, float]) -> None:
    by, rows = view(model), gaussians([toward(*place)])
    record = project_gaussians(*rows, by)[0][0]
    assert record[Record.CUT] > 0
    axes = turned(rows[2][:, None], torch.eye(3).double())[0].numpy()  # one in each row
    draws = np.random.default_rng(0).standard_normal((20_000, 3))
    samples = seen_at(rows[0][0].numpy() + draws @ (axes * rows[1][0].exp().numpy()[:, None]), by)
    if by.turn is not None:
        around = samples[:, 0] - float(record[Record.X])
        samples[:, 0] -= by.turn * np.round(around / by.turn)
    true = np.cov(samples.T)
    found = (covariance(record) - by.blur * torch.eye(2).double()).numpy()
    off = np.abs(record[:2].numpy() - samples.mean(0)).max() / math.sqrt(np.linalg.eigvalsh(true)[-1])
    error = np.linalg.norm(found - true) / np.linalg.norm(true)
    print(f"{model} at {place}: the mean is {off:.3f} standard deviations off, the covariance {error:.3f}")
    assert off < 0.035
    assert error < 0.06


@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye", "equirectangular"])
def test_gradients_by_finite_differences(model: str) -> None:
    by = view(model, blur=0.3, antialiased=True)
    given = [*gaussians([toward(*place) for name, place in PLACES if name == model]), by.pose]
    own = leaves(given, torch.float64)

    def records(*parameters: Tensor) -> Tensor:
        return project_gaussians(*parameters[:6], replace(by, pose=parameters[6]), degree=1)[0][:, SMOOTH]

    assert bool((records(*own)[:, Record.OPACITY] > 0).all())
    assert torch.autograd.gradcheck(records, tuple(own))


@pytest.mark.parametrize("model", ["fisheye", "equirectangular"])
def test_what_is_drawn(model: str) -> None:
    """Gaussians beside and behind the camera are drawn; too near ones, and ones exactly behind a fisheye, are not."""
    directions = [(0, 0), (100, 0), (170, 0), (-90, 20)]
    places = [*(toward(*each) for each in directions), [0, 0, -DISTANCE], toward(100, 0, 0.05)]
    records, dropped = project_gaussians(*gaussians(places), view(model))
    behind = model == "equirectangular"
    assert dropped == 0
    assert (records[:, Record.CUT] > 0).tolist() == [True, True, True, True, behind, False]
    assert not records[-1].any()
    distances = torch.tensor([DISTANCE] * 4, dtype=torch.float64)
    torch.testing.assert_close(records[:4, Record.DISTANCE], distances)


def test_a_gaussian_at_the_edge_of_a_lens_keeps_its_size() -> None:
    """A fisheye of k1 = -0.1 has a reach of 104.6 degrees; sigma points beyond it lie on its edge."""
    lens = Distortion.of("fisheye", torch.tensor([[-0.1, 0.0, 0.0, 0.0]], dtype=torch.float64))
    rows = gaussians([toward(80, 0), toward(103, 0), toward(107, 0)])
    rows[1] = torch.full_like(rows[1], math.log(0.04 * DISTANCE))
    records, _ = project_gaussians(*rows, replace(view("fisheye"), lens=lens))
    assert (records[:, Record.CUT] > 0).tolist() == [True, True, False]
    within, at_edge = (float(covariance(record).trace()) for record in records[:2])
    assert 0.5 * within < at_edge < 2 * within


def test_a_gaussian_whose_points_are_partly_behind_a_pinhole_is_left_out() -> None:
    """Points behind the camera have no position on its image."""
    large, small = (gaussians([toward(10, 5)], size) for size in (1.0, 0.1))
    found = [float(project_gaussians(*rows, view("pinhole"))[0][0, Record.CUT]) for rows in (large, small)]
    assert found[0] == 0 < found[1]


def test_colours_are_those_of_the_direction() -> None:
    by, chance = view("equirectangular"), torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=chance)).Q
    shift = torch.tensor([[0.1], [-0.2], [0.3]], dtype=torch.float64)
    pose = torch.cat([turn * torch.linalg.det(turn), shift], 1)
    rows = gaussians([toward(*each) for each in ((0, 0), (100, 20), (-170, -40), (60, 70))], harmonics=15)
    records = project_gaussians(*rows, replace(by, pose=pose))[0]
    directions = rows[0] + pose[:, :3].T @ pose[:, 3]
    basis = real_harmonics(directions / directions.norm(dim=-1, keepdim=True), 3)
    table = torch.cat([rows[4][..., None], rows[5]], -1)
    expected = (0.5 + (table * basis[:, None]).sum(-1)).clamp(min=0)
    torch.testing.assert_close(records[:, Record.RED : Record.BLUE + 1], expected)


@pytest.mark.parametrize("place", [toward(20, 89), toward(20, 80), [0.0, DISTANCE, 0.0], [0.0, -DISTANCE, 0.0]])
def test_gaussians_at_the_poles_stay_finite(place: list[float]) -> None:
    """Also if they contain a pole, and if their centre is exactly there: at most half a turn wide on each side."""
    by = view("equirectangular")
    own = leaves([*gaussians([place], size=0.1), by.pose], torch.float64)
    records = project_gaussians(*own[:6], replace(by, pose=own[6]), degree=1)[0]
    assert bool(records.isfinite().all())
    assert records[0, Record.CUT] > 0
    assert by.turn is not None
    width = float(covariance(records[0].detach())[0, 0].sqrt())
    assert 5 < width < by.turn
    for gradient in torch.autograd.grad(records[:, SMOOTH].sum(), own):
        assert bool(gradient.isfinite().all())


# -- compiled ------------------------------------------------------------------------------------------------------


def all_around(model: str, count: int = 60) -> list[Tensor]:
    """Return parameters of Gaussians in all directions, but not at the poles, and at the places of a lens."""
    chance = torch.Generator().manual_seed(5)
    random = torch.rand(count, 2, generator=chance) * torch.tensor([360.0, 160.0]) - torch.tensor([180.0, 80.0])
    places = [*random.tolist(), *(place for name, place in PLACES if name == model)]
    return [each.float() for each in gaussians([toward(*place) for place in places], harmonics=15)]


@needs_kernels
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye", "equirectangular"])
def test_compiled_is_the_reference(model: str, antialiased: bool) -> None:
    """Float32 is compiled, and float64 is not."""
    by, given = view(model, blur=0.3, antialiased=antialiased), all_around(model)
    given.append(by.pose.float() + torch.tensor([[0.0, 0, 0, 0.1], [0, 0, 0, -0.05], [0, 0, 0, 0.02]]))
    weights = torch.randn(len(given[0]), len(SMOOTH), generator=torch.Generator().manual_seed(6))
    found = []
    for dtype in (torch.float32, torch.float64):
        own = leaves(given, dtype)
        seen = replace(by, pose=own[6])
        records, _ = project_gaussians(*own[:6], seen)
        slopes = torch.autograd.grad((records[:, SMOOTH] * weights.to(dtype)).sum(), own)
        found.append((records.detach(), slopes))
    (ours, our_slopes), (truth, true_slopes) = found
    shown = truth[:, Record.CUT] > 0
    assert int(shown.sum()) > (60 if model == "equirectangular" else 1)
    assert torch.equal(ours[:, Record.CUT] > 0, shown)
    for column in Record:
        assert relative_error(ours[:, column], truth[:, column]) < 1e-4, column.name
    for name, one, other in zip(NAMES, our_slopes, true_slopes, strict=True):
        assert relative_error(one, other) < 1e-3, name


@needs_kernels
@pytest.mark.parametrize("model", ["fisheye", "equirectangular"])
def test_packed_is_as_rows(model: str) -> None:
    """Blocks behind the camera are not skipped."""
    rows, by = all_around(model), view(model)
    by = replace(by, pose=by.pose.float())
    truth, _ = project_gaussians(*rows, by)
    found = project_packed(pack_gaussians(*rows), by)[: len(truth)]
    shown = truth[:, Record.CUT] > 0
    assert int(shown.sum()) > 10
    assert torch.equal(found[:, Record.CUT] > 0, shown)
    torch.testing.assert_close(found[shown], truth[shown], rtol=1e-4, atol=1e-4)


# -- the seam -----------------------------------------------------------------------------------------------------


def test_copies_are_where_the_image_shows_another_side() -> None:
    """Two are at the edges, one is wider than the image, one is in the middle, and one is not visible."""
    records = torch.zeros(5, RECORD)
    records[:, Record.X] = torch.tensor([3.0, 98.0, 40.0, 50.0, 1.0])
    records[:, Record.REACH_X] = torch.tensor([5.0, 4.0, 90.0, 10.0, 9.0])
    records[:, Record.CUT] = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0])
    records[:, Record.RED] = torch.arange(5.0)
    records.requires_grad_()
    indices, found = copies(records, 100, 100.0)
    where = sorted(zip(indices.tolist(), found[:, Record.X].tolist(), strict=True))
    assert where == [(0, 103.0), (1, -2.0), (2, -60.0), (2, 140.0)]
    assert torch.equal(found[:, Record.RED], indices.float())
    (gradient,) = torch.autograd.grad(found[:, Record.RED].sum(), records)
    assert gradient[:, Record.RED].tolist() == [1, 1, 2, 0, 0]


def cloud(count: int) -> Gaussians:
    """Return Gaussians all around the origin, small and large ones, but not near the poles."""
    chance = torch.Generator().manual_seed(2)
    around, down = 360 * torch.rand(count, generator=chance), 100 * torch.rand(count, generator=chance) - 50
    places = [toward(*each) for each in zip(around.tolist(), down.tolist(), strict=True)]
    means, log_scales, *rest = gaussians(places, size=0.06)
    means = means * (0.7 + 0.6 * torch.rand(count, 1, generator=chance).double())
    return Gaussians(*(each.float() for each in (means, log_scales, *rest)))


def panorama_camera(width: int, pose: Tensor) -> Cameras:
    """Return a panorama of all directions; the pose is (1, 3, 4) to the scene, x right, y up, z back."""
    numbers = (torch.tensor([value]) for value in panorama(width, width // 2))
    return Cameras(pose, *numbers, torch.tensor([width]), torch.tensor([width // 2]), "equirectangular")


def test_turning_the_camera_turns_the_panorama() -> None:
    """A half turn rolls the picture by half of its width, so the seam is as good as the middle. Gradients agree too."""
    given, width = cloud(150), 160
    weights = torch.rand(width // 2, width, 3, generator=torch.Generator().manual_seed(4))
    pictures, slopes = [], []
    for half_turn in (False, True):
        turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0] if half_turn else [1.0, 1.0, 1.0]))
        seen = splat_camera(panorama_camera(width, torch.cat([turn, torch.zeros(3, 1)], 1)[None]), 0.1)
        own = given.map(lambda each: each.clone().requires_grad_())
        image = RASTERISER.draw(RASTERISER.project(own, seen), seen, torch.zeros(3)).image
        image = image.roll(width // 2, 1) if half_turn else image
        pictures.append(image.detach())
        inputs = [own.means, own.log_scales, own.logits, own.colors]
        slopes.append(torch.autograd.grad((image * weights).sum(), inputs))
    off = (pictures[0] - pictures[1]).abs()
    print(f"largest difference {float(off.max()):.1e}, mean {float(off.mean()):.1e}")
    assert float(pictures[0].mean()) > 0.02
    assert float(off.max()) < 0.02  # an alpha at its least value is drawn in one, and not in the other
    assert float(off.mean()) < 1e-4
    for one, other in zip(*slopes, strict=True):
        assert relative_error(other, one) < 0.02


# -- pictures -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "place"),
    [
        ("fisheye", (0.0, 0.0)),
        ("fisheye", (60.0, 20.0)),
        ("fisheye", (-120.0, 10.0)),
        ("equirectangular", (30.0, 40.0)),
        ("equirectangular", (179.5, 10.0)),
    ],
)
def test_an_isolated_gaussian_is_what_rays_meet(model: str, place: tuple[float, float]) -> None:
    """Alpha of a pixel is the largest value of the Gaussian along its ray, for a Gaussian that is small in angle."""
    rows = [each.float() for each in gaussians([toward(*place)], harmonics=0)]
    rows[0] = rows[0] * torch.tensor([1.0, -1.0, -1.0])  # to x right, y up, z back
    rows[1] = (DISTANCE * torch.tensor([[0.03, 0.012, 0.02]])).log()
    rows[3], rows[4] = torch.tensor([1.0]), torch.full((1, 3), 0.5 / DC)
    pose = torch.eye(4)[None, :3]
    if model == "equirectangular":
        one = panorama_camera(400, pose)
    else:
        numbers = (torch.tensor([value]) for value in (100.0, 100.0, 220.0, 220.0))
        lens, size = torch.tensor([COEFFICIENTS["fisheye"]]), torch.tensor([440])
        one = Cameras(pose, *numbers, size, size, model, lens)
    seen = splat_camera(one, 0.1, Look(blur=1e-3))
    assert seen.unscented
    image = draw_colors(Gaussians(*rows), seen, 1, torch.zeros(3))[..., 0]
    rays = one.pixel_rays(one.image_pixels(0), 0.0, 1.0)
    axes = turned(rows[2][:, None].double(), torch.eye(3).double())[0]  # one in each row
    into = axes / rows[1].double().exp().T
    start, along = (rays.origins.double() - rows[0].double()) @ into.T, rays.directions.double() @ into.T
    at = -(start * along).sum(-1) / along.square().sum(-1)
    nearest = start + at[:, None] * along
    alpha = torch.sigmoid(rows[3].double()) * torch.exp(-0.5 * nearest.square().sum(-1)) * (at > 0)
    off = (image.double() - alpha.view(image.shape)).abs().max()
    print(f"{model} at {place}: pictures differ by {float(off):.3f}")
    assert float(image.max()) > 0.5
    assert float(off) < 0.06
