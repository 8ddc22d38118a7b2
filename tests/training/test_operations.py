"""Operations and waits of a training step on torch alone: bounds, so that they cannot creep back."""

from collections import Counter
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.operations import METHODS, Counting, counted, trainer_of
from nerfloom.kernels import native
from nerfloom.training.optim import Adam
from nerfloom.training.step import backward
from tests.training.helpers import tiny_trainer

BOUNDS = {
    "instant-ngp": (600, 0.3),
    "nerfacto": (970, 0),
    "kplanes": (1030, 0.3),
    "tensorf": (770, 0.3),
    "gaussian-splatting": (1170, 1),
    "vanilla-nerf": (555, 0),
    "dnerf": (740, 0),
    "mip-nerf": (735, 0),
    "mip-nerf-360": (1270, 0),
    "zip-nerf": (1160, 0),
    "nerf-plus-plus": (1360, 0),
    "neus": (1550, 0.3),
    "volsdf": (1500, 0.3),
}
"""Operations and waits of a step: counted when this was written, plus a tenth more operations, because torch's releases
may differ. Marched samples take a fixed number of slots, so that only updates of the occupancy grid,
in every eighth or sixteenth step, ask how many cells they look at. Only for Gaussians, which change in number, is each
step checked to be finite. The choice of transparent pixels of a scene that moves would have a wait. In methods for
captures, some 100 operations find the starts of rays. In `neus` and `volsdf`, some 120 are the curvature term's, which
ends after 40 % of the budget."""


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch alone, as on a device that the kernels do not know."""
    monkeypatch.setattr(native, "available", lambda: False)
    monkeypatch.setattr(native, "has", lambda name: False)


def test_every_method_has_a_bound() -> None:
    assert set(BOUNDS) == set(METHODS)


@pytest.mark.medium
@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("method", METHODS)
def test_a_step_has_few_operations_and_hardly_waits(method: str, tmp_path: Path) -> None:
    found = counted(trainer_of(method, tmp_path), before=8, steps=4)  # the grid is updated in the first of them
    row = found.row(method)
    print(row)
    operations, waits = BOUNDS[method]
    assert row["operations"] <= operations
    assert row["waits"] <= waits, row["most waits"]
    assert row["operations"] > 0.7 * operations  # a bound that is far off holds nothing


def waits_of(function: object) -> Counter[str]:
    """Waits of a call, by place."""
    with Counting() as counting:
        function()  # type: ignore[operator]
    return counting.waits


ON_DEVICE = torch.rand(5)
MASK = ON_DEVICE > 0.5


@pytest.mark.parametrize(
    ("call", "waits"),
    [
        (lambda: ON_DEVICE.sum().item(), 1),
        (lambda: bool(MASK.any()), 1),
        (lambda: float(ON_DEVICE[0]), 1),
        (lambda: MASK.nonzero(), 1),
        (lambda: ON_DEVICE[MASK], 1),
        (lambda: ON_DEVICE[torch.arange(3, device=ON_DEVICE.device)], 0),
        (lambda: ON_DEVICE.masked_select(MASK), 1),
        (lambda: ON_DEVICE.unique(), 1),
        (lambda: ON_DEVICE.tolist(), 1),
        (lambda: ON_DEVICE.cpu(), 1),
        (lambda: ON_DEVICE.cpu().tolist(), 1),
        (lambda: ON_DEVICE.numpy(), 1),
        (lambda: torch.equal(ON_DEVICE, ON_DEVICE), 1),
        (lambda: torch.bincount(MASK.long()), 1),
        (lambda: torch.repeat_interleave(ON_DEVICE, MASK.long()), 1),
        (lambda: torch.repeat_interleave(ON_DEVICE, MASK.long(), output_size=int(MASK.sum())), 1),
        (lambda: ON_DEVICE.repeat_interleave(2), 0),
        (lambda: torch.tensor([1.0, 2.0], device=ON_DEVICE.device), 1),
        (lambda: ON_DEVICE.new_tensor([1.0, 2.0]), 1),
        (lambda: torch.rand(3).to(ON_DEVICE.device), 1),
        (lambda: torch.tensor([1.0, 2.0]).sum().item(), 0),
        (lambda: int(torch.randint(5, ())), 0),
        (lambda: torch.where(MASK, ON_DEVICE, 0).cumsum(0), 0),
    ],
)
def test_what_is_a_wait(call: object, waits: int) -> None:
    assert waits_of(call).total() == waits


def test_views_and_empty_tensors_are_no_operations_and_the_backward_pass_counts() -> None:
    values = torch.rand(4, 3, requires_grad=True)

    def product() -> Tensor:
        return (values.t()[:2] * torch.empty_like(values).t()[:2]).sum()

    with Counting() as forward:
        loss = product()
    assert forward.count == 2
    with Counting() as backward:
        loss.backward()
    assert backward.count >= 3  # the product's gradient, and its place in the gradient of all values


def test_errors_that_are_read_late_make_the_same_mean(shared_tiny: Path, tmp_path: Path) -> None:
    """Off the CPU, errors of batches stay on the device for some steps, and are read before a checkpoint."""
    now, late = (tiny_trainer("instant-ngp", shared_tiny, tmp_path / name) for name in ("now", "late"))
    late.steps_per_read = 4
    for step in range(1, 7):
        reports = [trainer.train_step() for trainer in (now, late)]
        assert reports[0].losses == reports[1].losses
        assert (late.state.train_mse == now.state.train_mse) == (step == 4)
    late.save()
    assert late.state.train_mse == now.state.train_mse


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_loss_is_found_bad_together_with_its_gradients(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Off the CPU it is not looked at before: the device is asked once. No gradient of it remains."""
    monkeypatch.setattr("nerfloom.training.step.is_bad_here", lambda loss: False)
    weight = torch.nn.Parameter(torch.ones(3))
    optimizer = Adam([{"params": [weight]}], {}, 1e-2, (0.9, 0.99), 1e-8)
    assert backward((weight * 2).sum(), optimizer)
    assert weight.grad is not None
    assert not backward((weight * bad).sum(), optimizer)
    assert weight.grad is None
    assert not backward(torch.tensor(bad), optimizer)
    assert backward(torch.tensor(1.0), optimizer)
    assert not backward((weight - 1).sqrt().sum(), optimizer)  # 0, with an infinite slope
    assert optimizer.first_bad() is weight
