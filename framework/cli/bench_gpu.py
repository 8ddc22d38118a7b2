"""The benchmark `ns-bench gpu`: every kernel on a GPU, and training there."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from nerfloom.base.errors import ConfigError
from nerfloom.cli.bench_results import RESULTS, write_results
from nerfloom.cli.common import make_room
from nerfloom.training.run_path import data_name

SETUP_SECONDS, STEPS_SECONDS = 30.0, 60.0
"""Expected seconds of a method's start and evaluation, and of the timed steps."""
WARM_UP_STEPS = 300
"""Training steps before the timed ones; CUDA graphs are captured during these steps."""


@dataclass(frozen=True)
class GpuFlags:
    """Measure kernels and training steps on a GPU, and its limits; train instant-ngp and gaussian-splatting.

    Without a GPU, --interpreter True computes the kernels' errors on the CPU.
    """

    interpreter: bool = False
    """Only compute the largest errors of the Triton kernels, in Triton's interpreter on the CPU."""

    data: Path | None = None
    """Folder of the data set. Default: the embedded scene."""
    seconds: float = 60.0
    """Seconds of training of each method."""
    samples: int = 2**18
    """Number of samples in a batch of the kernels."""
    repeats: int = 9
    """Number of runs of each kernel; the report gives medians."""
    steps: int = 200
    """Number of timed training steps of nerfacto and instant-ngp, with and without CUDA graphs."""
    limit: float = 480.0
    """Nothing new starts after these seconds. Kernels are skipped first, then whole parts; the report names them."""
    run_dir: Path | None = None
    """Folder of runs and report. Default: outputs/bench-gpu-DATA."""
    output_dir: Path = RESULTS
    """Folder of gpu-DATA.json, or of gpu-interpreter.json with --interpreter."""


def measure_gpu(flags: GpuFlags) -> None:
    """Run the benchmark by its `flags`.

    Raises:
        ConfigError: if there is no GPU that this PyTorch can use.
    """
    if flags.interpreter:
        _interpret(flags.output_dir / "gpu-interpreter.json")
        return
    import torch

    if not torch.cuda.is_available():
        raise ConfigError("ns-bench gpu: this machine or this PyTorch has no GPU; --interpreter needs none")
    from nerfloom.benchmarks.gpu import METHODS, Part, gpu_plan, in_time, measured_kernels, reached, timed_steps
    from nerfloom.cli.compare import compare

    name = data_name(flags.data)
    path = flags.output_dir / f"gpu-{name}.json"
    make_room(path)
    device = torch.device("cuda")
    plan = gpu_plan(flags.data, flags.seconds, flags.run_dir or Path("outputs") / f"bench-gpu-{name}")
    training = len(METHODS) * (flags.seconds + SETUP_SECONDS)
    parts = (
        Part(
            "kernels",
            0,
            lambda left: measured_kernels(device, flags.samples, flags.repeats, left - training - STEPS_SECONDS),
        ),
        Part("training", training, lambda left: {"training": reached(compare(plan))}),
        Part("CUDA graphs", STEPS_SECONDS, lambda left: {"steps": timed_steps(device, WARM_UP_STEPS, flags.steps)}),
    )
    in_time(parts, flags.limit, lambda found: write_results(path, found))


def _interpret(path: Path) -> None:
    if find_spec("triton") is None:
        raise ConfigError("ns-bench gpu --interpreter: Triton is not installed: pip install triton")
    from nerfloom.base.console import console
    from nerfloom.benchmarks.kernel_errors import as_table, interpreted
    from nerfloom.training.machine import machine

    make_room(path)
    rows = interpreted()
    console.print(as_table(rows))
    write_results(path, {"machine": machine(), "triton": version("triton"), "errors": [asdict(row) for row in rows]})
