"""Gaussian splatting where the image is known by heart, and where it could go wrong."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.lenses import Distortion
from nerfloom.kernels.splats.blend import MAX_ALPHA, OPAQUE, blend
from nerfloom.kernels.splats.project import MIN_ALPHA, Record, SplatCamera, project_gaussians, project_reference
from nerfloom.kernels.splats.tiles import tile_lists
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.splat_truth import NAMES, camera, compared, drawn, leaves, scene, true_image

pytestmark = needs_kernels
BLACK = torch.zeros(3)
FOCAL = 1e4
"""A focal length, pixels, that is long enough to neglect perspective off the axis."""


def logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))


def straight(width: int, height: int, **settings: float | bool) -> SplatCamera:
    """Return a camera at the origin with its axis at the image's corner; a pixel at depth 1 is 1 / FOCAL wide."""
    return SplatCamera(torch.eye(3, 4), (FOCAL, FOCAL, 0.0, 0.0), width, height, **settings)


def ball(x: float, y: float, sigma: float, opacity: float, color: float = 0.5, depth: float = 1.0) -> list[Tensor]:
    """Return a grey Gaussian with its centre at pixel (x, y), a standard deviation of `sigma` pixels, and the pose."""
    mean = torch.tensor([[x / FOCAL * depth, y / FOCAL * depth, depth]])
    scales = torch.full((1, 3), math.log(sigma / FOCAL * depth))
    shade = torch.full((1, 3), (color - 0.5) / 0.28209479177387814)
    return [
        mean, scales, torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([logit(opacity)]), shade, torch.zeros(1, 3, 0),
        torch.eye(3, 4),
    ]  # fmt: skip


def together(*scenes: list[Tensor]) -> list[Tensor]:
    *parameters, poses = zip(*scenes, strict=True)
    return [*(torch.cat(list(parts)) for parts in parameters), poses[0]]


# -- closed forms -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sigma", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.95])
def test_the_integral_of_alpha(opacity: float, sigma: float, antialiased: bool) -> None:
    """Where alpha is at least m, it is 2 pi variance (opacity - m). Antialiasing keeps the integral without blur."""
    blur = 0.3
    drawn_one = drawn(ball(50.3, 49.8, sigma, opacity), straight(100, 100, blur=blur, antialiased=antialiased))
    found = float((1 - drawn_one.transmittance.double()).sum())
    variance = sigma**2 + blur
    peak = opacity * (sigma**2 / variance if antialiased else 1)
    assert found == pytest.approx(2 * math.pi * variance * (peak - MIN_ALPHA), rel=0.03 if sigma < 1 else 0.01)
    if antialiased:
        assert found == pytest.approx(2 * math.pi * sigma**2 * opacity, rel=0.05 + MIN_ALPHA / peak)


@pytest.mark.parametrize("near_one", [0, 1])
def test_two_that_overlap(near_one: int) -> None:
    """The nearer is in front, in any order of rows; the image is a + (1 - a) b over the background."""
    colors, opacities = (0.9, 0.2), (0.6, 0.7)
    far_one = 1 - near_one
    pair = [
        ball(8.5, 7.5, 2.0, opacities[i], colors[i], 1.0 if i == near_one else 1.25) for i in range(2)
    ]  # fmt: skip
    found = drawn(together(*pair), straight(16, 16, blur=1e-9), background=torch.full((3,), 0.5), median=True)
    a, b = opacities[near_one], opacities[far_one]
    expected = a * colors[near_one] + (1 - a) * b * colors[far_one] + (1 - a) * (1 - b) * 0.5
    assert found.image[7, 8].tolist()[:3] == pytest.approx([expected] * 3, rel=1e-5)
    assert float(found.transmittance[7, 8]) == pytest.approx((1 - a) * (1 - b), rel=1e-5)
    scale = math.hypot(8.5 / FOCAL, 7.5 / FOCAL, 1)
    assert found.median is not None
    assert float(found.median[7, 8]) == pytest.approx(scale, rel=1e-5)
    assert float(found.image[7, 8, 3]) == pytest.approx(a * scale + (1 - a) * b * 1.25 * scale, rel=1e-5)


def test_no_alpha_is_above_the_cap_which_has_no_gradient() -> None:
    given = leaves(ball(8.5, 8.5, 3.0, 0.9999, 0.75))
    found = drawn(given, straight(17, 17, blur=1e-9), background=BLACK)
    center = found.image[8, 8, 0]
    assert center.item() == pytest.approx(MAX_ALPHA * 0.75, rel=1e-6)
    assert found.transmittance[8, 8].item() == pytest.approx(1 - MAX_ALPHA, rel=1e-4)
    gradients = dict(zip(NAMES, torch.autograd.grad(center, given, retain_graph=True), strict=True))
    assert not any(gradients[name].any() for name in ("means", "log scales", "rotations", "logits"))
    assert gradients["colors"][0].tolist() == pytest.approx([MAX_ALPHA * 0.28209479, 0, 0], rel=1e-5)
    (gradient,) = torch.autograd.grad(found.image[8, 5, 0], given[3])
    assert gradient.item() > 0


def test_nothing_counts_behind_what_is_opaque() -> None:
    """Light is spent when less than OPAQUE is left: after the second of opacity 0.999, and not before."""
    pile = [ball(8.5, 8.5, 40.0, 0.9995, color, depth) for color, depth in ((0.2, 1.0), (0.4, 1.1), (0.9, 1.2))]
    found = drawn(together(*pile), straight(17, 17), background=torch.ones(3))
    left = (1 - MAX_ALPHA) ** 2
    assert left < OPAQUE
    assert float(found.transmittance[8, 8]) == pytest.approx(left, rel=1e-3)
    assert float(found.image[8, 8, 0]) == pytest.approx(0.999 * 0.2 + 0.001 * 0.999 * 0.4 + left, rel=1e-5)
    ours = leaves(together(*pile))
    (gradient,) = torch.autograd.grad(drawn(ours, straight(17, 17)).image[8, 8].sum(), ours[4])
    assert gradient[:2].abs().amin() > 0
    assert not gradient[2].any()


def test_the_distance_of_a_plane_of_small_gaussians() -> None:
    """Image over opacity is the distance from the camera, not along its axis."""
    x, y = (grid.flatten() for grid in torch.meshgrid(torch.arange(26.0), torch.arange(26.0), indexing="xy"))
    wall = together(*(ball(float(a) + 0.5, float(b) + 0.5, 0.7, 0.7, depth=2.0) for a, b in zip(x, y, strict=True)))
    focal = 30.0
    wall[0][:, :2] *= FOCAL / focal
    wall[1] += math.log(FOCAL / focal)
    found = drawn(wall, replace(straight(26, 26), intrinsics=(focal, focal, 0.0, 0.0)), median=True)
    inner = slice(4, 22)
    expected = 2 * torch.sqrt(1 + ((x + 0.5) / focal) ** 2 + ((y + 0.5) / focal) ** 2).view(26, 26)[inner, inner]
    opaque = 1 - found.transmittance[inner, inner]
    assert opaque.amin() > 0.8
    torch.testing.assert_close(found.image[inner, inner, 3] / opaque, expected, rtol=3e-2, atol=0)
    assert found.median is not None
    torch.testing.assert_close(found.median[inner, inner], expected, rtol=3e-2, atol=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_normals_are_of_the_shortest_axis_and_face_the_camera(axis: int) -> None:
    torch.manual_seed(0)
    turns = torch.nn.functional.normalize(torch.randn(30, 4), dim=-1)
    means = torch.randn(30, 3) + torch.tensor([0.0, 0.0, 5.0])
    scales = torch.full((30, 3), -1.0)
    scales[:, axis] = -3.0
    rows = [means, scales, turns, torch.full((30,), 3.0), torch.zeros(30, 3), torch.zeros(30, 3, 0)]
    records, _ = project_gaussians(*rows, SplatCamera(torch.eye(3, 4), (20.0, 20.0, 50.0, 50.0), 100, 100))
    w, x, y, z = turns.double().unbind(-1)
    columns = (
        (w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z),
    )
    normals = records[:, Record.NORMAL_X : Record.REACH_Y].double()
    assert (normals * means).sum(-1).amax() <= 0
    alike = (normals * torch.stack(columns[axis], -1)).sum(-1).abs()
    torch.testing.assert_close(alike, torch.ones_like(alike), rtol=0, atol=1e-5)


# -- extremes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(
    ("sizes", "bound"),
    [((2.0, -9.5, -9.5), 1e-4), ((0.0, 0.0, -12.0), 1e-4), ((-9.0, -10.0, -8.0), 1e-4), ((4.0, -20.0, 4.0), 1e-2)],
    ids=["needles", "discs", "dust", "sheets around the camera"],
)
def test_far_from_round(sizes: tuple[float, float, float], bound: float, antialiased: bool) -> None:
    """Gaussians are up to 100 000 times as long as they are thick. Antialiasing hides needles and dust."""
    torch.manual_seed(1)
    given = scene(30)
    given[1] = torch.tensor(sizes).expand(30, 3).contiguous()
    given[3] += 1
    found = compared(given, camera(40, 36, antialiased=antialiased))
    assert found.share > 0.8
    assert found.image < 1e-4, found
    assert found.transmittance < 1e-4, found
    assert all(error < bound for error in found.gradients.values()), found


def test_giants_fill_the_image() -> None:
    torch.manual_seed(2)
    given = scene(20)
    given[1] += 8
    given[3] = -torch.rand(20) * 3
    found = compared(given, camera(50, 35))
    assert found.image < 1e-5, found
    assert all(error < 1e-4 for error in found.gradients.values()), found
    one = ball(25.0, 17.0, 1e5, 0.5)
    image = drawn(one, straight(50, 35)).transmittance
    torch.testing.assert_close(image, torch.full_like(image, 0.5))


def test_what_is_behind_the_camera_or_too_near_is_not_drawn() -> None:
    """A Gaussian at the near plane itself is too near."""
    near = 0.25
    depths = [
        -5.0,
        -0.25,
        0.0,
        0.1,
        math.nextafter(near, 0),
        near,
        float(torch.nextafter(torch.tensor(near), torch.tensor(1.0))),
        1.0,
    ]
    rows = together(*(ball(4.5, 4.5, 2.0, 0.5) for _ in depths))
    rows[0] = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    view = replace(straight(9, 9), near=near)
    records, dropped = project_gaussians(*rows[:6], view)
    assert (records[:, Record.CUT] > 0).tolist() == [False] * 6 + [True] * 2
    assert not records[:6].any()
    assert dropped == 0
    ours = leaves(rows)
    for gradient in torch.autograd.grad(drawn(ours, view).image.sum(), ours[:4]):
        assert not gradient[:6].any()
        assert gradient.isfinite().all()


@pytest.mark.parametrize(
    "place", [(8.0, 8.0), (16.0, 16.0), (16.0, 8.5), (8.5, 16.0), (0.0, 0.0), (32.0, 32.0), (0.5, 31.5)]
)
@pytest.mark.parametrize("sigma", [0.2, 2.5])
def test_centres_on_edges_and_corners_of_pixels_and_tiles(place: tuple[float, float], sigma: float) -> None:
    """The image is as symmetric as the place."""
    given, view = ball(*place, sigma, 0.8), straight(32, 32)
    found = compared(given, view)
    assert found.worst() < 1e-5, found
    image = 1 - drawn(given, view).transmittance
    assert image.amax() > 0.1
    if place in ((16.0, 16.0), (16.0, 8.5)):
        torch.testing.assert_close(image, image.flip(1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("outside", [-2.2, 34.2])
@pytest.mark.parametrize("across", [False, True])
def test_only_the_margin_of_a_gaussian_outside_is_on_the_image(outside: float, across: bool) -> None:
    place = (outside, 15.3) if across else (15.3, outside)
    given, view = ball(*place, 2.0, 0.9), straight(32, 32)
    assert bool((drawn(given, view).transmittance < 1).any())
    assert compared(given, view).worst() < 1e-5
    nothing = ball(
        *((outside + math.copysign(6, outside), 15.3) if across else (15.3, outside + math.copysign(6, outside))),
        2.0,
        0.9,
    )
    assert not project_gaussians(*nothing[:6], view)[0].any()


def test_opacities_of_nothing_and_of_all() -> None:
    """Logits of -100 and 100, and infinite ones, which are left out."""
    rows = together(*(ball(8.5, 8.5, 3.0, 0.5, 0.25 * i, 1 + 0.1 * i) for i in range(4)))
    rows[3] = torch.tensor([-100.0, 100.0, math.inf, -math.inf])
    view = straight(17, 17)
    records, dropped = project_gaussians(*rows[:6], view)
    assert dropped == 2
    assert (records[:, Record.CUT] > 0).tolist() == [False, True, False, False]
    assert records[1, Record.OPACITY] == 1
    ours = leaves(rows)
    found = drawn(ours, view)
    assert float(found.transmittance.detach().amin()) == pytest.approx(1 - MAX_ALPHA, rel=1e-3)
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(found.image.sum(), ours))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(6), ids=NAMES[:6])
@pytest.mark.parametrize("compiled", [True, False])
def test_rows_that_are_not_finite_are_dropped_and_counted(which: int, bad: float, compiled: bool) -> None:
    """Wherever they are; the rest of the image, and of the gradients, is as without them."""
    torch.manual_seed(3)
    given, view = scene(50), camera(24, 20)
    spoilt = [0, 7, 31, 49]
    rest = [i for i in range(50) if i not in spoilt]
    given[which].view(50, -1)[spoilt, [0, -1, 0, -1]] = bad
    form = project_gaussians if compiled else lambda *rows: project_reference(*rows, 15)

    def run(rows: list[Tensor]) -> tuple[Tensor, tuple[Tensor, ...], int]:
        ours = leaves(rows)
        records, dropped = form(*ours[:6], replace(view, pose=ours[6]))
        found = blend(records, tile_lists(records, 24, 20), 24, 20, BLACK, 4)
        return found.image.detach(), torch.autograd.grad(found.image.square().sum(), ours), dropped

    image, gradients, dropped = run(given)
    expected, true_gradients, none = run([*(tensor[rest] for tensor in given[:6]), given[6]])
    assert (dropped, none) == (4, 0)
    assert torch.equal(image, expected)
    for gradient, true in zip(gradients[:6], true_gradients, strict=False):
        assert not gradient[spoilt].any()
        assert torch.equal(gradient[rest], true)
    assert relative_error(gradients[6], true_gradients[6]) < 1e-6  # other sums of the same numbers


def test_harmonics_that_do_not_count_yet_may_be_anything() -> None:
    torch.manual_seed(4)
    given, view = scene(20), camera(20, 20)
    expected = drawn(given, view, degree=1)
    given[5][..., 3:] = math.nan
    ours = leaves(given)
    found = drawn(ours, view, degree=1)
    assert torch.equal(found.image, expected.image)
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(found.image.sum(), ours))


@pytest.mark.parametrize("length", [0.0, 1e-13])
def test_a_quaternion_of_no_length_is_dropped_and_any_other_length_is_no_matter(length: float) -> None:
    torch.manual_seed(5)
    given, view = scene(20), camera(20, 20)
    given[2] = torch.nn.functional.normalize(given[2], dim=-1)
    given[2][3] *= length
    records, dropped = project_gaussians(*given[:6], view)
    assert dropped == 1
    assert not records[3].any()
    ours = leaves(given)
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(drawn(ours, view).image.sum(), ours))
    scaled = [*given[:2], given[2] * torch.logspace(-6, 6, 20)[:, None], *given[3:6]]
    torch.testing.assert_close(project_gaussians(*scaled, view)[0], records, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [0, 30])
def test_nothing_to_see(count: int) -> None:
    torch.manual_seed(6)
    given, view = scene(count), camera(19, 33)
    given[0][:, 2] -= 20
    ours = leaves(given)
    found = drawn(ours, view, median=True)
    assert torch.equal(found.image[..., :3], torch.tensor([0.2, 0.5, 0.9]).expand(33, 19, 3))
    assert not found.image[..., 3].any()
    assert bool((found.transmittance == 1).all())
    assert found.median is not None
    assert not found.median.any()
    for tensor, gradient in zip(
        ours, torch.autograd.grad(found.image.sum() + found.transmittance.sum(), ours), strict=True
    ):
        assert gradient.shape == tensor.shape
        assert not gradient.any()


def test_a_hundred_thousand_at_one_point() -> None:
    """All have the same distance from the camera, so their indices determine their order."""
    count = 100_000
    given = [tensor.expand(count, *tensor.shape[1:]).contiguous() for tensor in ball(2.5, 2.5, 3.0, 0.02)[:6]]
    given[4] = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    ours = leaves([*given, torch.eye(3, 4)])
    view = straight(4, 4, blur=1e-9)
    found = drawn(ours, view, median=True)
    offset = torch.arange(4.0).double() + 0.5 - 2.5
    alpha = 0.02 * torch.exp(-(offset[:, None] ** 2 + offset**2) / 18)[..., None]
    through = (1 - alpha) ** torch.arange(2000)
    weight = alpha * through * (through >= OPAQUE)
    expected = weight @ (0.5 + 0.28209479177387814 * given[4][:2000].double()) + (
        1 - weight.sum(-1, keepdim=True)
    ) * torch.tensor([0.2, 0.5, 0.9])
    torch.testing.assert_close(found.image[..., :3].double(), expected, rtol=0, atol=1e-5)
    (gradient,) = torch.autograd.grad(found.image[..., 0].sum(), ours[4])
    torch.testing.assert_close(
        gradient[:2000, 0].double(), 0.28209479177387814 * weight.sum((0, 1)), rtol=1e-3, atol=1e-5
    )
    assert not gradient[2000:].any()


def test_far_from_the_origin_and_tiny_or_huge_scenes() -> None:
    """Scales of the scene change only the near plane; positions lose digits that float32 does not have."""
    torch.manual_seed(7)
    given, view = scene(40), camera(30, 30)
    expected = true_image(given, view)
    for scale in (1e-3, 1e4):
        moved = [
            given[0] * scale,
            given[1] + math.log(scale),
            *given[2:6],
            torch.cat([given[6][:, :3], scale * given[6][:, 3:]], 1),
        ]
        found = drawn(moved, replace(view, near=0.01 * scale), 3)
        torch.testing.assert_close(
            found.image[expected.certain].double(), expected.image[expected.certain][:, :3], rtol=0, atol=1e-4
        )


# -- what is refused ----------------------------------------------------------------------------------------------


def test_what_is_refused() -> None:
    torch.manual_seed(8)
    given, view = scene(10), camera(20, 20)
    for count in (1, 5, 16):
        with pytest.raises(ValueError, match=f"there are 0, 3, 8 or 15 harmonics beyond the first, not {count}"):
            project_gaussians(*given[:5], torch.zeros(10, 3, count), view)
    for index, name in ((1, "log scales"), (2, "rotations"), (3, "logits"), (4, "colors"), (5, "harmonics")):
        short = [*given[:index], given[index][:-1], *given[index + 1 : 6]]
        with pytest.raises(ValueError, match=f"the {name}|{name} has shape"):
            project_gaussians(*short, view)
    records, _ = project_gaussians(*given[:6], view)
    lists = tile_lists(records, 20, 20)
    with pytest.raises(ValueError, match="an image has 3, 4 or 7 channels"):
        blend(records, lists, 20, 20, BLACK, 5)
    with pytest.raises(ValueError, match="the background has shape"):
        blend(records, lists, 20, 20, torch.zeros(4))
    with pytest.raises(IndexError, match="Gaussians: index"):
        blend(records, lists._replace(ids=lists.ids + 10), 20, 20, BLACK)
    with pytest.raises(IndexError, match="offsets"):
        blend(records, lists._replace(offsets=lists.offsets + 1000), 20, 20, BLACK)
    leaf = records.clone().requires_grad_()
    image = blend(leaf, lists._replace(slots=lists.slots + 1000), 20, 20, BLACK).image
    with pytest.raises(IndexError, match="entries: index"):
        image.sum().backward()
    image = blend(leaf, lists._replace(firsts=lists.firsts + 1000), 20, 20, BLACK).image
    with pytest.raises(IndexError, match="slots: index"):
        image.sum().backward()


def test_beyond_a_lenss_reach_nothing_is_drawn() -> None:
    """A barrel lens of k1 = -0.3 would fold back points farther than 1 / sqrt(0.9) from its axis."""
    lens = Distortion.of("opencv", torch.tensor([[-0.3] + [0.0] * 8]))
    view = SplatCamera(torch.eye(3, 4), (50.0, 50.0, 40.0, 40.0), 80, 80, lens=lens, model="opencv")
    across = torch.tensor([0.0, 0.5, 1.04, 1.07, 1.2, 1.8, -1.2, -0.5])
    rows = [torch.zeros(8, count) for count in (3, 3, 4, 3)]
    rows[0][:, 0], rows[0][:, 2] = across, 1.0
    rows[1] -= 5
    rows[2][:, 0] = 1
    records, dropped = project_gaussians(*rows[:3], torch.zeros(8), rows[3], torch.zeros(8, 3, 0), view)
    within = across.abs() < 0.9**-0.5
    assert dropped == 0
    assert torch.equal(records[:, Record.CUT] > 0, within)
    bent = 40 + 50 * (across - 0.3 * across**3)
    torch.testing.assert_close(records[within, 0], bent[within])
    assert not records[~within].any()
