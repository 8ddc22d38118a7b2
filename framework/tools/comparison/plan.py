"""What is compared with what, under which conditions; and the commands that do it."""

from __future__ import annotations

import json
import re
import shlex
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from framework.base.child import python_command
from framework.base.errors import ConfigError, shown
from framework.base.registry import entry_of
from framework.training.run import write_json

FIRST_SEED = 42
CURVE_POINTS = 12
"""Evaluations during a run, which its learning curve is made of."""


def split_words(text: str, flag: str) -> tuple[str, ...]:
    """The words of what a flag was given, as a shell has them.

    Raises: ConfigError where quotes do not close.
    """
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise ConfigError(f"{flag}: {shown(text)} cannot be read: {error}") from error


@dataclass(frozen=True)
class Contender:
    """A method with flags of its own."""

    label: str
    """As the user wrote it: a method's name, and its flags behind it."""
    method: str
    flags: tuple[str, ...]

    @classmethod
    def of(cls, text: str) -> Contender:
        """From a name, or a name and flags, as in "vanilla-nerf --sampler occupancy".

        Raises: ConfigError for an unknown method, or quotes that do not close.
        """
        words = split_words(text, "--methods")
        if not words:
            raise ConfigError("--methods holds an empty name")
        entry_of("methods", words[0])
        return cls(" ".join(text.split()), words[0], words[1:])

    @property
    def slug(self) -> str:
        """A folder's name: readable, and different for different labels."""
        readable = re.sub(r"[^a-z0-9]+", "-", self.label.lower()).strip("-")[:48]
        return readable if readable == self.label else f"{readable}-{zlib.crc32(self.label.encode()):08x}"


@dataclass(frozen=True)
class Conditions:
    """What is the same for every run of a comparison."""

    data: str | None
    """The data's folder, absolute; the embedded scene if None."""
    data_flags: tuple[str, ...]
    """Of the data format."""
    max_seconds: float | None
    max_num_iterations: int | None
    target_psnr: float | None
    num_threads: int | None
    device_type: str
    curve_images: int
    """Views of the learning curve."""
    max_eval_images: int | None
    """Views of the final evaluation; all if None."""

    def __post_init__(self) -> None:
        if self.max_seconds is None and self.max_num_iterations is None and self.target_psnr is None:
            raise ConfigError(
                "say how long each method trains: --max-seconds 120, --max-num-iterations 5000, or --target-psnr 30"
            )
        for name in ("max_seconds", "max_num_iterations", "target_psnr"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"--{name.replace('_', '-')} is {value}; it must be more than 0")
        if self.curve_images < 1 or (self.max_eval_images is not None and self.max_eval_images < 1):
            raise ConfigError("--curve-images and --max-eval-images must be at least 1")

    def budget(self) -> str:
        """For people: how long each method trains."""
        parts = [
            (self.max_seconds, f"{self.max_seconds:g} s of training" if self.max_seconds else ""),
            (self.max_num_iterations, f"{self.max_num_iterations} steps"),
            (self.target_psnr, f"until {self.target_psnr} dB on the validation views"),
        ]
        return ", ".join(text for value, text in parts if value is not None)


@dataclass(frozen=True)
class Job:
    """One contender with one seed."""

    contender: Contender
    seed: int
    runs: Path
    """The folder of all runs."""

    @property
    def folder(self) -> Path:
        """The run's own."""
        return self.runs / self.contender.slug / self.contender.method / f"seed-{self.seed}"

    @property
    def log(self) -> Path:
        """What the run's commands printed."""
        return self.runs / self.contender.slug / f"seed-{self.seed}.log"

    @property
    def evaluation(self) -> Path:
        """Of the final model, on all views."""
        return self.folder / "eval_all.json"

    @property
    def pictures(self) -> Path:
        """Renders and comparisons of all views."""
        return self.folder / "views"

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.contender.label}, seed {self.seed}"

    def train_command(self, conditions: Conditions) -> list[str]:
        """The command that trains; that goes on with training where there is something to go on with."""
        start = python_command("framework.cli.train")
        if (self.folder / "config.yml").exists():
            return [*start, "--resume", str(self.folder)]
        c, flags = conditions, ["--vis", "none", "--max-eval-images", str(conditions.curve_images)]
        for name in ("data", "max_seconds", "max_num_iterations", "target_psnr"):
            if getattr(c, name) is not None:
                flags += ["--" + name.replace("_", "-"), str(getattr(c, name))]
        if c.max_seconds is not None:
            flags += ["--seconds-per-eval-all-images", str(c.max_seconds / CURVE_POINTS)]
        elif c.max_num_iterations is not None:
            flags += ["--steps-per-eval-all-images", str(max(c.max_num_iterations // CURVE_POINTS, 1))]
        if c.num_threads is not None:
            flags += ["--machine.num-threads", str(c.num_threads)]
        flags += ["--machine.device-type", c.device_type, "--machine.seed", str(self.seed)]
        flags += ["--output-dir", str(self.runs), "--experiment-name", self.contender.slug]
        flags += ["--timestamp", self.folder.name]
        # A contender's own flags come last, so that they count where both say something.
        return [*start, self.contender.method, *flags, *self.contender.flags, *c.data_flags]

    def eval_command(self, conditions: Conditions) -> list[str]:
        """The command that evaluates the trained model."""
        command = python_command("framework.cli.evaluate", "--load-config", self.folder / "config.yml")
        command += ["--output-path", str(self.evaluation), "--render-output-path", str(self.pictures)]
        command += ["--device-type", conditions.device_type]
        if conditions.max_eval_images is not None:
            command += ["--max-images", str(conditions.max_eval_images)]
        return command


@dataclass(frozen=True)
class Plan:
    """A comparison."""

    contenders: tuple[Contender, ...]
    conditions: Conditions
    repeats: int
    """Seeds for each contender."""
    folder: Path
    """Where everything goes."""

    def __post_init__(self) -> None:
        labels = [contender.label for contender in self.contenders]
        if not labels:
            raise ConfigError("--methods names no method, as in --methods instant-ngp kplanes")
        twice = sorted({label for label in labels if labels.count(label) > 1})
        if twice:
            raise ConfigError(f"--methods names {', '.join(map(repr, twice))} twice; --repeats is for that")
        if self.repeats < 1:
            raise ConfigError(f"--repeats is {self.repeats}; it must be at least 1")

    def jobs(self) -> list[Job]:
        """All runs, seed by seed, so that every contender has a first result early."""
        seeds = range(FIRST_SEED, FIRST_SEED + self.repeats)
        return [Job(contender, seed, self.folder / "runs") for seed in seeds for contender in self.contenders]

    def claim_folder(self) -> None:
        """Write down the conditions, so that a later call goes on under the same ones.

        Raises: ConfigError where the folder holds a comparison under others, or cannot be written.
        """
        path, wanted = self.folder / "conditions.json", json.loads(json.dumps(asdict(self.conditions)))
        if path.exists():
            differing = _differences(_read(path), wanted)
            if differing:
                raise ConfigError(
                    f"{self.folder} holds a comparison under other conditions ({differing}); "
                    "choose another --output-dir"
                )
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, wanted)
        except OSError as error:
            raise ConfigError(f"cannot write {self.folder}: {error.strerror}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}; remove it, or choose another --output-dir") from error
    return found if isinstance(found, dict) else {}


def _differences(there: dict[str, Any], wanted: dict[str, Any]) -> str:
    names = [name for name in wanted if there.get(name) != wanted[name]]
    return ", ".join(f"{name} {there.get(name)}, not {wanted[name]}" for name in names)
