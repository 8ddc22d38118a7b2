"""The command `ns-stress`: methods on hard scenes and under hard conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.base.errors import ConfigError, FlagError, NerfloomError
from nerfloom.base.json_files import write_json
from nerfloom.cli.common import entry_point, make_room
from nerfloom.cli.flags import HELP, read_flags
from nerfloom.registry import registered
from nerfloom.training.run_path import check_data

if TYPE_CHECKING:
    from nerfloom.stress.conditions import Condition
    from nerfloom.stress.report import Result
    from nerfloom.stress.trial import Budget
    from nerfloom.training.run import Run

USAGE = """\
usage: ns-stress METHOD [METHOD ...] [--data DIR] [flags]
       ns-stress all [--data DIR] [flags]

METHOD is a registered method; quote a method with flags: "vanilla-nerf --sampler occupancy". all stands for every
registered method. Each is trained for a short time, on a ball rendered in memory or on a few images of --data DIR,
first without a condition (plain) and then under each of

  images                      all-white all-black all-transparent one-image one-pixel-images duplicate-cameras
                              distractors
  cameras                     field-of-view-4 field-of-view-170 inside
  units and origin            scale-1e-6 scale-1e6 shift-1e4, and as for captures: placed scale-1e-6-placed
                              scale-1e6-placed shift-1e4-placed
  training                    another-seed learning-rate-x10 float32 bfloat16 float16 1-ray 8192-rays
  invalid data                nan-pixels inf-pixels nan-pose

The outcome of each is pass, degraded (the PSNR drops by more than allowed, compared with plain), refused (with a clear
error, as it should) or fail. The exit status is 1 if one fails. ns-stress METHOD --help shows the flags.
"""


@dataclass(frozen=True)
class StressFlags:
    """Train methods on hard scenes and under hard conditions; report where they pass, degrade or fail."""

    data: Path | None = None
    """Folder of a data set; a few downscaled images are used. Default: a ball rendered in memory."""
    data_flags: str = ""
    """Flags of the data format, quoted after an "=": --data-flags="--downscale-factor 2"."""
    only: tuple[str, ...] = ()
    """Conditions, as listed by ns-stress --help. Default: all. The plain run always takes place."""
    max_num_iterations: int = 300
    """Training steps under each condition."""
    max_seconds: float | None = 30.0
    """Maximum seconds of training under each condition; None: no limit."""
    output_path: Path | None = None
    """JSON file to write, with a .md beside it. Default: outputs/stress-DATA/METHOD.json, or methods.json."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-stress on the `arguments` of the process."""
    if not arguments or arguments[0] in HELP:
        print(USAGE)
        return
    methods = list(takewhile(lambda word: not word.startswith("-"), arguments))
    if not methods:
        raise ConfigError(f"the methods come first, before {arguments[0]}, as in 'ns-stress instant-ngp kplanes'")
    flags = read_flags(StressFlags, "ns-stress METHOD", arguments[len(methods) :])
    results = stress(list(registered("methods")) if methods == ["all"] else methods, flags)
    outcomes = [(result.method, verdict) for result in results for verdict in result.verdicts]
    failed = [f"{method}: {verdict.name}" for method, verdict in outcomes if verdict.outcome == "fail"]
    if failed:
        raise NerfloomError(f"{len(failed)} of {len(outcomes)} runs failed: {', '.join(failed)}")


def stress(methods: Sequence[str], flags: StressFlags) -> list[Result]:
    """Train methods under each condition; print and write the outcomes.

    The JSON file is written after each condition, so that earlier outcomes survive the end of the process.

    Args:
        methods: names of the methods, each optionally followed by its flags.
        flags: the flags of the command.

    Returns:
        The outcomes of each method.

    Raises:
        ConfigError: if a flag is invalid.
        DataError: if the data is missing or cannot be read.
    """
    if flags.data is not None:
        check_data(flags.data)
    from nerfloom.base.console import say
    from nerfloom.base.device import choose_device
    from nerfloom.stress.report import Result, markdown, settings_of
    from nerfloom.stress.scenes import ball_views, data_views
    from nerfloom.stress.verdict import verdicts
    from nerfloom.training.machine import machine

    runs, conditions = [_run(method, flags) for method in methods], _conditions(flags)
    budget, path = _budget(flags), _path(runs, flags)
    views = ball_views() if flags.data is None else data_views(runs[0].parser, flags.data)
    make_room(path)
    make_room(path.with_suffix(".md"))
    results: list[Result] = []
    for method, run in zip(methods, runs, strict=True):
        say(f"{method}:")
        settings = settings_of(run, budget, views.train.scene)
        result = Result(method, machine(choose_device(run.config.machine)), settings, ())
        for verdict in verdicts(run, views, conditions, budget):
            result = replace(result, verdicts=(*result.verdicts, verdict))
            _write(path, flags, conditions, [*results, result])
        results.append(result)
    table = path.with_suffix(".md")
    table.write_text(markdown(results), encoding="utf-8")
    _print(results)
    say(f"written to {path} and {table.name}")
    return results


def _run(method: str, flags: StressFlags) -> Run:
    """Return the run that `ns-train` would start with the method and its flags."""
    from nerfloom.cli.train import run_of
    from nerfloom.comparison.plan import split_method, split_words

    name, own = split_method(method, "METHOD")
    data = [] if flags.data is None else ["--data", str(flags.data)]
    run = run_of(name, [*own, *data, *split_words(flags.data_flags, "--data-flags")])
    if run.config.data != flags.data:
        raise ConfigError(f"{method}: put --data after the methods; all methods use the same photographs")
    return run


def _conditions(flags: StressFlags) -> list[Condition]:
    """Return the selected conditions that can be applied to --data."""
    from nerfloom.base.console import say
    from nerfloom.stress.conditions import select

    selected = select(flags.only)
    if flags.data is None:
        return selected
    left_out = [condition.name for condition in selected if condition.ball_only]
    if left_out:
        say(f"left out, since they need pictures of the ball: {', '.join(left_out)}")
    return [condition for condition in selected if not condition.ball_only]


def _budget(flags: StressFlags) -> Budget:
    from nerfloom.stress.trial import Budget

    if flags.max_num_iterations < 1 or (flags.max_seconds is not None and not flags.max_seconds > 0):
        raise FlagError("--max-num-iterations must be at least 1, and --max-seconds more than 0")
    return Budget(flags.max_num_iterations, flags.max_seconds)


def _path(runs: Sequence[Run], flags: StressFlags) -> Path:
    """Return the path of the JSON file."""
    path = flags.output_path
    if path is None:
        name = runs[0].method if len(runs) == 1 else "methods"
        return Path("outputs") / f"stress-{_data_name(flags)}" / f"{name}.json"
    if path.suffix != ".json":
        raise FlagError(f"--output-path {path}: it must end in .json; the table goes beside it, ending in .md")
    return path


def _data_name(flags: StressFlags) -> str:
    return "ball" if flags.data is None else flags.data.resolve().name


def _write(path: Path, flags: StressFlags, conditions: Sequence[Condition], results: Sequence[Result]) -> None:
    """Write the flags, the conditions and the outcomes so far."""
    content = {
        "data": _data_name(flags),
        "data_flags": flags.data_flags,
        "max_num_iterations": flags.max_num_iterations,
        "max_seconds": flags.max_seconds,
        "conditions": {hard.name: {"what": hard.what, "allowed": hard.allowed} for hard in conditions},
        "methods": [asdict(result) for result in results],
    }
    write_json(path, content)


def _print(results: Sequence[Result]) -> None:
    from rich.table import Table
    from rich.text import Text

    from nerfloom.base.console import console, say
    from nerfloom.stress.report import notes, table

    head, *rows = table(results)
    grid = Table()
    for name in head:
        grid.add_column(Text(name))  # rich would parse brackets in a string as markup
    for row in rows:
        grid.add_row(*map(Text, row))
    console.print(grid)
    for note in notes(results):
        say(note)


if __name__ == "__main__":
    main()
