"""Gaussian splatting, from parameters to images and back, against a float64 truth that looks at each pixel."""

import re
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.native import SOURCES
from nerfloom.kernels.splats.blend import ABSOLUTE_X, ABSOLUTE_Y, OPAQUE, blend
from nerfloom.kernels.splats.project import Record, SplatCamera, project_gaussians
from nerfloom.kernels.splats.tiles import tile_lists
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.splat_truth import (
    BACKGROUND,
    camera,
    compared,
    drawn,
    gradients,
    leaves,
    real_harmonics,
    scene,
    true_image,
)
from tests.kernels.test_encodings_against_scipy import real_harmonic, unit_vectors

BOUND = 1e-5
"""Largest error over the largest value, of images and gradients."""
SIZES = [(1, 1), (1, 40), (33, 1), (16, 16), (17, 15), (32, 48), (5, 100), (47, 31)]


def test_cpp_has_the_same_columns_of_a_record() -> None:
    declared = re.search(
        r"enum Record \{(.*?)\};", (SOURCES / "splats" / "splat.h").read_text(encoding="utf-8"), re.DOTALL
    )
    assert declared is not None
    names = re.sub(r"//.*", "", declared[1]).replace(",", " ").split()
    assert names == [*(column.name for column in Record), "RECORD"]


def test_the_truths_harmonics_are_scipys() -> None:
    directions = unit_vectors(50)
    orders = [(degree, order) for degree in range(4) for order in range(-degree, degree + 1)]
    expected = torch.stack([torch.tensor(real_harmonic(*order, directions)) for order in orders], -1)
    torch.testing.assert_close(real_harmonics(directions, 3), expected, atol=1e-14, rtol=0)


@pytest.mark.parametrize("lens", ["", "opencv", "fisheye"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("size", [(37, 21), (1, 30), (30, 1)], ids=str)
def test_the_reference_is_the_truth(size: tuple[int, int], lens: str, antialiased: bool) -> None:
    """Some Gaussians are wide and at the cap of opacity, others far beyond the image's edge."""
    torch.manual_seed(0)
    given = scene(60)
    given[1][::12] += 4
    given[3][::12] = 12
    found = compared(given, camera(*size, lens, antialiased=antialiased), dtype=torch.float64)
    assert found.worst() < 1e-12
    assert found.share > 0.9


@needs_kernels
@pytest.mark.parametrize("lens", ["", "opencv", "fisheye"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
def test_images_and_gradients(lens: str, antialiased: bool, channels: int) -> None:
    torch.manual_seed(1)
    found = compared(scene(100), camera(43, 38, lens, antialiased=antialiased), channels)
    assert found.worst() < BOUND, found
    assert found.share > 0.95


@needs_kernels
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("harmonics", [0, 3, 8, 15])
def test_harmonics_of_each_degree(degree: int, harmonics: int) -> None:
    """Harmonics that are missing, or do not count yet, have neither effect nor gradient."""
    torch.manual_seed(2)
    given = scene(40, harmonics)
    assert compared(given, camera(20, 18), degree=degree).worst() < BOUND
    used = {0: 0, 1: 3, 2: 8, 3: 15}[degree]
    ours = leaves(given)
    (gradient,) = torch.autograd.grad(drawn(ours, camera(20, 18), degree=degree).image.sum(), ours[5])
    assert not gradient[..., used:].any()
    assert bool(gradient[..., : min(used, harmonics)].any()) == bool(min(used, harmonics))


@needs_kernels
@pytest.mark.parametrize("count", [31, 32, 33, 150])
def test_lists_that_end_before_and_behind_what_is_opaque(count: int) -> None:
    """Blocks of pixels are found for 32 entries of a list at a time, and end one by one where no light is left."""
    torch.manual_seed(11)
    given, view = scene(count), camera(37, 21)
    given[1] += 2
    given[3] += 2
    found = compared(given, view)
    assert found.worst() < 1e-3, found
    assert found.image < BOUND
    assert found.share > 0.5
    if count == 150:
        assert float(drawn(given, view).transmittance.amin()) < OPAQUE


@needs_kernels
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("antialiased", [False, True])
def test_sizes(size: tuple[int, int], antialiased: bool) -> None:
    torch.manual_seed(3)
    found = compared(scene(50), camera(*size, antialiased=antialiased))
    assert found.worst() < BOUND, found


@pytest.mark.medium
@needs_kernels
def test_random_scenes(threads: Callable[[int], None]) -> None:
    """Sizes, lenses, numbers, spreads and threads at random."""
    for seed in range(25):
        torch.manual_seed(seed)
        count, width, height, workers = (int(torch.randint(*ends, ())) for ends in ((1, 90), (1, 50), (1, 50), (1, 5)))
        antialiased, lens = bool(torch.rand(()) < 0.5), ("", "opencv", "fisheye")[int(torch.randint(3, ()))]
        threads(workers)
        given = scene(count, (0, 3, 8, 15)[seed % 4], 0.1 + 2 * float(torch.rand(())))
        given[1] += 3 * torch.rand(()) - 1.5
        view = camera(width, height, lens, antialiased=antialiased, blur=float(torch.rand(())) + 1e-3)
        found = compared(given, view, 3 + seed % 2, seed % 5 % 4)
        assert found.worst() < 5 * BOUND, (seed, found)


@needs_kernels
@pytest.mark.parametrize("lens", ["", "opencv", "fisheye"])
def test_what_the_channels_hold(lens: str) -> None:
    """Colours, distance and normals, transmittance and the median distance; fewer channels change no bit."""
    torch.manual_seed(4)
    given, view = scene(120), camera(45, 35, lens)
    truth = true_image(given, view)
    with torch.no_grad():
        found = drawn(given, view, 7, median=True)
        fewer = [drawn(given, view, channels) for channels in (3, 4)]
    known = truth.certain
    assert found.median is not None
    assert relative_error(found.image[known], truth.image[known]) < BOUND
    assert relative_error(found.transmittance[known], truth.transmittance[known]) < BOUND
    assert relative_error(found.median[known], truth.median[known]) < BOUND
    assert 0.1 < float((truth.median[known] > 0).float().mean()) < 0.95
    for image in fewer:
        assert torch.equal(image.image, found.image[..., : image.image.shape[-1]])
        assert torch.equal(image.transmittance, found.transmittance)
        assert image.median is None


@needs_kernels
def test_the_sum_of_the_pixels_absolute_gradients() -> None:
    """The columns ABSOLUTE_X and ABSOLUTE_Y have the sums of x and of y, whatever gradient comes from outside."""
    torch.manual_seed(5)
    given, view = scene(80), camera(37, 41)
    *parameters, pose = given
    records, _ = project_gaussians(*parameters, replace(view, pose=pose))
    records.requires_grad_()
    found = blend(records, tile_lists(records, 37, 41), 37, 41, BACKGROUND, 4)
    truth = true_image(leaves(given, torch.float64), view)
    (gradient,) = gradients(found.image, found.transmittance, truth.certain, [records])
    (of_offsets,) = gradients(truth.image[..., :4], truth.transmittance, truth.certain, [truth.offsets])
    order = drawn_indices(given, view)
    assert relative_error(gradient[order][:, [ABSOLUTE_X, ABSOLUTE_Y]], of_offsets.abs().sum(0)) < BOUND
    assert relative_error(gradient[order, :2], -of_offsets.sum(0)) < BOUND
    assert not gradient[:, Record.NORMAL_X :].any()


def drawn_indices(given: list[Tensor], view: SplatCamera) -> Tensor:
    """The Gaussians in front of the camera, nearest first."""
    p = given[0].double() @ given[6][:, :3].double().T + given[6][:, 3].double()
    order = p.norm(dim=-1).argsort()
    return order[p[order, 2] > view.near]


@needs_kernels
def test_the_background_shows_through() -> None:
    torch.manual_seed(6)
    given, view = scene(40), camera(30, 26)
    black, white = (drawn(given, view, background=color) for color in (torch.zeros(3), torch.ones(3)))
    for channel in range(3):
        torch.testing.assert_close((white.image - black.image)[..., channel], black.transmittance)
    assert torch.equal(white.image[..., 3], black.image[..., 3])
    assert bool((black.transmittance < 0.5).any())
    assert bool((black.transmittance > 0.5).any())


@needs_kernels
def test_the_same_bits_on_any_number_of_threads_and_again(threads: Callable[[int], None]) -> None:
    torch.manual_seed(7)
    given, view = scene(6000), camera(120, 90, "opencv", antialiased=True)
    given[1] -= 1

    def bits() -> list[Tensor]:
        ours = leaves(given)
        found = drawn(ours, view, 4, median=True)
        assert found.median is not None
        loss = found.image.square().sum() + found.transmittance.square().sum()
        return [found.image.detach(), found.transmittance.detach(), found.median, *torch.autograd.grad(loss, ours)]

    threads(1)
    expected = bits()
    assert all(bool(tensor.any()) for tensor in expected)
    for count in (1, 2, 3, 7):
        threads(count)
        for value, truth in zip(bits(), expected, strict=True):
            assert torch.equal(value, truth), count


@needs_kernels
def test_memory_in_another_order_and_gradients_of_some() -> None:
    torch.manual_seed(8)
    given, view = scene(50), camera(22, 19)
    expected = drawn(given, view)
    flipped = [tensor.t().contiguous().t() if tensor.ndim == 2 else tensor for tensor in given]
    flipped[5] = given[5].permute(2, 0, 1).contiguous().permute(1, 2, 0)
    found = drawn(flipped, view)
    assert torch.equal(found.image, expected.image)
    everything = leaves(given)
    records = project_gaussians(*everything[:6], replace(view, pose=everything[6]))[0]
    weights = torch.randn(50, 16)
    by_column = weights.t().contiguous().t()
    slopes = [torch.autograd.grad(records, everything, of, retain_graph=True) for of in (weights, by_column)]
    assert all(torch.equal(one, other) for one, other in zip(*slopes, strict=True))
    of_all = torch.autograd.grad(drawn(everything, view).image[..., :3].sum(), everything)
    for index, tensor in enumerate(given):
        alone = [*given[:index], tensor.clone().requires_grad_(), *given[index + 1 :]]
        (of_one,) = torch.autograd.grad(drawn(alone, view).image[..., :3].sum(), alone[index])
        assert torch.equal(of_one, of_all[index]), index


@needs_kernels
def test_gradients_of_image_and_transmittance_add_up() -> None:
    """Each alone, and both, are tested; the image's gradient has another order in memory."""
    torch.manual_seed(9)
    given, view = scene(50), camera(22, 19)
    ours = leaves(given)
    found = drawn(ours, view)
    weights = torch.randn(4, 22, 19).permute(2, 1, 0)
    image, through = (found.image * weights).sum(), (found.transmittance * weights[..., 0]).sum()
    both = torch.autograd.grad(image + through, ours, retain_graph=True)
    first = torch.autograd.grad(image, ours, retain_graph=True)
    second = torch.autograd.grad(through, ours)
    for whole, one, other in zip(both, first, second, strict=True):
        assert relative_error(one + other, whole) < BOUND


@needs_kernels
def test_nothing_is_read_that_was_not_written() -> None:
    """New memory is filled with NaN. Many entries of the lists are behind opaque ones, and many rows not visible."""
    torch.manual_seed(10)
    given, view = scene(1003), camera(37, 41, antialiased=True)
    given[1] += 1.5
    given[3] += 6

    def run() -> list[Tensor]:
        ours = leaves(given)
        found = drawn(ours, view, 4, degree=2, median=True)
        assert found.median is not None
        slopes = torch.autograd.grad(found.image.sum() + found.transmittance.sum(), ours)
        return [found.image.detach(), found.transmittance.detach(), found.median, *slopes]

    expected = run()
    torch.use_deterministic_algorithms(True)  # which fills memory, too
    try:
        filled = run()
    finally:
        torch.use_deterministic_algorithms(False)
    for value, truth in zip(filled, expected, strict=True):
        assert bool(value.isfinite().all())
        assert torch.equal(value, truth)
