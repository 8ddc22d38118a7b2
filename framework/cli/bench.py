"""ns-bench: measurements that anybody can repeat, of kernels, of sampling, of methods."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.base.child import python_command
from framework.base.console import say
from framework.base.errors import ConfigError, nearest
from framework.cli.common import chosen_kind, run_command

USAGE = """\
usage: ns-bench WHAT [flags]

  kernels       time and error of every compiled kernel against torch, beside what the machine can do at all
  quadrature    error against field evaluations of every sampler, on scenes whose integral is known
  methods       time to each PSNR of every built-in method, on the embedded scene or on --data

ns-bench WHAT --help shows its flags. Results are JSON, in benchmarks/results unless --output-dir says otherwise.
"""
RESULTS = Path("benchmarks/results")


@dataclass(frozen=True)
class KernelFlags:
    """Time per sample and error of each compiled kernel against its torch reference, in alternating runs."""

    samples: int = 2**15
    """Samples in a batch."""
    repeats: int = 9
    """Runs of which medians are taken."""
    variants: tuple[str, ...] = ()
    """Instruction sets, each measured in a process of its own, as in avx2 avx512; the fastest if not given."""
    output_dir: Path = RESULTS
    """Where kernels-VARIANT.json goes."""
    plot_dir: Path | None = None
    """Where a picture of the times goes; none if not given."""


@dataclass(frozen=True)
class QuadratureFlags:
    """Error of the rendered colour against field evaluations a ray, for every sampler, where the truth is known."""

    quick: bool = False
    """Fewer rays and counts: a minute instead of ten."""
    seed: int = 0
    """Of rays, jitter and proposals."""
    output_dir: Path = RESULTS
    """Where quadrature.json goes."""
    plot_dir: Path | None = None
    """Where pictures of the curves go; none if not given."""


@dataclass(frozen=True)
class MethodFlags:
    """Train every built-in method on one data set for the same time; a comparison as by ns-compare."""

    data: Path | None = None
    """Folder of the data set. The embedded scene if not given."""
    max_seconds: float = 120.0
    """Seconds of training of each method."""
    repeats: int = 1
    """Seeds."""
    run_dir: Path | None = None
    """Where runs and report go; outputs/bench-DATA if not given."""
    output_dir: Path = RESULTS
    """Where methods-DATA.json goes."""
    plot_dir: Path | None = None
    """Where a picture of time against error goes; none if not given."""


def main() -> None:
    """The ns-bench command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, KINDS, USAGE, "there is no benchmark")) is None:
        return
    import tyro

    name, (flags, run), rest = chosen
    run(tyro.cli(flags, prog=f"ns-bench {name}", args=rest, config=(tyro.conf.FlagConversionOff,)))


def _kernels(flags: KernelFlags) -> None:
    from framework.kernels import native

    for name in flags.variants:
        if name not in native.NEEDS:
            raise ConfigError(f"--variants: there is no '{name}'. {nearest(name, native.NEEDS)}")
        command = python_command("framework.cli.bench", "kernels", "--output-dir", flags.output_dir)
        command += ["--samples", str(flags.samples), "--repeats", str(flags.repeats)]
        command += ["--plot-dir", str(flags.plot_dir)] if flags.plot_dir else []
        if subprocess.run(command, env={**os.environ, "NERFLOOM_KERNELS": name}).returncode:
            raise ConfigError(f"measuring the kernels' variant {name} failed; the lines above say why")
    if not flags.variants:
        from framework.tools.benchmarks import bars
        from framework.tools.benchmarks.kernels import measure

        rows, content = measure(flags.samples, flags.repeats)
        name = f"kernels-{native.variant()}"
        _write(flags.output_dir / f"{name}.json", content)
        most = max(row.threads for row in rows)
        if flags.plot_dir:
            bars.draw([row for row in rows if row.threads == most], flags.plot_dir / f"{name}.png")


def _quadrature(flags: QuadratureFlags) -> None:
    from framework.tools.benchmarks.quadrature import main as quadrature

    flags.output_dir.mkdir(parents=True, exist_ok=True)
    quadrature(flags.output_dir / "quadrature.json", flags.plot_dir, flags.quick, flags.seed)


def _methods(flags: MethodFlags) -> None:
    from framework.cli.compare import compare
    from framework.tools.benchmarks.methods import draw, published, standard_plan

    name = "procedural" if flags.data is None else flags.data.resolve().name
    folder = flags.run_dir or Path("outputs") / f"bench-{name}"
    rows = compare(standard_plan(flags.data, flags.max_seconds, flags.repeats, folder))
    _write(flags.output_dir / f"methods-{name}.json", published(folder))
    if flags.plot_dir:
        draw(rows, flags.plot_dir / f"methods-{name}.svg")
    failed = [row.label for row in rows if row.failures]
    if failed:
        raise ConfigError(f"these methods failed: {', '.join(failed)}; {folder / 'report.html'} says why")


KINDS: dict[str, tuple[type, Any]] = {
    "kernels": (KernelFlags, _kernels),
    "quadrature": (QuadratureFlags, _quadrature),
    "methods": (MethodFlags, _methods),
}


def _write(path: Path, content: dict[str, Any]) -> None:
    from framework.training.run import write_json

    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    say(f"written to {path}")


if __name__ == "__main__":
    main()
