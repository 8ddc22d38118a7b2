"""A step of nerfacto on a device that has no values: Python reads nothing from it, and brings it nothing but numbers.

The device is PyTorch's "meta". Its tensors have sizes alone: to read a value is an error, and so is to compute with
tensors of the CPU.
"""

from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.operations import Counting, _tensors
from nerfloom.base.device import StepValue, runs_ahead, seed_step
from nerfloom.losses.functions import depth_error
from nerfloom.methods.tensorf import TensoRF
from nerfloom.scene.covisible_space import CovisibleSpace
from nerfloom.training.trainer import Trainer
from tests.training.test_graphs import VARIANTS, mark_of, small

NOWHERE = torch.device("meta")


class Arrivals(TorchDispatchMode):
    """Counts operations that bring tensors of the CPU to another device."""

    def __init__(self) -> None:
        super().__init__()
        self.found = Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        given = [tensor for tensor in _tensors((*args, *(kwargs or {}).values())) if tensor.ndim]
        if any(tensor.is_meta for tensor in _tensors([out])) and any(tensor.is_cpu for tensor in given):
            self.found[str(func)] += 1
        return out


@pytest.mark.parametrize("variant", [pytest.param(name, marks=mark_of(name)) for name in VARIANTS])
def test_a_step_neither_asks_the_device_nor_brings_it_tensors(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *words, **settings: nullcontext())  # which meta does not have

    def updated(*lists: list[Tensor], lr: Any, found_inf: Any, **settings: Any) -> None:
        assert all(tensor.device == NOWHERE for values in (*lists, [lr, found_inf]) for tensor in values)

    monkeypatch.setattr(torch, "_fused_adam_", updated)  # likewise
    here = small(tmp_path, **VARIANTS[variant])
    assert here.train_set.resident
    trainer = Trainer(here.method, here.config, here.train_set.to(NOWHERE))
    assert trainer.device == NOWHERE
    assert trainer.steps_per_read > 20
    monkeypatch.setattr(CovisibleSpace, "exclude", lambda *cells: None)  # before the first step it may wait
    for part in trainer.model.modules():  # reads it once, after loading
        if isinstance(part, TensoRF):
            part._growths.change(part.growths, 0.0)
    trainer.train_step()  # brings constants
    with Arrivals() as arrivals, Counting() as counting:
        for _ in range(3):
            trainer.train_step()
    assert counting.count > 1000
    assert not arrivals.found
    assert not counting.waits
    assert len(trainer._unread) == 4
    with pytest.raises(RuntimeError, match="meta tensor"):  # as a step would, if it read its error
        trainer._read_errors(4)


def test_what_arrives_is_noticed() -> None:
    """The test above can fail."""
    with Arrivals() as arrivals:
        torch.ones(3).to(NOWHERE)
    assert arrivals.found.total() == 1
    with pytest.raises(RuntimeError):
        torch.ones(3, device=NOWHERE) + torch.ones(3)


def test_a_number_of_a_step_is_a_float_here_and_one_tensor_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu, value = torch.device("cpu"), StepValue(0.5)
    assert [runs_ahead(device) for device in (cpu, NOWHERE)] == [False, True]
    assert value.on(cpu) == 0.5
    there = value.on(NOWHERE)
    value.set(0.25)
    assert value.on(NOWHERE) is there
    assert value.on(cpu) == 0.25
    monkeypatch.setattr("nerfloom.base.device.runs_ahead", lambda device: True)
    tensor = StepValue(0.5)
    before = tensor.on(cpu)
    tensor.set(0.75)
    assert isinstance(before, Tensor)
    assert float(before) == 0.75


def test_draws_of_a_step_depend_on_seed_step_and_process_alone() -> None:
    """They do not depend on earlier draws; a GPU uses the same seeds, and Philox's counter of draws since."""

    def draws(seed: int, step: int, rank: int, before: int = 0) -> Tensor:
        torch.rand(before)
        seed_step(seed, step, rank)
        return torch.rand(1000)

    assert torch.equal(draws(3, 5, 1), draws(3, 5, 1, before=77))
    others = [draws(*numbers) for numbers in ((3, 5, 1), (4, 5, 1), (3, 6, 1), (3, 5, 0), (3, 5, 2))]
    for index, one in enumerate(others):
        for other in others[:index]:
            assert abs(float(torch.corrcoef(torch.stack([one, other]))[0, 1])) < 0.15


def test_depths_that_are_not_known_do_not_count() -> None:
    """The loss is the mean over the rays with a known distance, from the definition; 0 if none is known."""
    from nerfloom.geometry.rays import Samples

    torch.manual_seed(0)
    t = torch.rand(4, 6).sort(-1).values + 1
    samples = Samples.regular(t[:, :-1], t[:, 1:])
    weights = torch.rand(20, requires_grad=True)
    known = torch.tensor([1.5, 0.0, 1.2, 0.0])
    terms = weights.view(4, 5) * ((samples.t.view(4, 5) - known[:, None]).abs() / known[:, None]).clamp(max=1)
    truth = (terms[0].sum() + terms[2].sum()) / 2
    found = depth_error(weights, samples, known)
    torch.testing.assert_close(found, truth)
    found.backward()
    assert weights.grad is not None
    assert not weights.grad.view(4, 5)[[1, 3]].any()
    assert float(depth_error(weights, samples, torch.zeros(4)).detach()) == 0
