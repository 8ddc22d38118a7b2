"""ns-stress: a method in hard scenes and under hard conditions."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.cli.common import run_command
from framework.errors import ConfigError, NerfloomError

if TYPE_CHECKING:
    from framework.stress.conditions import Condition
    from framework.stress.verdict import Verdict
    from framework.training.run import Run

USAGE = """\
usage: ns-stress METHOD [--data DIR] [flags]

METHOD is a registered method, with flags of its own in quotes if need be: "vanilla-nerf --sampler occupancy".
It is trained for a short while, on a ball made in memory or on a few photographs of --data DIR, plainly and then under

  what the photographs show   all-white all-black all-transparent one-image one-pixel-images duplicate-cameras
  how it is looked at         field-of-view-4 field-of-view-170 inside
  where the scene is          scale-1e-6 scale-1e6 shift-1e4, and as captures arrive: placed scale-1e-6-placed
                              scale-1e6-placed shift-1e4-placed
  how it is trained           learning-rate-x10 float32 bfloat16 float16 1-ray 8192-rays
  what should be refused      nan-pixels inf-pixels nan-pose

and each is a pass, degraded (more PSNR lost against the plain run than the condition allows), refused (with a clear
error, where that is right) or a fail. The exit status is 1 where one fails. ns-stress METHOD --help shows the flags.
"""


@dataclass(frozen=True)
class StressFlags:
    """Run a method through hard scenes and conditions: which does it pass, which degrade it, and where does it fail?"""

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
    """Where the JSON goes; outputs/stress-DATA/METHOD.json if not given."""


def main() -> None:
    """The ns-stress command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return
    import tyro

    method, prog = arguments[0], "ns-stress METHOD"
    flags = tyro.cli(StressFlags, prog=prog, args=arguments[1:], config=(tyro.conf.FlagConversionOff,))
    found = stress(method, flags)
    failed = [verdict.name for verdict in found if verdict.outcome == "fail"]
    if failed:
        raise NerfloomError(f"{len(failed)} of {len(found)} conditions failed: {', '.join(failed)}")


def stress(method: str, flags: StressFlags) -> list[Verdict]:
    """Run a method, with flags of its own if there are any, through the conditions; print and write what came of it.

    The JSON is written after each condition: should the process itself be ended, what came before stands.

    Raises: ConfigError or DataError for what cannot be begun.
    """
    from framework.console import console, say
    from framework.stress.scenes import ball_views, data_views
    from framework.stress.trial import Budget
    from framework.stress.verdict import verdicts

    run, conditions = _run(method, flags), _conditions(flags)
    name = "ball" if flags.data is None else flags.data.resolve().name
    views = ball_views() if flags.data is None else data_views(run.parser, run.config.data)
    path = flags.output_path or Path("outputs") / f"stress-{name}" / f"{run.method}.json"
    facts = _facts(method, name, run, flags)
    found: list[Verdict] = []
    for verdict in verdicts(run, views, conditions, Budget(flags.max_num_iterations, flags.max_seconds)):
        found.append(verdict)
        _write(path, facts, found)
    console.print(_table(found))
    say(f"written to {path}")
    return found


def _run(method: str, flags: StressFlags) -> Run:
    """The method and its settings, as `ns-train` would take them."""
    from framework.cli.train import run_of

    words, of_data = _words(method, "METHOD"), _words(flags.data_flags, "--data-flags")
    if not words:
        raise ConfigError("the method is missing, as in 'ns-stress instant-ngp'")
    if flags.max_num_iterations < 1 or (flags.max_seconds is not None and not flags.max_seconds > 0):
        raise ConfigError("--max-num-iterations must be at least 1, and --max-seconds more than 0")
    data = [] if flags.data is None else ["--data", str(flags.data)]
    return run_of(words[0], [*words[1:], *data, *of_data])


def _words(text: str, what: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"{what}: {text!r} cannot be read: {error}") from error


def _conditions(flags: StressFlags) -> list[Condition]:
    """The conditions asked for, less those that cannot be made of somebody's data."""
    from framework.console import say
    from framework.stress.conditions import select

    asked = select(flags.only)
    if flags.data is None:
        return asked
    left_out = [condition.name for condition in asked if condition.ball_only]
    if left_out:
        say(f"left out, for they need pictures that only the ball has: {', '.join(left_out)}")
    return [condition for condition in asked if not condition.ball_only]


def _facts(method: str, name: str, run: Run, flags: StressFlags) -> dict[str, Any]:
    """What the verdicts hold for."""
    from framework.device import choose_device
    from framework.machine import machine

    return {
        "method": method,
        "data": name,
        "max_num_iterations": flags.max_num_iterations,
        "max_seconds": flags.max_seconds,
        "machine": machine(choose_device(run.config.machine)),
    }


def _write(path: Path, facts: dict[str, Any], found: Sequence[Verdict]) -> None:
    from framework.training.run import write_json

    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {**facts, "verdicts": [asdict(verdict) for verdict in found]})


def _table(found: Sequence[Verdict]) -> Any:
    from rich.table import Table
    from rich.text import Text

    shown = Table("condition", "outcome", "PSNR", "lost", "steps", "skipped", "why")
    for verdict in found:
        psnr, lost = ("" if value is None else f"{value:.2f}" for value in (verdict.psnr, verdict.lost))
        counts = str(verdict.steps or ""), str(verdict.skipped or "")
        # As text: a message may hold brackets, which a table would take for markup.
        shown.add_row(verdict.name, verdict.outcome, psnr, lost, *counts, Text(verdict.error or verdict.reason or ""))
    return shown


if __name__ == "__main__":
    main()
