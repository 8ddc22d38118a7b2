"""Structural similarity: the compiled sweep against its reference in float64, and against other implementations."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from nerfloom.evaluation import metrics
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import derivatives
from nerfloom.kernels.images.ssim import (
    WINDOW,
    photometric_loss,
    photometric_reference,
    similarity_reference,
    ssim,
    structure,
    windows_inside,
)
from tests.kernels.compiled import needs_kernels, relative_error

SIZES = [(11, 11, 1), (11, 11, 3), (11, 64, 3), (90, 11, 4), (12, 27, 1), (23, 16, 3), (70, 53, 3), (41, 37, 4)]
ssim_reference = partial(similarity_reference, counted=None, of_means=True)
TALL = (131, 45, 3)
"""Several bands on two threads; the last band is short."""


def smooth(height: int, width: int, channels: int) -> Tensor:
    """Return an image of waves in [0, 1], which has edges, slopes and nearly flat parts."""
    y, x = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 4, width), indexing="ij")
    phases = torch.arange(channels) * 0.7
    return ((y[..., None] + phases).sin() * (x * y)[..., None].cos() * 0.5 + 0.5).float()


def noisy(image: Tensor, amount: float) -> Tensor:
    return (image + amount * torch.randn_like(image)).clamp(0, 1)


def value_and_gradient(
    form: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor
) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    value = form(leaf, target)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach(), gradient


def compared(image: Tensor, target: Tensor) -> tuple[float, float]:
    """Return the errors of the value, and of the gradient relative to its largest, of `ssim` against float64."""
    value, gradient = value_and_gradient(ssim, image, target)
    truth, true_gradient = value_and_gradient(ssim_reference, image.double(), target.double())
    assert value.dtype == gradient.dtype == torch.float32
    assert value.shape == ()
    return abs(value.item() - truth.item()), relative_error(gradient, true_gradient)


@needs_kernels
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_value_and_gradient_of_noise(size: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    error, of_gradient = compared(torch.rand(size), torch.rand(size))
    assert error < 5e-7
    assert of_gradient < 2e-6


@needs_kernels
def test_value_and_gradient_of_random_sizes(threads: Callable[[int], None]) -> None:
    torch.manual_seed(1)
    for _ in range(40):
        height, width, channels, count = (
            int(torch.randint(*ends, ())) for ends in ((11, 120), (11, 90), (1, 6), (1, 5))
        )
        threads(count)
        target = smooth(height, width, channels)
        error, of_gradient = compared(noisy(target, 0.1), target)
        assert error < 1e-6, (height, width, channels, count)
        assert of_gradient < 1e-4, (height, width, channels, count)


@needs_kernels
@pytest.mark.parametrize("amount", [0.3, 0.03, 3e-3, 3e-4])
@pytest.mark.parametrize("flat", [None, 0.0, 0.5, 1.0])
def test_little_is_lost_near_flat_parts_and_near_the_target(amount: float, flat: float | None) -> None:
    """Variances are differences, and little of them would be left there."""
    torch.manual_seed(0)
    target = smooth(80, 75, 3) if flat is None else torch.full((80, 75, 3), flat)
    error, of_gradient = compared(noisy(target, amount), target)
    assert error < 1e-6
    assert of_gradient < 2e-4


@needs_kernels
def test_an_image_is_similar_to_itself() -> None:
    torch.manual_seed(0)
    for image in (torch.rand(TALL), smooth(*TALL), torch.zeros(TALL), torch.ones(TALL)):
        value, gradient = value_and_gradient(ssim, image, image)
        assert value.item() == 1
        assert not gradient.any()


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("amount", [0.0, 0.02, 0.5])
def test_the_value_is_the_metrics(size: tuple[int, int, int], amount: float) -> None:
    torch.manual_seed(0)
    target = smooth(*size)
    image = noisy(target, amount)
    assert ssim_reference(image.double(), target.double()).item() == pytest.approx(
        metrics.ssim(image, target), abs=1e-12
    )
    assert ssim(image, target).item() == pytest.approx(metrics.ssim(image, target), abs=1e-6)


def test_the_value_is_scikit_images() -> None:
    torch.manual_seed(0)
    target = smooth(61, 47, 3)
    image = noisy(target, 0.1)
    expected = structural_similarity(
        target.double().numpy(), image.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert ssim_reference(image.double(), target.double()).item() == pytest.approx(expected, abs=1e-9)
    assert ssim(image, target).item() == pytest.approx(expected, abs=1e-6)


@needs_kernels
@pytest.mark.parametrize("size", [TALL, (97, 19, 1), (260, 21, 4), (11, 30, 3)], ids=str)
def test_the_same_bits_on_any_number_of_threads(size: tuple[int, int, int], threads: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    image, target = torch.rand(size), torch.rand(size)
    threads(1)
    value, gradient = value_and_gradient(ssim, image, target)
    for count in (2, 3, 7):
        threads(count)
        found, found_gradient = value_and_gradient(ssim, image, target)
        assert torch.equal(found, value)
        assert torch.equal(found_gradient, gradient)


@needs_kernels
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("place", [(0, 0, 0), (60, 20, 1), (130, 44, 2), (66, 0, 2)])
def test_nan_and_infinity_stay_visible_and_stay_where_they_are(bad: float, place: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    image, target = torch.rand(TALL), torch.rand(TALL)
    image[place] = bad
    value, gradient = value_and_gradient(ssim, image, target)
    assert value.isnan()
    y, x, channel = place
    near = torch.zeros(TALL, dtype=torch.bool)  # in a window with it
    near[max(y - WINDOW + 1, 0) : y + WINDOW, max(x - WINDOW + 1, 0) : x + WINDOW, channel] = True
    assert torch.equal(gradient.isnan(), near)
    assert bool(gradient[~near].isfinite().all())


@needs_kernels
@pytest.mark.parametrize(("image", "target"), [(0.01, 1.0), (1.0, 0.01), (0.01, 0.01), (1.0, 1.0), (0.0, 1.0)])
@pytest.mark.parametrize("flat", [False, True])
def test_images_far_apart_dark_or_bright(image: float, target: float, flat: bool) -> None:
    torch.manual_seed(0)
    ones = torch.ones(80, 75, 3)
    error, of_gradient = compared(image * torch.rand_like(ones), target * (ones if flat else smooth(80, 75, 3)))
    assert error < 1e-6
    assert of_gradient < 3e-4


@needs_kernels
@pytest.mark.parametrize("scale", [10.0, 1e4, 1e8, 1e12])
def test_values_far_outside_the_range_are_dissimilar(scale: float) -> None:
    torch.manual_seed(0)
    value, gradient = value_and_gradient(ssim, scale * torch.rand(30, 40, 3), torch.rand(30, 40, 3))
    assert value.item() == pytest.approx(0, abs=2e-3)
    assert bool(gradient.isfinite().all())


@needs_kernels
def test_memory_in_another_order_and_incoming_gradients() -> None:
    torch.manual_seed(0)
    image, target = torch.rand(3, 40, 30).permute(1, 2, 0).requires_grad_(), torch.rand(30, 40, 3).transpose(0, 1)
    loss = 0.2 * (1 - ssim(image, target))
    (gradient,) = torch.autograd.grad(loss, image, retain_graph=True)
    _, expected = value_and_gradient(ssim, image.detach().contiguous(), target.contiguous())
    torch.testing.assert_close(gradient, -0.2 * expected)
    (again,) = torch.autograd.grad(loss, image)
    assert torch.equal(again, gradient)


@needs_kernels
def test_without_gradients_the_value_is_the_same() -> None:
    torch.manual_seed(0)
    image, target = torch.rand(TALL), torch.rand(TALL)
    value = ssim(image, target)
    assert not value.requires_grad
    assert torch.equal(value, value_and_gradient(ssim, image, target)[0])
    with torch.no_grad():
        assert torch.equal(ssim(image.requires_grad_(), target), value)


@pytest.mark.medium
def test_derivatives_of_the_reference() -> None:
    torch.manual_seed(0)
    image, target = (torch.rand(12, 11, 1, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(ssim_reference, (image, target))
    assert torch.autograd.gradgradcheck(ssim_reference, (image, target), fast_mode=True)


def test_second_derivatives_are_the_references() -> None:
    torch.manual_seed(0)
    image, target = torch.rand(12, 13, 2, requires_grad=True), torch.rand(12, 13, 2)
    with derivatives(2):
        (slope,) = torch.autograd.grad(ssim(image, target), image, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.square().sum(), image)
    assert bool(curvature.any())


@pytest.mark.parametrize(
    ("image", "target", "said"),
    [
        ((10, 30, 3), (10, 30, 3), "11x11 pixels, not 30x10"),
        ((30, 10, 3), (30, 10, 3), "11x11 pixels, not 10x30"),
        ((30, 30, 3), (30, 31, 3), "two images"),
        ((30, 30, 3), (30, 30), "two images"),
        ((30, 30), (30, 30), "two images"),
        ((30, 30, 0), (30, 30, 0), "two images"),
    ],
)
def test_what_is_refused(image: tuple[int, ...], target: tuple[int, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ssim(torch.zeros(image), torch.zeros(target))


@pytest.mark.parametrize("weight", [0.0, 0.2])
@pytest.mark.parametrize(("image", "target"), [((20, 20, 3), (20, 20, 1)), ((20, 20), (20, 20)), ((5, 5, 3), (5, 5))])
def test_a_loss_is_of_two_images_of_one_shape(image: tuple[int, ...], target: tuple[int, ...], weight: float) -> None:
    """Without a weight of SSIM, and of small images too: torch would repeat the smaller one."""
    with pytest.raises(ValueError, match="SSIM needs two images"):
        photometric_loss(torch.zeros(image), torch.zeros(target), weight)


@needs_kernels
@pytest.mark.parametrize("weight", [0.0, 0.2, 0.7, 1.0])
@pytest.mark.parametrize("size", [*SIZES, TALL], ids=str)
def test_the_loss_and_its_gradient(size: tuple[int, int, int], weight: float) -> None:
    torch.manual_seed(0)
    target = smooth(*size)
    image = noisy(target, 0.1)
    image[3:5] = target[3:5]  # where the absolute value has no slope, torch takes 0
    value, gradient = value_and_gradient(lambda x, y: photometric_loss(x, y, weight), image, target)
    truth, true_gradient = value_and_gradient(
        lambda x, y: photometric_reference(x, y, weight), image.double(), target.double()
    )
    assert value.item() == pytest.approx(truth.item(), abs=5e-7)
    assert relative_error(gradient, true_gradient) < 1e-4


def test_the_loss_of_one_flat_image_and_another_is_known() -> None:
    """Without variance, SSIM is (2 a b + C1) / (a^2 + b^2 + C1)."""
    a, b, weight = 0.75, 0.5, 0.2
    value = photometric_loss(torch.full((20, 30, 3), a), torch.full((20, 30, 3), b), weight)
    similarity = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert value.item() == pytest.approx(0.8 * 0.25 + 0.2 * (1 - similarity), abs=1e-7)


def test_the_loss_of_an_image_smaller_than_the_window_is_its_error() -> None:
    torch.manual_seed(0)
    image, target = torch.rand(10, 30, 3), torch.rand(10, 30, 3)
    assert photometric_loss(image, target, 0.2).item() == pytest.approx((image - target).abs().mean().item())


@needs_kernels
def test_the_loss_as_a_part_of_another() -> None:
    torch.manual_seed(0)
    image, target = torch.rand(30, 40, 3), torch.rand(30, 40, 3)
    _, alone = value_and_gradient(lambda x, y: photometric_loss(x, y, 0.2), image, target)
    _, tripled = value_and_gradient(lambda x, y: 3 * photometric_loss(x, y, 0.2) + x.sum(), image, target)
    torch.testing.assert_close(tripled, 3 * alone + 1)


@needs_kernels
@pytest.mark.parametrize("size", [(10, 11, 3), (11, 10, 3), (11, 11, 0)])
def test_the_kernel_refuses_too_small_images_itself(size: tuple[int, int, int]) -> None:
    kernel = native.Function("photometric", "ppqqqffpppi", "d")
    with pytest.raises(ValueError, match="SSIM needs 11x11 pixels"):
        kernel(None, None, *size, 1, 1e-4, None, None, None, 1)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("amount", [0.0, 0.02, 0.5])
def test_structure_is_similarity_without_the_means(size: tuple[int, int, int], amount: float) -> None:
    """Against scikit-image with its first constant so large that means, far below it, are all alike."""
    torch.manual_seed(0)
    target = smooth(*size)
    image = noisy(target, amount)
    expected = structural_similarity(
        target.double().numpy(), image.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, K1=1e6,
    )  # fmt: skip
    assert similarity_reference(image.double(), target.double(), None, False).item() == pytest.approx(
        expected, abs=1e-9
    )
    assert structure(image, target).item() == pytest.approx(expected, abs=1e-6)


def test_structure_does_not_see_another_brightness_and_sees_nan() -> None:
    target = smooth(40, 50, 3).double()
    assert structure(0.5 * target + 0.4, 0.5 * target).item() == pytest.approx(1, abs=1e-11)
    assert ssim(0.5 * target + 0.4, 0.5 * target).item() < 0.9
    target[3, 4, 1] = torch.nan
    assert structure(torch.rand(40, 50, 3), target.float()).isnan()


# -- Over some of the windows -----------------------------------------------------------------------------------------


def window_by_window(image: Tensor, target: Tensor, kept: Tensor, of_means: bool) -> float:
    """Wang et al. 2004 of one window after the other in float64, each of them of kept pixels alone."""
    taps = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    weights = (taps[:, None] * taps / taps.sum() ** 2)[..., None]
    found = []
    for row in range(image.shape[0] - 10):
        for column in range(image.shape[1] - 10):
            window = slice(row, row + 11), slice(column, column + 11)
            if not kept[window].all():
                continue
            x, y = image[window].double(), target[window].double()
            mean_x, mean_y = ((weights * each).sum((0, 1)) for each in (x, y))
            variances = (weights * ((x - mean_x) ** 2 + (y - mean_y) ** 2)).sum((0, 1))
            covariance = (weights * (x - mean_x) * (y - mean_y)).sum((0, 1))
            similar = (2 * covariance + 9e-4) / (variances + 9e-4)
            found.append(
                similar * (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4) if of_means else similar
            )
    return torch.stack(found).mean().item()


@pytest.mark.parametrize("size", [(11, 30, 3), (37, 26, 1), (45, 29, 4)], ids=str)
@pytest.mark.parametrize("of_means", [True, False])
def test_windows_with_ignored_pixels_do_not_count(size: tuple[int, int, int], of_means: bool) -> None:
    """The values in such pixels do not count either."""
    torch.manual_seed(0)
    target = smooth(*size)
    image = noisy(target, 0.2)
    kept = torch.ones(size[:2], dtype=torch.bool)
    kept[:, size[1] // 2 + 8 :] = False
    kept[size[0] - 1, 3] = kept[0, 9] = False
    expected = window_by_window(image, target, kept, of_means)
    image[~kept] = 7
    counted = windows_inside(kept)
    form = ssim if of_means else structure
    print(f"{int(counted.sum())} windows: off by {abs(form(image, target, counted).item() - expected):.1e}")
    assert form(image, target, counted).item() == pytest.approx(expected, abs=1e-6)
    exact = similarity_reference(image.double(), target.double(), counted, of_means)
    assert exact.item() == pytest.approx(expected, abs=1e-12)
    every = torch.ones_like(counted)
    assert form(target, target.flip(0), every).item() == pytest.approx(form(target, target.flip(0)).item(), abs=1e-7)


@needs_kernels
def test_some_windows_have_the_same_bits_on_any_number_of_threads(threads: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    image, target, counted = torch.rand(TALL), torch.rand(TALL), torch.rand(TALL[0] - 10, TALL[1] - 10) < 0.3
    threads(1)
    value = ssim(image, target, counted)
    for count in (2, 5):
        threads(count)
        assert torch.equal(ssim(image, target, counted), value)


def test_windows_that_do_not_fit_are_refused() -> None:
    image = torch.rand(20, 30, 3)
    with pytest.raises(ValueError, match="30x20 pixels"):
        ssim(image, image, torch.ones(20, 30, dtype=torch.bool))
    with pytest.raises(ValueError, match="at least one window that counts"):
        structure(image, image, torch.zeros(10, 20, dtype=torch.bool))


# -- With weights -----------------------------------------------------------------------------------------------------


def weighted_by_hand(image: Tensor, target: Tensor, weights: Tensor, ssim_weight: float) -> float:
    """Window by window in float64; a window has the least weight of its pixels."""
    errors = (image.double() - target.double()).abs() * weights.double()[..., None]
    dissimilar = []
    for row in range(image.shape[0] - 10):
        for column in range(image.shape[1] - 10):
            window = slice(row, row + 11), slice(column, column + 11)
            alone = window_by_window(image[window], target[window], torch.ones(11, 11, dtype=torch.bool), True)
            dissimilar.append(weights[window].min().double() * (1 - alone))
    return float((1 - ssim_weight) * errors.mean() + ssim_weight * torch.stack(dissimilar).mean())


@pytest.mark.medium
@pytest.mark.parametrize("size", [(11, 30, 3), (37, 26, 1), (23, 19, 4)], ids=str)
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_weights_of_pixels_and_of_windows(size: tuple[int, int, int], ssim_weight: float) -> None:
    torch.manual_seed(0)
    target, weights = smooth(*size), torch.rand(size[:2])
    image = noisy(target, 0.2)
    weights[:, size[1] - 3 :] = 0
    expected = weighted_by_hand(image, target, weights, ssim_weight)
    assert photometric_loss(image, target, ssim_weight, weights).item() == pytest.approx(expected, abs=1e-6)
    exact = photometric_reference(image.double(), target.double(), ssim_weight, weights.double())
    assert exact.item() == pytest.approx(expected, abs=1e-12)


@needs_kernels
@pytest.mark.parametrize("size", [*SIZES, TALL], ids=str)
def test_the_weighted_loss_and_its_gradient(size: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    target, weights = smooth(*size), torch.rand(size[:2])
    image = noisy(target, 0.1)
    weights[weights < 0.1] = 0
    weights[: size[0] // 3] = 1
    value, gradient = value_and_gradient(lambda x, y: photometric_loss(x, y, 0.2, weights), image, target)
    truth, true_gradient = value_and_gradient(
        lambda x, y: photometric_reference(x, y, 0.2, weights.double()), image.double(), target.double()
    )
    assert value.item() == pytest.approx(truth.item(), abs=5e-7)
    assert relative_error(gradient, true_gradient) < 1e-4


@pytest.mark.parametrize("kind", ["compiled", "reference"])
def test_pixels_without_a_weight_neither_tell_nor_learn(kind: str) -> None:
    torch.manual_seed(0)
    target = smooth(*TALL)
    image, weights = noisy(target, 0.2), torch.ones(TALL[:2])
    weights[20:50, 10:25] = 0
    form = photometric_loss if kind == "compiled" else photometric_reference
    found = []
    for other in (0.0, 1.0):
        target[20:50, 10:25] = other
        found.append(value_and_gradient(lambda x, y: form(x, y, 0.2, weights), image, target))
    (value, gradient), (again, same) = found
    assert torch.equal(value, again)
    assert torch.equal(gradient, same)
    assert not bool(gradient[20:50, 10:25].any())
    assert bool(gradient[weights == 1].any(-1).all())


@needs_kernels
def test_weights_of_one_have_the_bits_of_none(threads: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    image, target = torch.rand(TALL), torch.rand(TALL)
    for count in (1, 3):
        threads(count)
        plain = value_and_gradient(lambda x, y: photometric_loss(x, y, 0.2), image, target)
        weighted = value_and_gradient(lambda x, y: photometric_loss(x, y, 0.2, torch.ones(TALL[:2])), image, target)
        assert all(torch.equal(one, other) for one, other in zip(plain, weighted, strict=True))


def test_weights_that_do_not_fit_are_refused() -> None:
    image = torch.rand(20, 30, 3)
    with pytest.raises(ValueError, match=r"\(20, 30, 3\) needs weights of its pixels, not \(30, 20\)"):
        photometric_loss(image, image, 0.2, torch.ones(30, 20))
