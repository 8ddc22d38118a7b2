"""ns-stress: methods in hard scenes and under hard conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from framework.base.errors import ConfigError, NerfloomError
from framework.base.registry import registered
from framework.cli.common import run_command

if TYPE_CHECKING:
    from framework.tools.stress.conditions import Condition
    from framework.tools.stress.report import Result
    from framework.tools.stress.trial import Budget
    from framework.training.run import Run

USAGE = """\
usage: ns-stress METHOD [METHOD ...] [--data DIR] [flags]
       ns-stress all [--data DIR] [flags]

METHOD is a registered method, with flags of its own in quotes if need be: "vanilla-nerf --sampler occupancy"; all
stands for each of them. Each is trained for a short while, on a ball made in memory or on a few photographs of
--data DIR, plainly and then under

  what the photographs show   all-white all-black all-transparent one-image one-pixel-images duplicate-cameras
  how it is looked at         field-of-view-4 field-of-view-170 inside
  where the scene is          scale-1e-6 scale-1e6 shift-1e4, and as captures arrive: placed scale-1e-6-placed
                              scale-1e6-placed shift-1e4-placed
  how it is trained           another-seed learning-rate-x10 float32 bfloat16 float16 1-ray 8192-rays
  what should be refused      nan-pixels inf-pixels nan-pose

and each is a pass, degraded (more PSNR lost against the plain run than the condition allows), refused (with a clear
error, where that is right) or a fail. The exit status is 1 where one fails. ns-stress METHOD --help shows the flags.
"""


@dataclass(frozen=True)
class StressFlags:
    """Run methods through hard scenes and conditions: which do they pass, which degrade them, where do they fail?"""

    data: Path | None = None
    """Folder of a data set, of which a few photographs are used, reduced. A ball made in memory if not given."""
    data_flags: str = ""
    """Flags of the data format, in quotes: "--downscale-factor 2"."""
    only: tuple[str, ...] = ()
    """Conditions besides the plain run, as ns-stress --help lists them; all if not given."""
    max_num_iterations: int = 300
    """Steps of training under each condition."""
    max_seconds: float | None = 30.0
    """Seconds of training under each condition, if its steps take longer; None for no limit."""
    output_path: Path | None = None
    """The JSON; outputs/stress-DATA/METHOD.json, or methods.json of several, if not given. A .md goes beside it."""


def main() -> None:
    """The ns-stress command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return
    import tyro

    methods = list(takewhile(lambda word: not word.startswith("-"), arguments))
    if not methods:
        raise ConfigError(f"the methods come first, before {arguments[0]}, as in 'ns-stress instant-ngp kplanes'")
    rest, options = arguments[len(methods) :], (tyro.conf.FlagConversionOff,)
    flags = tyro.cli(StressFlags, prog="ns-stress METHOD", args=rest, config=options)
    results = stress(list(registered("methods")) if methods == ["all"] else methods, flags)
    outcomes = [(result.method, verdict) for result in results for verdict in result.verdicts]
    failed = [f"{method}: {verdict.name}" for method, verdict in outcomes if verdict.outcome == "fail"]
    if failed:
        raise NerfloomError(f"{len(failed)} of {len(outcomes)} runs failed: {', '.join(failed)}")


def stress(methods: Sequence[str], flags: StressFlags) -> list[Result]:
    """Run methods, with flags of their own if there are any, through the conditions; print and write what came of it.

    The JSON is written after each condition: should the process itself be ended, what came before stands.

    Raises: ConfigError or DataError for what cannot be begun.
    """
    from framework.base.console import say
    from framework.base.device import choose_device
    from framework.tools.stress.report import Result, markdown, settings_of
    from framework.tools.stress.scenes import ball_views, data_views
    from framework.tools.stress.verdict import verdicts
    from framework.training.machine import machine

    runs, conditions = [_run(method, flags) for method in methods], _conditions(flags)
    budget, path = _budget(flags), _path(runs, flags)
    views = ball_views() if flags.data is None else data_views(runs[0].parser, flags.data)
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
    """The method and its settings, as `ns-train` would take them."""
    from framework.cli.train import run_of
    from framework.tools.comparison.plan import split_words

    words, of_data = split_words(method, "METHOD"), split_words(flags.data_flags, "--data-flags")
    if not words:
        raise ConfigError("the method is missing, as in 'ns-stress instant-ngp'")
    data = [] if flags.data is None else ["--data", str(flags.data)]
    run = run_of(words[0], [*words[1:], *data, *of_data])
    if run.config.data != flags.data:
        raise ConfigError(f"{method}: --data stands behind the methods, for all of them get the same photographs")
    return run


def _conditions(flags: StressFlags) -> list[Condition]:
    """The conditions asked for, less those that cannot be made of somebody's data."""
    from framework.base.console import say
    from framework.tools.stress.conditions import select

    asked = select(flags.only)
    if flags.data is None:
        return asked
    left_out = [condition.name for condition in asked if condition.ball_only]
    if left_out:
        say(f"left out, for they need pictures that only the ball has: {', '.join(left_out)}")
    return [condition for condition in asked if not condition.ball_only]


def _budget(flags: StressFlags) -> Budget:
    from framework.tools.stress.trial import Budget

    if flags.max_num_iterations < 1 or (flags.max_seconds is not None and not flags.max_seconds > 0):
        raise ConfigError("--max-num-iterations must be at least 1, and --max-seconds more than 0")
    return Budget(flags.max_num_iterations, flags.max_seconds)


def _path(runs: Sequence[Run], flags: StressFlags) -> Path:
    """The JSON file."""
    path = flags.output_path
    if path is None:
        name = runs[0].method if len(runs) == 1 else "methods"
        return Path("outputs") / f"stress-{_data_name(flags)}" / f"{name}.json"
    if path.suffix != ".json":
        raise ConfigError(f"--output-path {path}: it must end in .json; the table goes beside it, ending in .md")
    return path


def _data_name(flags: StressFlags) -> str:
    return "ball" if flags.data is None else flags.data.resolve().name


def _write(path: Path, flags: StressFlags, conditions: Sequence[Condition], results: Sequence[Result]) -> None:
    """What was asked for, and what came of it so far."""
    from framework.training.run import write_json

    content = {
        "data": _data_name(flags),
        "data_flags": flags.data_flags,
        "max_num_iterations": flags.max_num_iterations,
        "max_seconds": flags.max_seconds,
        "conditions": {hard.name: {"what": hard.what, "allowed": hard.allowed} for hard in conditions},
        "methods": [asdict(result) for result in results],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)


def _print(results: Sequence[Result]) -> None:
    from rich.table import Table
    from rich.text import Text

    from framework.base.console import console, say
    from framework.tools.stress.report import notes, table

    head, *rows = table(results)
    shown = Table()
    for name in head:
        shown.add_column(Text(name))  # as text: brackets in it would be taken for markup
    for row in rows:
        shown.add_row(*map(Text, row))
    console.print(shown)
    for note in notes(results):
        say(note)


if __name__ == "__main__":
    main()
