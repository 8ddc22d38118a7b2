"""Growth by gradients: cloned, split and dropped Gaussians, and the gradients."""

import dataclasses
import math

import pytest
import torch

from nerfloom.kernels.splats.blend import ABSOLUTE_X, ABSOLUTE_Y
from nerfloom.kernels.splats.project import RECORD, Record
from nerfloom.splats.density_control import (
    CHILDREN,
    GRADIENT,
    MAX_CLONED_SIZE,
    MAX_DEAD_OPACITY,
    MAX_RESET_OPACITY,
    SHRUNK,
    DensityControl,
    grown,
    image_gradients,
)
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import RASTERISER, Projected
from tests.splats.test_method import ball, camera

EXTENT = 2.0


def row(count: int) -> Gaussians:
    """Opaque Gaussians, small enough to be cloned; their centres tell them apart."""
    torch.manual_seed(0)
    one = torch.ones(count)
    sizes = torch.full((count, 3), 0.5 * MAX_CLONED_SIZE * EXTENT).log()
    return Gaussians(
        torch.arange(count)[:, None] * torch.tensor([1.0, 0, 0]), sizes, torch.randn(count, 4), 2 * one,
        torch.randn(count, 3), torch.randn(count, 3, 3),
    )  # fmt: skip


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    given = row(5)
    given.log_scales[3, 1] = math.log(1.5 * MAX_CLONED_SIZE * EXTENT)
    gradients = torch.tensor([0.0, 2.0, 0.5, 2.0, 0.0]) * GRADIENT
    change = grown(given, gradients, 100, EXTENT)
    assert change is not None
    assert change.kept.tolist() == [0, 1, 2, 4]
    assert len(change.fresh) == 1 + CHILDREN
    for ours, theirs in zip(change.fresh[:1].columns.values(), given[1:2].columns.values(), strict=True):
        assert torch.equal(ours, theirs)
    children = change.fresh[1:]
    torch.testing.assert_close(children.log_scales.exp() * SHRUNK, given[[3, 3]].log_scales.exp())
    away = (children.means - given.means[3]).norm(dim=-1)
    assert (away > 0).all()
    assert (away < 6 * 1.5 * MAX_CLONED_SIZE * EXTENT).all()


def test_children_are_spread_as_their_parent_is() -> None:
    """Their centres have its covariance, within the error of 20,000 samples."""
    torch.manual_seed(1)
    turn = torch.tensor([[0.9, 0.1, -0.3, 0.2]])
    scales = torch.tensor([[0.1, 0.3, 0.02]])
    count = 10_000
    many = ball(rotations=turn, log_scales=scales.log())[torch.zeros(count, dtype=torch.long)]
    change = grown(many, torch.full((count,), 1.0), 10**6, EXTENT)
    assert change is not None
    from scipy.spatial.transform import Rotation

    axes = torch.tensor(Rotation.from_quat(turn[0].numpy(), scalar_first=True).as_matrix()).float()
    true = axes @ torch.diag(scales[0] ** 2) @ axes.T
    found = change.fresh.means.T.cov()
    assert float((found - true).abs().max()) < 0.05 * float(true.max())


def test_the_most_wanting_come_first_where_there_is_little_room() -> None:
    gradients = torch.tensor([3.0, 5.0, 2.0, 4.0]) * GRADIENT
    change = grown(row(4), gradients, 6, EXTENT)
    assert change is not None
    assert sorted(change.fresh.means[:, 0].tolist()) == [1.0, 3.0]
    assert grown(row(4), gradients, 4, EXTENT) is None
    assert grown(row(4), gradients, 2, EXTENT) is None  # no more than there may be already


def test_transparent_ones_and_those_that_are_not_finite_are_dropped() -> None:
    given = row(4)
    given.logits[1] = math.log(0.5 * MAX_DEAD_OPACITY)
    given.means[2, 0] = float("nan")
    change = grown(given, torch.full((4,), 2 * GRADIENT), 2, EXTENT)
    assert change is not None
    assert change.kept.tolist() == [0, 3]
    assert len(change.fresh) == 0


def test_a_reset_drops_nothing_by_itself() -> None:
    """What is transparent after a reset has some steps to become opaque again."""
    given = row(3)
    given = dataclasses.replace(given, logits=DensityControl(20).reset(given, 39)["logits"])
    assert grown(given, torch.zeros(3), 3, EXTENT) is None


@pytest.mark.parametrize(
    ("asked", "reset"),
    [([9, 19, 29, 39, 49, 59], [19, 39, 59]), ([7, 18, 26, 37, 48], [26, 48]), ([29, 39, 49], [39])],
)
def test_opacity_is_reset_once_in_a_period(asked: list[int], reset: list[int]) -> None:
    """Also where no change of the number falls on the period's last step; a run may begin in its middle."""
    control, given = DensityControl(20), row(3)
    assert [step for step in asked if control.reset(given, step)] == reset
    assert float(torch.sigmoid(control.reset(given, 79)["logits"]).max()) <= MAX_RESET_OPACITY * (1 + 1e-4)


def test_nothing_to_do() -> None:
    assert grown(row(3), torch.zeros(3), 100, EXTENT) is None


def test_absolute_gradients_do_not_cancel() -> None:
    """In the middle of a symmetric loss, the gradient of a Gaussian's position is 0; its halves' gradients are not."""
    one = splat_camera(camera(), 0.1)
    round_one = dataclasses.replace(ball(logit=0.0), log_scales=torch.full((1, 3), math.log(0.2)))
    records = RASTERISER.project(round_one, one).records.detach().requires_grad_()
    image = RASTERISER.draw(Projected(records), one, torch.zeros(3)).image
    halves = []
    for part in (image, image[:, :16], image[:, 17:]):
        (gradient,) = torch.autograd.grad(part.sum(), records, retain_graph=True)
        halves.append(gradient)
    whole, left, right = halves
    assert float(whole[0, Record.X].abs()) < 1e-3 * float(left[0, Record.X].abs())
    assert float(left[0, Record.X]) == pytest.approx(-float(right[0, Record.X]), rel=1e-3)
    assert float(image_gradients(whole, 33)[0]) > 10 * float(left[0, Record.X].abs())


def test_gradients_are_of_an_image_of_two_units() -> None:
    gradient = torch.zeros(2, RECORD)
    gradient[1, ABSOLUTE_X], gradient[1, ABSOLUTE_Y] = 3.0, 4.0
    assert image_gradients(gradient, 20).tolist() == [0.0, 50.0]


def test_what_is_drawn_of_it() -> None:
    """A picture of an opaque ball is bright in its middle, which the other tests rely on."""
    picture = draw_colors(ball(), splat_camera(camera(), 0.1), 1, torch.zeros(3))
    assert float(picture[16, 16, 0]) > 0.7
