"""The command `ns-bench`: repeatable measurements of kernels, methods, caching, poses and the viewer."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from nerfloom.base.child import python_command
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError, nearest
from nerfloom.base.extras import install_command
from nerfloom.cli.bench_flags import (
    AblationFlags,
    CacheFlags,
    ContentionFlags,
    CurvesFlags,
    FramesFlags,
    KernelFlags,
    MeshFlags,
    MethodFlags,
    OperationsFlags,
    PoseRefinementFlags,
    PosesFlags,
    ProfileFlags,
    QuadratureFlags,
    StartsFlags,
    ViewerBenchFlags,
)
from nerfloom.cli.bench_gpu import GpuFlags, measure_gpu
from nerfloom.cli.bench_processes import ProcessesFlags, measure_processes
from nerfloom.cli.bench_results import write_results
from nerfloom.cli.bench_tables import TablesFlags, measure_tables
from nerfloom.cli.common import chosen_kind, make_room, run_command
from nerfloom.cli.flags import read_flags
from nerfloom.training.run_path import check_data, trained_run

USAGE = """\
usage: ns-bench WHAT [flags]

  kernels          time and error of every compiled kernel against torch, and the machine's measured limits
  gpu              the same on a GPU, steps as CUDA graphs, and PSNR after 2 to 60 seconds, in less than eight minutes
  quadrature       error of every sampler against field evaluations per ray, on scenes with a known integral
  methods          time to each PSNR of every built-in method, on the embedded scene or on --data
  curves           PSNR against seconds of every method: a run for each of several budgets and seeds, in one picture
  tables           rows of published tables, each a run judged on every held-out image; goes on where it was stopped
  ablation         effect of each part of instant-ngp: training with one part switched off, or on, in turn
  starts           where Gaussians start: time to a PSNR from points, a field's surfaces, silhouettes, or anywhere
  processes        time to each PSNR with one process and with several, started by torchrun, on the same cores
  profile-step     time of a training step: of each compiled kernel, and of Python and torch
  operations       operations of torch and waits for the device in a training step without compiled kernels
  contention       speed of training and rendering beside other programs
  cache            memory and speed with a large image set under --cache-limit, and with a small one in memory
  poses            differences between poses from ns-process-data and from a COLMAP model of the same images
  pose-refinement  effect of refining camera poses, on the embedded scene with disturbed training poses
  meshes           distance of exported meshes from the exact surface or from sparse points; their time and memory
  frames           pictures a second of trained runs, at several sizes and numbers of threads
  viewer           times of the viewer's first picture, of pictures of a moving camera, and of the finished picture

ns-bench WHAT --help shows its flags. Results are written as JSON to docs/results in the working folder, or to
--output-dir or --output; poses prints them.
"""


def main() -> None:
    """Run ns-bench on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, KINDS, USAGE, "there is no benchmark")) is None:
        return
    name, (flags, run), rest = chosen
    settings = read_flags(flags, f"ns-bench {name}", rest)
    if getattr(settings, "data", None) is not None:
        check_data(settings.data)
    run(settings)


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
        from nerfloom.tools.benchmarks import bars
        from nerfloom.tools.benchmarks.kernels import measure

        rows, content = measure(flags.samples, flags.repeats)
        name = f"kernels-{native.variant()}"
        write_results(flags.output_dir / f"{name}.json", content)
        most = max(row.threads for row in rows)
        if flags.plot_dir:
            bars.draw([row for row in rows if row.threads == most], flags.plot_dir / f"{name}.png")


def _quadrature(flags: QuadratureFlags) -> None:
    from nerfloom.tools.benchmarks.quadrature import main as quadrature

    flags.output_dir.mkdir(parents=True, exist_ok=True)
    quadrature(flags.output_dir / "quadrature.json", flags.plot_dir, flags.quick, flags.seed)


def _methods(flags: MethodFlags) -> None:
    from nerfloom.cli.compare import compare
    from nerfloom.tools.benchmarks.methods import draw, published, standard_plan

    name = "procedural" if flags.data is None else flags.data.resolve().name
    folder = flags.run_dir or Path("outputs") / f"bench-{name}"
    rows = compare(standard_plan(flags.data, flags.max_seconds, flags.repeats, folder))
    write_results(flags.output_dir / f"methods-{name}.json", published(folder))
    if flags.plot_dir:
        draw(rows, flags.plot_dir / f"methods-{name}.svg")
    failed = [row.label for row in rows if row.failures]
    if failed:
        raise ConfigError(f"these methods failed: {', '.join(failed)}; {folder / 'report.html'} says why")


def _curves(flags: CurvesFlags) -> None:
    from nerfloom.base.console import console
    from nerfloom.tools.benchmarks import curves
    from nerfloom.tools.comparison import plots

    name = "procedural" if flags.data is None else flags.data.resolve().name
    folder = flags.run_dir or Path("outputs") / f"curves-{name}"
    path, picture = flags.output_dir / f"curves-{name}.json", flags.plot_dir / f"curves-{name}.svg"
    plans = curves.plans(flags.methods, flags.data, flags.budgets, flags.seeds, flags.views, folder)
    make_room(path)
    make_room(picture)
    found: list[curves.Budget] = []
    for plan in plans:  # results and picture after every budget, so that there is something to look at early
        found.append(curves.run(plan))
        write_results(path, curves.published(plan, found))
        if plots.available():
            picture.write_text(curves.draw(plan, found), encoding="utf-8")
        console.print(curves.table(plan, found))
    say(f"picture: {picture}" if plots.available() else plots.MISSING)
    failed = sorted({row.label for budget in found for row in budget.rows if row.failures})
    if failed:
        raise ConfigError(f"runs of these methods failed: {', '.join(failed)}; {path} says why")


def _ablation(flags: AblationFlags) -> None:
    from nerfloom.tools.benchmarks.ablation import measure

    path = flags.output_dir / f"ablation-{flags.data.resolve().name}.json"
    make_room(path)
    write_results(path, measure(flags.data, flags.seconds, flags.seeds, flags.target))


def _starts(flags: StartsFlags) -> None:
    from nerfloom.tools.benchmarks.starts import measure

    path = flags.output_dir / f"starts-{flags.data.resolve().name}.json"
    make_room(path)
    write_results(path, measure(flags.data, flags.seconds, flags.seeds, flags.target))


def _profile(flags: ProfileFlags) -> None:
    from nerfloom.cli.train import run_of
    from nerfloom.tools.benchmarks.profile_step import measure
    from nerfloom.tools.comparison.plan import split_words

    if not (words := split_words(flags.method, "--method")):
        raise FlagError("--method is empty; give the name of a method, such as instant-ngp")
    path = flags.output_dir / f"profile-{words[0]}.json"
    make_room(path)
    run = run_of(words[0], [*words[1:], "--data", str(flags.data)])
    write_results(path, {"method": flags.method, **measure(run, flags.steps, flags.max_seconds)})


def _operations(flags: OperationsFlags) -> None:
    os.environ["NERFLOOM_KERNELS"] = "reference"  # which is read when kernels are first asked for
    from nerfloom.tools.benchmarks.operations import METHODS, measure

    make_room(flags.output)
    write_results(flags.output, measure(flags.methods or METHODS, flags.before, flags.steps))


def _contention(flags: ContentionFlags) -> None:
    from nerfloom.tools.benchmarks.contention import WORK, measure

    make_room(flags.output)
    write_results(flags.output, measure(flags.data, flags.seconds, flags.rows, (flags.work,) if flags.work else WORK))


def _cache(flags: CacheFlags) -> None:
    from nerfloom.tools.benchmarks.cache import measure

    make_room(flags.output)
    size = (flags.width, flags.height)
    write_results(flags.output, measure(flags.images, size, flags.seconds, flags.limit, flags.folder))


def _poses(flags: PosesFlags) -> None:
    from nerfloom.tools.benchmarks.poses import compare

    print(json.dumps(compare(flags.processed, flags.model), indent=2))


def _pose_refinement(flags: PoseRefinementFlags) -> None:
    from nerfloom.tools.benchmarks.pose_refinement import measure

    path = flags.output_dir / "pose-refinement.json"
    make_room(path)
    write_results(path, measure(flags.method, flags.seconds, flags.degrees, flags.percent))


def _meshes(flags: MeshFlags) -> None:
    if (advice := install_command("export")) is not None:
        raise ConfigError(f"ns-bench meshes needs packages that are not installed: {advice}")
    from nerfloom.tools.benchmarks.meshes import measure

    make_room(flags.output)
    run = None if flags.load_config is None else trained_run(flags.load_config).parent
    write_results(flags.output, measure(run, flags.seconds, flags.exports, flags.resolutions))


def _viewer(flags: ViewerBenchFlags) -> None:
    import dataclasses

    import torch

    from nerfloom.tools.benchmarks.viewer import measured
    from nerfloom.training.machine import machine

    if not flags.runs or not all(width >= 8 for width in flags.widths):
        raise FlagError("--runs: name the folders of trained runs; --widths are at least 8 pixels")
    make_room(flags.output_dir / "viewer.json")
    rows = [measured(run, width, width, flags.pictures) for run in flags.runs for width in flags.widths]
    for row in rows:
        say(
            f"{row.method} {row.width}x{row.height}: first {row.first:.3f} s, moving {1e3 * row.coarse:.0f} ms "
            f"(at most {1e3 * row.slowest:.0f}, stride {row.stride}, {row.per_second:.1f} a second), "
            f"finished {row.finished:.2f} s"
        )
    content = {"machine": machine(torch.device("cpu")), "pictures": [dataclasses.asdict(row) for row in rows]}
    write_results(flags.output_dir / "viewer.json", content)


def _frames(flags: FramesFlags) -> None:
    import dataclasses

    import torch

    from nerfloom.tools.benchmarks.frames import measure
    from nerfloom.training.machine import machine

    if not flags.runs or min(*flags.widths, 8) < 8 or min(*flags.threads, 1) < 1 or flags.pictures < 1:
        raise FlagError(
            "--runs: name the folders of trained runs; --widths are at least 8, --threads and --pictures at least 1"
        )
    make_room(flags.output)
    rows = [row for run in flags.runs for row in measure(run, flags.widths, flags.threads, flags.pictures)]
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
    "quadrature": (QuadratureFlags, _quadrature),
    "methods": (MethodFlags, _methods),
    "curves": (CurvesFlags, _curves),
    "tables": (TablesFlags, measure_tables),
    "ablation": (AblationFlags, _ablation),
    "starts": (StartsFlags, _starts),
    "processes": (ProcessesFlags, measure_processes),
    "profile-step": (ProfileFlags, _profile),
    "operations": (OperationsFlags, _operations),
    "contention": (ContentionFlags, _contention),
    "cache": (CacheFlags, _cache),
    "poses": (PosesFlags, _poses),
    "pose-refinement": (PoseRefinementFlags, _pose_refinement),
    "meshes": (MeshFlags, _meshes),
    "frames": (FramesFlags, _frames),
    "viewer": (ViewerBenchFlags, _viewer),
}


if __name__ == "__main__":
    main()
