"""ns-bench: measurements that anybody can repeat, of kernels, samplers, methods and all that stands around them."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from framework.base.child import python_command
from framework.base.console import say
from framework.base.errors import ConfigError, nearest
from framework.cli.common import chosen_kind, make_room, run_command

USAGE = """\
usage: ns-bench WHAT [flags]

  kernels          time and error of every compiled kernel against torch, beside what the machine can do at all
  quadrature       error against field evaluations of every sampler, on scenes whose integral is known
  methods          time to each PSNR of every built-in method, on the embedded scene or on --data
  ablation         what each part of instant-ngp is worth: trained with one part switched off, or on, in turn
  profile-step     where the time of a training step goes: to each compiled kernel, and to Python and torch
  contention       speed of training and rendering beside other programs
  cache            memory and speed of a large image set under --cache-limit, beside a small set in memory
  poses            poses found by ns-process-data beside those of a COLMAP model of the same images
  pose-refinement  what refining camera poses mends, on the embedded scene with its training poses disturbed

ns-bench WHAT --help shows its flags. Results are JSON, in docs/results of the working folder unless --output-dir or
--output says otherwise; poses prints them.
"""
RESULTS = Path("docs/results")


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


@dataclass(frozen=True, kw_only=True)
class AblationFlags:
    """Train instant-ngp with one of its parts switched off, or on, in turn: time to a PSNR, and PSNR at the end."""

    data: Path
    """Folder of the data set."""
    seconds: float = 45.0
    """Seconds of training of each run."""
    seeds: int = 2
    """Runs of each variant."""
    target: float = 30.0
    """PSNR on validation views, dB, the time to which is reported."""
    output_dir: Path = RESULTS
    """Where ablation-DATA.json goes."""


@dataclass(frozen=True, kw_only=True)
class ProfileFlags:
    """Train for a while, then measure 200 steps: the time in each compiled kernel, and the rest."""

    data: Path
    """Folder of the data set."""
    method: str = "instant-ngp"
    """Name of the method."""
    steps: int = 900
    """Steps before the measurement."""
    max_seconds: float = 45.0
    """Seconds of training for which the method chooses its settings; it is not stopped by them."""
    output_dir: Path = RESULTS
    """Where profile-METHOD.json goes."""


@dataclass(frozen=True, kw_only=True)
class ContentionFlags:
    """Run instant-ngp alone, beside busy loops and beside itself: what share of its speed is left, and what is fair."""

    data: Path
    """Folder of the data set."""
    seconds: float = 20.0
    """Seconds of each measurement."""
    rows: tuple[str, ...] = ()
    """Names of conditions, or parts of names; all if not given. Running alone is always measured."""
    work: Literal["training", "rendering"] | None = None
    """What is measured; both if not given."""
    output: Path = RESULTS / "contention.json"
    """The JSON file."""


@dataclass(frozen=True)
class CacheFlags:
    """Train on large images with their pixels in a file, and on small ones in memory: memory, speed, waiting."""

    images: int = 250
    """Number of images."""
    width: int = 1920
    """Width of the large images, pixels."""
    height: int = 1080
    """Height of the large images, pixels."""
    seconds: float = 60.0
    """Seconds of training on each set."""
    limit: float = 500.0
    """MB of decoded pixels that may be in memory."""
    folder: Path | None = None
    """Where images and cache go while it runs; the system's temporary folder if not given."""
    output: Path = RESULTS / "cache.json"
    """The JSON file."""


@dataclass(frozen=True, kw_only=True)
class PosesFlags:
    """Compare the poses that ns-process-data found with those of a COLMAP model of the same images, by name."""

    processed: Path
    """Folder with transforms.json."""
    model: Path
    """Folder with cameras.bin, images.bin and points3D.bin."""


@dataclass(frozen=True)
class PoseRefinementFlags:
    """Train on the embedded scene with exact, disturbed and refined poses: errors of the poses, and PSNR."""

    seconds: float = 120.0
    """Seconds of training of each run."""
    degrees: float = 1.0
    """Angle by which each training camera is turned."""
    percent: float = 1.0
    """Distance by which each is moved, in percent of its distance from the middle of the scene."""
    method: str = "nerfacto"
    """Name of the method."""
    output_dir: Path = RESULTS
    """Where pose-refinement.json goes."""


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


def _ablation(flags: AblationFlags) -> None:
    from framework.tools.benchmarks.ablation import measure

    path = flags.output_dir / f"ablation-{flags.data.resolve().name}.json"
    make_room(path)
    _write(path, measure(flags.data, flags.seconds, flags.seeds, flags.target))


def _profile(flags: ProfileFlags) -> None:
    from framework.tools.benchmarks.profile_step import measure

    path = flags.output_dir / f"profile-{flags.method}.json"
    make_room(path)
    _write(path, measure(flags.data, flags.method, flags.steps, flags.max_seconds))


def _contention(flags: ContentionFlags) -> None:
    from framework.tools.benchmarks.contention import WORK, measure

    make_room(flags.output)
    _write(flags.output, measure(flags.data, flags.seconds, flags.rows, (flags.work,) if flags.work else WORK))


def _cache(flags: CacheFlags) -> None:
    from framework.tools.benchmarks.cache import measure

    make_room(flags.output)
    size = (flags.width, flags.height)
    _write(flags.output, measure(flags.images, size, flags.seconds, flags.limit, flags.folder))


def _poses(flags: PosesFlags) -> None:
    from framework.tools.benchmarks.poses import compare

    print(json.dumps(compare(flags.processed, flags.model), indent=2))


def _pose_refinement(flags: PoseRefinementFlags) -> None:
    from framework.tools.benchmarks.pose_refinement import measure

    path = flags.output_dir / "pose-refinement.json"
    make_room(path)
    _write(path, measure(flags.method, flags.seconds, flags.degrees, flags.percent))


KINDS: dict[str, tuple[type, Any]] = {
    "kernels": (KernelFlags, _kernels),
    "quadrature": (QuadratureFlags, _quadrature),
    "methods": (MethodFlags, _methods),
    "ablation": (AblationFlags, _ablation),
    "profile-step": (ProfileFlags, _profile),
    "contention": (ContentionFlags, _contention),
    "cache": (CacheFlags, _cache),
    "poses": (PosesFlags, _poses),
    "pose-refinement": (PoseRefinementFlags, _pose_refinement),
}


def _write(path: Path, content: dict[str, Any]) -> None:
    from framework.training.run import write_json

    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    say(f"written to {path}")


if __name__ == "__main__":
    main()
