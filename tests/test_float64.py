"""Operations on MPS use no float64, which MPS lacks, except through `exact`, which moves it to the CPU.

There is no MPS here: each operation of a run is watched instead, on the CPU.
"""

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from nerfloom.base.device import to_float64
from nerfloom.kernels import native
from nerfloom.kernels.adam.adam import sparse_adam_reference
from tests.training.helpers import TINY, tiny_trainer


class Watched(TorchDispatchMode):
    """Refuses operations that would make float64 on a device, or mix tensors of `exact` with tensors that stayed."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        out = func(*args, **(kwargs or {}))
        away = [x for x in given if x.dtype is torch.float64]
        made = [x for x in tree_leaves(out) if isinstance(x, Tensor) and x.dtype is torch.float64]
        assert away or not made, f"{func} makes float64"
        moved = {"_to_copy", "copy_", "scatter", "index"} & {func.overloadpacket.__name__}
        if away and not moved:
            assert all(x.dtype is not torch.float32 or x.ndim == 0 for x in given), f"{func} mixes devices"
        return out


def taken_away(values: Tensor) -> Tensor:
    """`exact`, unwatched."""
    with torch.utils._python_dispatch._disable_current_modes():
        return to_float64(values)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch alone, as on a device that the kernels do not know."""
    monkeypatch.setattr(native, "available", lambda: False)
    for name in ("nerfloom.evaluation.metrics", "nerfloom.kernels.histograms.step_functions"):
        monkeypatch.setattr(importlib.import_module(name), "to_float64", taken_away)


def test_the_watch_sees_float64() -> None:
    with Watched(), pytest.raises(AssertionError, match="makes float64"):
        torch.ones(3).double()
    with Watched(), pytest.raises(AssertionError, match="makes float64"):
        torch.zeros(3, dtype=torch.float64)
    with Watched(), pytest.raises(AssertionError, match="mixes devices"):
        taken_away(torch.ones(3)) * torch.ones(3)


@pytest.mark.medium
@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("kind", TINY)
def test_a_step_of_each_method(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    """And the silhouettes, the schedule, and a picture with its PSNR and SSIM."""
    settings = {"max_num_iterations": 2, "steps_per_eval_all_images": 2, "max_eval_images": 1}
    trainer = tiny_trainer(kind, shared_tiny, tmp_path, True, **settings)
    with Watched():
        trainer.train()
    assert trainer.state.step == 2


def test_exact_leaves_a_processors_values_where_they_are() -> None:
    values = torch.rand(3)
    assert to_float64(values).dtype is torch.float64
    assert torch.equal(to_float64(values).float(), values)
    moved = Elsewhere()
    assert to_float64(moved) is moved  # type: ignore[arg-type, comparison-overlap]
    assert moved.asked == ["cpu", "double"]


@dataclasses.dataclass
class Elsewhere:
    """A tensor on MPS, with the attributes that `exact` reads."""

    device: Any = dataclasses.field(default_factory=lambda: torch.device("mps"))
    asked: list[str] = dataclasses.field(default_factory=list)

    def cpu(self) -> "Elsewhere":
        self.asked.append("cpu")
        return self

    def double(self) -> "Elsewhere":
        self.asked.append("double")
        return self


@pytest.mark.parametrize("beta", [0.0, 0.9, 0.999])
def test_adams_corrections_keep_their_digits_in_float32(beta: float) -> None:
    """They equal float64's for the first update and the millionth."""
    counts = torch.tensor([0.0, 9.0, 999.0, 999_999.0])
    found = []
    for kind in (torch.float32, torch.float64):
        values, moments = torch.zeros(4, 1, dtype=kind), [torch.full((4, 1), 0.5, dtype=kind) for _ in range(2)]
        sparse_adam_reference(
            values, torch.full((4, 1), 0.5, dtype=kind), *moments, counts.to(kind, copy=True), 1.0, (beta, 0.99), 1e-8
        )
        found.append(values.double())
    torch.testing.assert_close(*found, rtol=1e-6, atol=0)
