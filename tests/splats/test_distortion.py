"""The distortion of drawn Gaussians: its moments against pairs, its pictures, and its effect in training."""

import dataclasses

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.gaussian_model import DISTORTION_FROM
from nerfloom.kernels.splats.project import Record, SplatCamera
from nerfloom.losses.depth_distortion import image_distortion
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.moments import with_moments
from nerfloom.splats.rasteriser import RASTERISER
from tests.splats.test_flat import photograph
from tests.splats.test_method import ball, camera
from tests.splats.test_what_images_differ_in import model_of, scattered

UNIT = torch.tensor(1.5)


def pairs(weights: Tensor, places: Tensor) -> Tensor:
    """The distortion (...) of weights and places (..., N), by pairs."""
    apart = (places[..., :, None] - places[..., None, :]).square()
    return (weights[..., :, None] * weights[..., None, :] * apart).sum((-1, -2)) / 2


def small_camera() -> SplatCamera:
    """An image of 9 x 9 pixels."""
    size = torch.tensor([9])
    return splat_camera(
        Cameras(camera().camera_to_worlds, *(torch.tensor([v]) for v in (10.0, 10.0, 4.5, 4.5)), size, size), 0.1
    )


def behind_each_other(kind: torch.dtype = torch.float64) -> Gaussians:
    """Four half transparent Gaussians near the axis, and one that the camera does not see."""
    torch.manual_seed(3)
    means = torch.tensor([[0.0, 0.05, 0.4], [0.1, 0.0, 0.1], [-0.1, 0.0, -0.2], [0.0, -0.1, -0.5], [0.0, 0.0, 9.0]])
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.1 * torch.randn(5, 4)
    sizes = torch.tensor([[0.5, 0.4, 0.3]]).log().repeat(5, 1)
    gaussians = Gaussians(means, sizes, turn, torch.linspace(-1, 1, 5), torch.zeros(5, 3), torch.zeros(5, 3, 0))
    return gaussians.map(lambda values: values.to(kind))


def drawn(gaussians: Gaussians, view: SplatCamera) -> Tensor:
    """The distortion () of an image of Gaussians."""
    shown = with_moments(RASTERISER.project(gaussians, view), UNIT.to(gaussians.means))
    found = RASTERISER.draw(shown, view, torch.zeros(3).to(gaussians.means))
    return image_distortion(found.image[..., :2], found.transmittance)


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_moments_are_the_sum_over_pairs(shift: float) -> None:
    """Wherever places are counted from; pixels that do not count are left out of the mean."""
    torch.manual_seed(0)
    weights, places = torch.rand(4, 5, 7, dtype=torch.float64) / 7, torch.randn(4, 5, 7, dtype=torch.float64)
    truth, m = pairs(weights, places), places + shift
    moments, through = torch.stack([(weights * m).sum(-1), (weights * m * m).sum(-1)], -1), 1 - weights.sum(-1)
    assert float(image_distortion(moments, through)) == pytest.approx(float(truth.mean()), rel=1e-9)
    kept = torch.rand(4, 5) < 0.5
    assert float(image_distortion(moments, through, kept)) == pytest.approx(float(truth[kept].mean()), rel=1e-9)
    assert float(image_distortion(moments, through, torch.zeros(4, 5, dtype=torch.bool))) == 0


@pytest.mark.parametrize("kind", [torch.float64, torch.float32])
def test_what_is_drawn_is_the_sum_over_pairs_of_gaussians(kind: torch.dtype) -> None:
    """The weight of each Gaussian in a pixel is its image alone in white, among black ones."""
    gaussians, view = behind_each_other(kind), small_camera()
    with torch.no_grad():
        records = RASTERISER.project(gaussians, view)
        shown = (records.records[:, Record.CUT] > 0).tolist()
        assert shown == [True] * 4 + [False]
        weights = []
        for index in range(5):
            colored = records.records.clone()
            colored[:, Record.RED : Record.DISTANCE] = 0
            colored[index, Record.RED] = 1
            image = RASTERISER.draw(records._replace(records=colored), view, torch.zeros(3, dtype=kind)).image
            weights.append(image[..., 0].double())
        places = -float(UNIT) / records.records[:4, Record.DISTANCE].double()
        truth = pairs(torch.stack(weights[:4], -1), places).mean()
        found = drawn(gaussians, view)
    assert float(truth) > 1e-5
    assert float(found) == pytest.approx(float(truth), rel=1e-9 if kind == torch.float64 else 1e-4)


def test_it_has_the_gradient_of_finite_differences() -> None:
    """The gradients by positions, opacities and sizes are compared, in float64."""
    still, view = behind_each_other(), small_camera()
    leaves = [values.clone().requires_grad_() for values in (still.means, still.logits, still.log_scales)]

    def distortion(means: Tensor, logits: Tensor, log_scales: Tensor) -> Tensor:
        return drawn(dataclasses.replace(still, means=means, logits=logits, log_scales=log_scales), view)

    # The mean that is subtracted from places has no gradient; the distortion does not depend on it.
    assert torch.autograd.gradcheck(distortion, leaves, nondet_tol=1e-9, check_undefined_grad=False, fast_mode=True)


def test_compiled_gradients_are_those_of_float64() -> None:
    view, found = small_camera(), []
    for kind in (torch.float32, torch.float64):
        still = behind_each_other(kind)
        leaves = [values.clone().requires_grad_() for values in (still.means, still.logits)]
        value = drawn(dataclasses.replace(still, means=leaves[0], logits=leaves[1]), view)
        found.append([each.double() for each in torch.autograd.grad(value, leaves)])
    for single, exact in zip(*found, strict=True):
        assert float((single - exact).abs().max()) < 2e-3 * float(exact.abs().max())


def test_gaussians_that_nobody_sees_have_none() -> None:
    gaussians = behind_each_other(torch.float32)
    away = dataclasses.replace(gaussians, means=(gaussians.means + torch.tensor([0.0, 0.0, 20.0])).requires_grad_())
    value = drawn(away, small_camera())
    value.backward()
    assert float(value.detach()) == 0
    assert away.means.grad is not None
    assert not away.means.grad.any()  # NaN would count


def test_it_counts_after_its_share_of_the_budget_and_leaves_colours_alone() -> None:
    plain, gathered = (model_of(scattered(), camera(), distortion_loss_mult=weight) for weight in (0.0, 10.0))
    plain.progress = 1.0
    assert "distortion" not in plain.loss(photograph(), 0).terms
    for progress, expected in ((0.0, False), (DISTORTION_FROM, True), (1.0, True)):
        gathered.progress = progress
        terms = gathered.loss(photograph(), 0).terms
        assert ("distortion" in terms) is expected
        torch.testing.assert_close(terms["rgb"], plain.loss(photograph(), 0).terms["rgb"])
    twice = model_of(scattered(), camera(), distortion_loss_mult=20.0)
    twice.progress = 1.0
    assert float(twice.loss(photograph(), 0).terms["distortion"]) == pytest.approx(2 * float(terms["distortion"]))


def test_two_sheets_come_together() -> None:
    """Two half transparent discs, one behind the other, in steps of a twentieth of their distance each."""
    means = torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, -0.2]])
    two = dataclasses.replace(Gaussians.joined([ball(), ball()]), means=means, logits=torch.zeros(2))
    model = model_of(two, camera(), distortion_loss_mult=1.0)
    model.progress = 1.0
    values = model.columns["means"].values
    before = float((values[0] - values[1])[2].detach())
    optimizer = torch.optim.Adam([values], lr=0.05 * before)
    for step in range(4):
        optimizer.zero_grad()
        model.loss(photograph(), step).terms["distortion"].backward()
        optimizer.step()
    after = float((values[0] - values[1])[2].detach())
    print(f"apart by {before:.3f}, then by {after:.3f}")
    assert 0.5 * before < after < 0.8 * before
