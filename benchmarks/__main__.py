"""The benchmarks behind the documents: python -m benchmarks WHAT, from the root of the repository."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from benchmarks.flags import (
    CacheFlags,
    CityFlags,
    ContentionFlags,
    CurvesFlags,
    MeshFlags,
    OperationsFlags,
    PoseRefinementFlags,
    PosesFlags,
    ProcessesFlags,
    QuadratureFlags,
    TablesFlags,
    ViewerBenchFlags,
)
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError, shown
from nerfloom.base.extras import require
from nerfloom.cli.bench_results import run_benchmark, write_results
from nerfloom.cli.common import check_weights, entry_point, make_room
from nerfloom.training.run_path import data_name, trained_run

USAGE = """\
usage: python -m benchmarks WHAT [flags]

  quadrature       error of every sampler against field evaluations per ray, on scenes with a known integral
  curves           PSNR against seconds of every method: a run for each of several budgets and seeds, in one picture
  tables           rows of published tables, each a run judged on every held-out image; goes on where it was stopped
  processes        time to each PSNR with one process and with several, started by torchrun, on the same cores
  operations       operations of torch and waits for the device in a training step without compiled kernels
  contention       speed of training and rendering beside other programs
  cache            memory and speed with a large image set under --cache-limit, and with a small one in memory
  poses            differences between poses from ns-process-data and from a COLMAP model of the same images
  pose-refinement  effect of refining camera poses, on the embedded scene with disturbed training poses
  meshes           distance of exported meshes from the exact surface or from sparse points; their time and memory
  viewer           times of the viewer's first picture, of pictures of a moving camera, and of the finished picture
  city             sizes, messages and times of a city in blocks on paper, by formulas and from measured results

python -m benchmarks WHAT --help shows its flags. Results are written as JSON to docs/results in the working folder, or
to --output-dir or --output; poses and city print them.
"""


@entry_point
def main(arguments: list[str]) -> None:
    """Run a benchmark on the `arguments` of the process."""
    run_benchmark("python -m benchmarks", arguments, KINDS, USAGE)


def _quadrature(flags: QuadratureFlags) -> None:
    from benchmarks.quadrature import main as quadrature

    make_room(flags.output_dir / "quadrature.json")
    quadrature(flags.output_dir / "quadrature.json", flags.plot_dir, flags.quick, flags.seed)


def _curves(flags: CurvesFlags) -> None:
    from benchmarks import curves
    from nerfloom.base.console import console
    from nerfloom.comparison import plots

    name = data_name(flags.data)
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


def _tables(flags: TablesFlags) -> None:
    """Run missing rows, or list or print existing ones."""
    from benchmarks.table_text import listing, markdown
    from benchmarks.tables import kept, read_table, run_rows

    if not flags.seconds_scale > 0:
        raise FlagError(f"--seconds-scale is {flags.seconds_scale}; it must be more than 0")
    try:
        wanted = re.compile(flags.only)
    except re.error as error:
        raise FlagError(f"--only {shown(flags.only)} is not a regular expression: {error}") from error
    check_weights(flags.lpips_weights)
    tables = [
        read_table(path, flags.data_root, flags.run_dir, flags.seconds_scale, flags.lpips_weights, flags.num_threads)
        for path in flags.tables
    ]
    files = [flags.output_dir / f"{table.name}.json" for table in tables]
    if flags.show == "markdown":
        print("\n\n".join(markdown(table, file, wanted) for table, file in zip(tables, files, strict=True)))
        return
    asked = [[row for row in table.rows if wanted.search(row.name)] for table in tables]
    if not (count := sum(map(len, asked))):
        raise FlagError(f"--only {shown(flags.only)}: no row has such a name; --show rows lists them")
    if flags.show == "rows":
        print("\n\n".join(listing(rows, file) for rows, file in zip(asked, files, strict=True) if rows))
        return
    failures: dict[str, str] = {}
    for table, rows, file in zip(tables, asked, files, strict=True):
        make_room(file)
        launcher = flags.chosen_launcher(flags.run_dir.resolve() / table.name)
        failures |= run_rows(rows, flags.data_root, file, launcher)
    present = sum(kept(row, file) is not None for rows, file in zip(asked, files, strict=True) for row in rows)
    say(f"{present} of {count} rows are in {flags.output_dir}")
    if failures:
        raise ConfigError(f"{len(failures)} rows failed, first {next(iter(failures))}: {next(iter(failures.values()))}")


def _processes(flags: ProcessesFlags) -> None:
    from benchmarks.processes import measure

    path = flags.output_dir / f"processes-{flags.data.resolve().name}.json"
    make_room(path)
    write_results(path, measure(flags.data, flags.processes, flags.seconds, flags.seeds, flags.samples, flags.targets))


def _operations(flags: OperationsFlags) -> None:
    os.environ["NERFLOOM_KERNELS"] = "reference"  # which is read when kernels are first asked for
    from benchmarks.operations import METHODS, measure

    make_room(flags.output)
    write_results(flags.output, measure(flags.methods or METHODS, flags.before, flags.steps))


def _contention(flags: ContentionFlags) -> None:
    from benchmarks.contention import WORK, measure
    from nerfloom.benchmarks.results import add_row
    from nerfloom.kernels import native

    make_room(flags.output)
    found = measure(flags.data, flags.seconds, flags.rows, (flags.work,) if flags.work else WORK)
    add_row(flags.output, native.variant(), found)


def _cache(flags: CacheFlags) -> None:
    from benchmarks.cache import measure

    make_room(flags.output)
    size = (flags.width, flags.height)
    write_results(flags.output, measure(flags.images, size, flags.seconds, flags.limit, flags.folder))


def _poses(flags: PosesFlags) -> None:
    from benchmarks.poses import compare

    print(json.dumps(compare(flags.processed, flags.model), indent=2))


def _pose_refinement(flags: PoseRefinementFlags) -> None:
    from benchmarks.pose_refinement import measure

    path = flags.output_dir / "pose-refinement.json"
    make_room(path)
    write_results(path, measure(flags.method, flags.seconds, flags.degrees, flags.percent))


def _meshes(flags: MeshFlags) -> None:
    require("export", "python -m benchmarks meshes needs")
    from benchmarks.meshes import measure
    from nerfloom.benchmarks.results import add_row

    make_room(flags.output)
    run = None if flags.load_config is None else trained_run(flags.load_config).parent
    experiment = "procedural" if run is None else run.parent.parent.name
    add_row(flags.output, experiment, measure(run, flags.seconds, flags.exports, flags.resolutions))


def _viewer(flags: ViewerBenchFlags) -> None:
    import dataclasses

    import torch

    from benchmarks.viewer import measured
    from nerfloom.training.machine import machine

    if not flags.runs or not all(width >= 8 for width in flags.widths):
        raise FlagError("--runs: name trained runs or files; --widths are at least 8 pixels")
    make_room(flags.output_dir / "viewer.json")
    rows = [measured(run, width, width, flags.pictures, flags.data) for run in flags.runs for width in flags.widths]
    for row in rows:
        say(
            f"{row.method} {row.width}x{row.height}: first {row.first:.3f} s, moving {1e3 * row.coarse:.0f} ms "
            f"(at most {1e3 * row.slowest:.0f}, stride {row.stride}, {row.per_second:.1f} a second), "
            f"finished {row.finished:.2f} s"
        )
    content = {"machine": machine(torch.device("cpu")), "pictures": [dataclasses.asdict(row) for row in rows]}
    write_results(flags.output_dir / "viewer.json", content)


def _city(flags: CityFlags) -> None:
    from benchmarks.city import constants, markdown, measured

    print(markdown(flags, constants(), measured(flags.results)))


KINDS: dict[str, tuple[type, Any]] = {
    "quadrature": (QuadratureFlags, _quadrature),
    "curves": (CurvesFlags, _curves),
    "tables": (TablesFlags, _tables),
    "processes": (ProcessesFlags, _processes),
    "operations": (OperationsFlags, _operations),
    "contention": (ContentionFlags, _contention),
    "cache": (CacheFlags, _cache),
    "poses": (PosesFlags, _poses),
    "pose-refinement": (PoseRefinementFlags, _pose_refinement),
    "meshes": (MeshFlags, _meshes),
    "viewer": (ViewerBenchFlags, _viewer),
    "city": (CityFlags, _city),
}


if __name__ == "__main__":
    main()
