"""Numbers of torch operations, and of waits for the device, in a training step in torch alone, as on a GPU.

They are counted on the CPU, by torch's dispatcher. All computed tensors are assumed to be on the device, except tensors
created without naming a device, and results of these alone.

An operation is a kernel call of the dispatcher; views and empty tensors are none. A wait is where Python
needs a value or a size from the device, or where the device needs a value of Python's: there is no work left for the
device until Python has gone on. Checks that are made on the CPU alone (`kernels.argument_checks`) are not counted.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from nerfloom.base import device as devices
from nerfloom.base.console import say
from nerfloom.data.dataset import Dataset
from nerfloom.registry import load_dataparser, load_method
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky, moving_ball
from nerfloom.training.machine import machine
from nerfloom.training.run import Run
from nerfloom.training.trainer import STEPS_PER_LOG, Trainer

METHODS = (
    "instant-ngp", "nerfacto", "kplanes", "tensorf", "gaussian-splatting", "vanilla-nerf", "dnerf", "mip-nerf",
    "mip-nerf-360", "zip-nerf", "nerf-plus-plus", "neus", "volsdf",
)  # fmt: skip
"""Methods counted by default."""
SCENES: dict[str, Callable[[int], Dataset]] = {
    "nerfacto": ball_under_a_sky,
    "dnerf": moving_ball,
    "mip-nerf-360": ball_under_a_sky,
    "zip-nerf": ball_under_a_sky,
    "nerf-plus-plus": ball_under_a_sky,
}
"""Scenes for methods that need more than a static one in a box."""
SIZE, IMAGE_SIZE = 64, 800
"""Width and height of the images, and the image size that methods choose their settings for, pixels."""
SMALLER: dict[str, Any] = {
    "num_rays_per_batch": 16,
    "samples_per_batch": 2**11,
    "log2_table_size": 12,
    "grid_resolution": 32,
    "hidden_width": 32,
    "base_resolution": 16,
    "first_voxels": 32**3,
    "num_gaussians": 600,
    "start_gaussians": 400,
    "start": "silhouettes",
    "few_images": False,
    "mixed_precision": False,
}
"""Settings that do not change the number of operations, but their time on the CPU; and settings that other machines and
data would decide differently."""
ON_A_GPU: dict[str, dict[str, Any]] = {"mip-nerf-360": {"encoding": "integrated"}}
"""Decisions that a method takes on a GPU, but not on the counting CPU."""
STARTS_NOTHING = {"empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "_unsafe_view"}
"""Operations other than views without work for a device."""
FACTORIES = {
    torch.arange, torch.as_tensor, torch.empty, torch.eye, torch.full, torch.from_numpy, torch.linspace, torch.ones,
    torch.rand, torch.randint, torch.randn, torch.randperm, torch.tensor, torch.zeros,
}  # fmt: skip
"""Functions with a result on the host unless a device is named."""
FROM_VALUES = {torch.tensor, torch.as_tensor, Tensor.new_tensor}
"""Functions that copy values from Python to a device."""
TO_HOST = {Tensor.cpu, Tensor.numpy, Tensor.tolist}
"""Functions that copy values from a device to Python."""
CPU_ONLY = "framework/kernels/argument_checks.py"
"""File of checks that other devices leave out."""
PACKAGES = Path(__file__).parents[1]
OURS = tuple(str(PACKAGES / name) for name in ("framework", "methods"))
"""Folders of code with named places."""
MAX_REPORTED = 5
"""Number of places with the most waits to report."""


@dataclasses.dataclass(frozen=True)
class Counted:
    """Operations and waits of some training steps."""

    steps: int
    """Number of steps."""
    operations: int
    """Total number of operations."""
    waits: Counter[str]
    """Number of waits by place: file and function."""

    def row(self, method: str) -> dict[str, Any]:
        """Return the means over the steps of a `method`, its name, as plain data."""
        places = {place: round(count / self.steps, 2) for place, count in self.waits.most_common(MAX_REPORTED)}
        return {
            "method": method,
            "operations": round(self.operations / self.steps),
            "waits": round(self.waits.total() / self.steps, 1),
            "most waits": places,
        }


def measure(methods: Sequence[str], before: int, steps: int) -> dict[str, Any]:
    """Count operations and waits of training steps of several methods, and print a line for each.

    Args:
        methods: names of the methods.
        before: uncounted initial training steps, while the occupancy grid finds empty space.
        steps: number of counted steps.

    Returns:
        The machine, the arguments and a row for each method, as plain data.
    """
    rows = []
    for method in methods:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(counted(trainer_of(method, Path(folder)), before, steps).row(method))
        say(f"{method:20s} {rows[-1]['operations']:6,} operations  {rows[-1]['waits']:6.1f} waits a step")
        for place, waits in rows[-1]["most waits"].items():
            say(f"{waits:12.2f} in {place}")
    return {"machine": machine(), "steps before": before, "steps": steps, "image size": SIZE, "rows": rows}


def trainer_of(method: str, folder: Path, scene: Callable[[int], Dataset] | None = None) -> Trainer:
    """Return a trainer of a method on images of a ball, with settings for larger images, but small tables and batches.

    Args:
        method: name of the method.
        folder: folder of the run's files.
        scene: function that returns images of a given width; None for images that suit the method.
    """
    declared = load_method(method)
    dataset = (scene or SCENES.get(method, ball_in_a_box))(SIZE)
    dataset = dataclasses.replace(
        dataset, scene=dataclasses.replace(dataset.scene, image_size=IMAGE_SIZE, image_pixels=IMAGE_SIZE**2)
    )
    names = {field.name for field in dataclasses.fields(declared.config)}
    smaller = {name: value for name, value in SMALLER.items() if name in names}
    config = dataclasses.replace(declared.config, vis="none", **smaller, **ON_A_GPU.get(method, {}))
    return Trainer.of(Run(method, config, "blender", load_dataparser("blender")(), folder), dataset)


def counted(trainer: Trainer, before: int, steps: int) -> Counted:
    """Run steps of a `trainer` on the CPU, and count operations and waits of the last `steps`, after `before`."""
    trainer.steps_per_read = STEPS_PER_LOG  # as on devices other than the CPU
    with patch.object(devices, "runs_ahead", lambda device: True):  # as on devices other than the CPU
        for _ in range(before):
            trainer.train_step()
        trainer.model.read_counts()  # as at regular intervals
        with Counting() as counting:
            for _ in range(steps):
                report = trainer.train_step()
                if report.step % STEPS_PER_LOG == 0:
                    sum(report.losses.values())
    return Counted(steps, counting.count, counting.waits)


class Counting(TorchDispatchMode):
    """Counts operations and waits in the forward and the backward pass."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        """Number of operations."""
        self.waits = Counter[str]()
        """Number of waits by place."""
        self._transfers = _Transfers(self.waits)

    def __enter__(self) -> Counting:
        super().__enter__()
        self._transfers.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._transfers.__exit__(*error)
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        tensors = _tensors((*args, *kwargs.values()))
        if tensors and all(map(_on_host, tensors)):
            _mark(out, True)
        elif (place := _place()) is not None:
            self.count += not func.is_view and func.overloadpacket.__name__ not in STARTS_NOTHING
            if _waits(func, args, kwargs):
                self.waits[place] += 1
        return out


class _Transfers(TorchFunctionMode):
    """Notices transfers between host and device, which do not reach the CPU's dispatcher, and adds them to `waits`."""

    def __init__(self, waits: Counter[str]) -> None:
        super().__init__()
        self.waits = waits

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        if func in FACTORIES and kwargs.get("device") is None:
            _mark(out, True)
            return out
        host = bool(args) and isinstance(args[0], Tensor) and _on_host(args[0])
        leaves = not host and (func in TO_HOST or (func is Tensor.to and "cpu" in args))
        arrives = host and func is Tensor.to and _names_a_device(args[1:], kwargs)
        if (leaves or arrives or (func in FROM_VALUES and not host)) and (place := _place()) is not None:
            self.waits[place] += 1
        if (leaves or arrives) and isinstance(out, Tensor):
            out = out.view_as(out) if out is args[0] else out  # a new object, because the argument stays on its device
            _mark(out, leaves)
        return out


def _names_a_device(args: Sequence[Any], kwargs: dict[str, Any]) -> bool:
    """Return whether the arguments of `Tensor.to` name a device, or a tensor on a device."""
    named = [*args, kwargs.get("device"), kwargs.get("other")]
    return any(isinstance(each, torch.device) or (isinstance(each, Tensor) and not _on_host(each)) for each in named)


def _waits(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> bool:
    """Return whether an operation's result has a size, or is a value, that Python needs."""
    name = func.overloadpacket.__name__
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):  # indexing by a mask counts its True elements
        return any(each.dtype in (torch.bool, torch.uint8) for each in _tensors(args[1]))
    if name == "repeat_interleave" and kwargs.get("output_size") is not None:
        return False
    return torch.Tag.data_dependent_output in func.tags or torch.Tag.dynamic_output_shape in func.tags


def _tensors(values: Any) -> list[Tensor]:
    """Return the tensors among values and in lists of values."""
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += _tensors(value)
    return found


def _mark(out: Any, host: bool) -> None:
    for tensor in _tensors([out]):
        tensor._is_on_host = host  # type: ignore[attr-defined]


def _on_host(tensor: Tensor) -> bool:
    return getattr(tensor, "_is_on_host", False)


def _place() -> str | None:
    """Return file and function of the innermost frame of our code; None for code that other devices skip."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(OURS) and file != __file__:
            place = Path(file).relative_to(PACKAGES).as_posix()
            return None if place == CPU_ONLY else f"{place}: {frame.f_code.co_name}"
        frame = frame.f_back
    return "elsewhere"
