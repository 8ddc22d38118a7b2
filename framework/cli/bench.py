"""The command `ns-bench`: benchmarks of kernels, training steps, pictures and methods on this machine."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

from nerfloom.base.child import python_command
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError, nearest
from nerfloom.cli.bench_flags import FramesFlags, KernelFlags, MethodFlags, ProfileFlags
from nerfloom.cli.bench_gpu import GpuFlags, measure_gpu
from nerfloom.cli.bench_results import run_benchmark, write_results
from nerfloom.cli.common import entry_point, make_room
from nerfloom.training.run_path import data_name

USAGE = """\
usage: ns-bench WHAT [flags]

  kernels          time and error of every compiled kernel against torch, and the machine's measured limits
  gpu              the same on a GPU, steps as CUDA graphs, and PSNR after 2 to 60 seconds, in less than eight minutes
  methods          time to each PSNR of every built-in method, on the embedded scene or on --data
  profile-step     time of each compiled kernel in a training step, and of Python and torch
  frames           pictures per second of runs and files, at several sizes and numbers of threads

ns-bench WHAT --help shows its flags. Results are written as JSON to docs/results in the working folder, or to
--output-dir or --output.
"""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-bench on the `arguments` of the process."""
    run_benchmark("ns-bench", arguments, KINDS, USAGE)


def _kernels(flags: KernelFlags) -> None:
    from nerfloom.kernels import native

    for name in flags.variants:
        if name not in native.NEEDS:
            raise FlagError(f"--variants: there is no '{name}'. {nearest(name, native.NEEDS)}")
        command = python_command("nerfloom.cli.bench", "kernels", "--output-dir", flags.output_dir)
        command += ["--samples", str(flags.samples), "--repeats", str(flags.repeats)]
        command += ["--plot-dir", str(flags.plot_dir)] if flags.plot_dir else []
        if subprocess.run(command, env={**os.environ, "NERFLOOM_KERNELS": name}).returncode:
            raise ConfigError(f"measuring the kernels' variant {name} failed; the lines above say why")
    if not flags.variants:
        from nerfloom.benchmarks import bars
        from nerfloom.benchmarks.kernels import measure

        rows, content = measure(flags.samples, flags.repeats)
        name = f"kernels-{native.variant()}"
        write_results(flags.output_dir / f"{name}.json", content)
        most = max(row.threads for row in rows)
        if flags.plot_dir:
            bars.draw([row for row in rows if row.threads == most], flags.plot_dir / f"{name}.png")


def _methods(flags: MethodFlags) -> None:
    from nerfloom.benchmarks.methods import draw, published, standard_plan
    from nerfloom.cli.compare import compare

    name = data_name(flags.data)
    folder = flags.run_dir or Path("outputs") / f"bench-{name}"
    rows = compare(standard_plan(flags.data, flags.max_seconds, flags.repeats, folder))
    write_results(flags.output_dir / f"methods-{name}.json", published(folder))
    if flags.plot_dir:
        draw(rows, flags.plot_dir / f"methods-{name}.svg")
    failed = [row.label for row in rows if row.failures]
    if failed:
        raise ConfigError(f"these methods failed: {', '.join(failed)}; {folder / 'report.html'} says why")


def _profile(flags: ProfileFlags) -> None:
    from nerfloom.benchmarks.profile_step import measure
    from nerfloom.benchmarks.results import add_row
    from nerfloom.cli.train import run_of
    from nerfloom.comparison.plan import split_method

    method, own = split_method(flags.method, "--method")
    path = flags.output_dir / "profile-step.json"
    make_room(path)
    run = run_of(method, [*own, "--data", str(flags.data)])
    add_row(path, flags.method, measure(run, flags.steps, flags.max_seconds))


def _frames(flags: FramesFlags) -> None:
    import dataclasses

    import torch

    from nerfloom.benchmarks.frames import measure
    from nerfloom.training.machine import machine

    if not flags.runs or min(*flags.widths, 8) < 8 or min(*flags.threads, 1) < 1 or flags.pictures < 1:
        raise FlagError(
            "--runs: name trained runs or files; --widths are at least 8, --threads and --pictures at least 1"
        )
    make_room(flags.output)
    rows = [row for run in flags.runs for row in measure(run, flags.widths, flags.threads, flags.pictures, flags.data)]
    for row in rows:
        say(
            f"{row.run} {row.method} {row.width}x{row.height}, {row.threads} threads: {row.per_second:.1f} pictures a "
            f"second ({1e3 * row.median:.1f} ms, at most {1e3 * row.slowest:.1f})"
        )
    content = {"machine": machine(torch.device("cpu")), "frames": [dataclasses.asdict(row) for row in rows]}
    write_results(flags.output, content)


KINDS: dict[str, tuple[type, Any]] = {
    "kernels": (KernelFlags, _kernels),
    "gpu": (GpuFlags, measure_gpu),
    "methods": (MethodFlags, _methods),
    "profile-step": (ProfileFlags, _profile),
    "frames": (FramesFlags, _frames),
}


if __name__ == "__main__":
    main()
