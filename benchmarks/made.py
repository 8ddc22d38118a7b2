"""Rows that another command than `ns-train` makes: an octree by `ns-bake`, or a scene in blocks by `ns-blocks`.

`ns-eval` opens the result and judges it like a run. The seconds of such a row are a flag of its command: of learning
from photographs after baking, or of training each block. Its summary has the wall-clock seconds of the whole command.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks import timed
from nerfloom.base.child import SAFE
from nerfloom.base.errors import ConfigError, shown
from nerfloom.comparison.plan import Conditions, Contender, PlannedRun, split_words
from nerfloom.training.report import SUMMARY


@dataclass(frozen=True)
class Program:
    """A command that makes something that `ns-eval` opens."""

    module: str
    """Its module."""
    seconds: str
    """Flag of the seconds."""
    output: str
    """Flag of the output."""
    product: str
    """Name of the output in a row's folder."""
    reads_data: bool
    """Whether the command is given the data. If not, `ns-eval` is."""


PROGRAMS = {
    "ns-bake": Program("nerfloom.cli.bake", "--fine-tune-seconds", "--output-path", "scene.octree", reads_data=False),
    "ns-blocks": Program("nerfloom.cli.blocks", "--max-seconds", "--output-dir", "blocks", reads_data=True),
}
"""Commands that a table can name in place of a method."""


@dataclass(frozen=True)
class MadeRun(PlannedRun):
    """A command of `PROGRAMS` with its flags, in place of a method, and no seed of its own."""

    @property
    def program(self) -> Program:
        """The command."""
        return PROGRAMS[self.contender.method]

    @property
    def opened(self) -> Path:
        return self.folder / self.program.product

    def user_command(self, conditions: Conditions) -> list[str]:
        words = [self.contender.method, *self.contender.flags, self.program.seconds, str(conditions.max_seconds)]
        if not self.program.reads_data:
            return words
        words += [] if conditions.data is None else ["--data", conditions.data]
        return words + ([f"--data-flags={shlex.join(conditions.data_flags)}"] if conditions.data_flags else [])

    def train_command(self, conditions: Conditions) -> list[str]:
        """Return the command that makes the row under `conditions`, and measures the time of that."""
        words = [*self.user_command(conditions)[1:], "--device-type", conditions.device_type]
        if self.program.reads_data and conditions.num_threads is not None:
            words += ["--num-threads", str(conditions.num_threads)]
        start = [sys.executable, *SAFE, str(Path(timed.__file__).resolve()), str(self.folder / SUMMARY)]
        return [*start, str(self.opened), self.program.module, *words, self.program.output, str(self.opened)]

    def eval_command(self, conditions: Conditions) -> list[str]:
        command = super().eval_command(conditions)
        if self.program.reads_data:
            return command
        if conditions.data is None:
            return [*command, "procedural", *conditions.data_flags]
        return [*command, "--data", conditions.data, *conditions.data_flags]


def contender_of(text: str) -> Contender:
    """Return the contender of a `text`: a method or a command of `PROGRAMS`, and flags.

    Raises:
        ConfigError: for an unknown method, or a quote that is not closed.
    """
    words = split_words(text, "methods")
    return Contender(text, words[0], words[1:]) if words and words[0] in PROGRAMS else Contender.of(text)


def planned_run(contender: Contender, seed: int, runs: Path) -> PlannedRun:
    """Return the run of a `contender` of `contender_of` with a `seed`, in a folder within `runs`."""
    return (MadeRun if contender.method in PROGRAMS else PlannedRun)(contender, seed, runs)


def check_data(contender: Contender, conditions: Conditions, where: str) -> None:
    """Check that `ns-eval` can be given the data of a `contender` under `conditions`; `where` is for the message.

    Raises:
        ConfigError: if the data's flags need the name of their format.
    """
    program, flags = PROGRAMS.get(contender.method), conditions.data_flags
    if program is not None and not program.reads_data and conditions.data and flags and flags[0].startswith("-"):
        raise ConfigError(
            f"{where}: {contender.method} needs the name of the data format before {shown(shlex.join(flags))}, as in "
            "'fox nerfstudio --downscale-factor 2'"
        )
