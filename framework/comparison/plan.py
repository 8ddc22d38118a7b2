"""The plan of a comparison: contenders, conditions, and the commands of each run."""

from __future__ import annotations

import json
import math
import re
import shlex
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nerfloom.base.child import python_command
from nerfloom.base.errors import ConfigError, FlagError, shown
from nerfloom.base.json_files import write_json
from nerfloom.registry import entry_of

FIRST_SEED = 42
"""Seed of the first run of each contender; further runs have the following seeds."""
CURVE_POINTS = 8
"""Number of evaluations during a run, for its learning curve."""
MIN_VIEWS = 25
"""Minimum number of views of a final evaluation if the number depends on the time budget."""
PICTURES = 3
"""Number of views with pictures, which a report shows."""


def split_words(text: str, flag: str) -> tuple[str, ...]:
    """Split the value `text` of a `flag` into words as a shell does.

    Raises:
        ConfigError: if a quote is not closed.
    """
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise ConfigError(f"{flag}: {shown(text)} is invalid: {error}") from error


def split_method(text: str, flag: str) -> tuple[str, tuple[str, ...]]:
    """Split the value `text` of a `flag` into the name of a method and the method's flags.

    Raises:
        ConfigError: if it is empty, or a quote is not closed.
    """
    if not (words := split_words(text, flag)):
        raise FlagError(f"{flag}: {shown(text)} names no method; give one, such as instant-ngp")
    return words[0], words[1:]


@dataclass(frozen=True)
class Contender:
    """A method with its own flags.

    Args:
        method: name of the method.
        flags: its flags.
    """

    label: str
    """The method's name and flags, as the user wrote them."""
    method: str
    flags: tuple[str, ...]

    @classmethod
    def of(cls, text: str) -> Contender:
        """Construct from `text`: a name, or a name and flags, such as "vanilla-nerf --sampler occupancy".

        Raises:
            ConfigError: for an unknown method, or a quote that is not closed.
        """
        method, flags = split_method(text, "--methods")
        entry_of("methods", method)
        return cls(" ".join(text.split()), method, flags)

    @property
    def slug(self) -> str:
        """Name of the contender's folder: readable, and unique for each label."""
        readable = re.sub(r"[^a-z0-9]+", "-", self.label.lower()).strip("-")[:48]
        return readable if readable == self.label else f"{readable}-{zlib.crc32(self.label.encode()):08x}"


def views_for(max_seconds: float | None) -> int | None:
    """Return the default number of held-out views of a final evaluation: one per second of training.

    So an evaluation takes no longer than its training, as an evaluation of all views would after short runs. Views are
    evenly spaced, and the same for all methods.

    Args:
        max_seconds: seconds of training; None without a time limit.

    Returns:
        A number of views; None for all.
    """
    if max_seconds is None or not math.isfinite(max_seconds):  # which the conditions refuse
        return None
    return max(MIN_VIEWS, round(max_seconds))


@dataclass(frozen=True)
class Conditions:
    """Settings shared by all runs of a comparison."""

    data: str | None
    """Absolute path of the data folder; None for the embedded scene."""
    data_flags: tuple[str, ...] = ()
    """Flags of the data format."""
    max_seconds: float | None = None
    """Seconds of training."""
    max_num_iterations: int | None = None
    """Steps of training."""
    target_psnr: float | None = None
    """PSNR on the validation views that stops training, dB."""
    num_threads: int | None = None
    """CPU threads; None for all."""
    device_type: str = "auto"
    """Device of training and evaluation."""
    curve_images: int = 4
    """Maximum number of views of the learning curve; 0 for no curve."""
    max_eval_images: int | None = None
    """Maximum number of views of the final evaluation; None for all."""
    lpips_weights: str | None = None
    """Absolute path of LPIPS's weights file; None to use the lpips package."""
    geometry: tuple[str, ...] = ()
    """Flags of ns-eval that compare surfaces with a reference; empty for no such comparison."""

    def __post_init__(self) -> None:
        if self.max_seconds is None and self.max_num_iterations is None and self.target_psnr is None:
            raise FlagError(
                "set the training budget: --max-seconds 120, --max-num-iterations 5000, or --target-psnr 30"
            )
        for name in ("max_seconds", "max_num_iterations", "target_psnr"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise FlagError(f"--{name.replace('_', '-')} is {value}; it must be more than 0 and finite")
        if self.curve_images < 0 or (self.max_eval_images is not None and self.max_eval_images < 1):
            raise FlagError("--curve-images must be at least 0, --max-eval-images at least 1")

    def flags(self) -> list[str]:
        """Return the flags of ns-train for the data and the budget."""
        values = {name: getattr(self, name) for name in ("data", "max_seconds", "max_num_iterations", "target_psnr")}
        given = {name: value for name, value in values.items() if value is not None}
        return [word for name, value in given.items() for word in ("--" + name.replace("_", "-"), str(value))]

    def budget(self) -> str:
        """Return a description of the training budget."""
        parts = [
            (self.max_seconds, f"{self.max_seconds:g} s of training" if self.max_seconds else ""),
            (self.max_num_iterations, f"{self.max_num_iterations} steps"),
            (self.target_psnr, f"until {self.target_psnr} dB on the validation views"),
        ]
        return ", ".join(text for value, text in parts if value is not None)


@dataclass(frozen=True)
class PlannedRun:
    """One contender with one seed.

    Args:
        contender: the contender.
        seed: the seed.
    """

    contender: Contender
    seed: int
    runs: Path
    """Folder of all runs."""

    @property
    def folder(self) -> Path:
        """Folder of this run."""
        return self.runs / self.contender.slug / self.contender.method / f"seed-{self.seed}"

    @property
    def log(self) -> Path:
        """File for the output of the run's commands."""
        return self.runs / self.contender.slug / f"seed-{self.seed}.log"

    @property
    def evaluation(self) -> Path:
        """File of the results of the final model on all views."""
        return self.folder / "eval_all.json"

    @property
    def pictures(self) -> Path:
        """Folder of renders and comparisons of all views."""
        return self.folder / "views"

    @property
    def opened(self) -> Path:
        """File that `ns-eval` opens after training."""
        return self.folder / "config.yml"

    @property
    def title(self) -> str:
        """Description of the run for messages."""
        return f"{self.contender.label}, seed {self.seed}"

    def user_command(self, conditions: Conditions) -> list[str]:
        """Return the command of a user who trains the same under `conditions`, without folders of the output."""
        flags = [*self.contender.flags, *conditions.data_flags, "--machine.seed", str(self.seed)]
        return ["ns-train", self.contender.method, *flags, *conditions.flags()]

    def train_command(self, conditions: Conditions) -> list[str]:
        """Return the command that trains under `conditions`."""
        start = python_command("nerfloom.cli.train")
        c, flags = conditions, ["--vis", "none", "--eval", "all", "--max-eval-images", str(conditions.curve_images)]
        flags += c.flags()
        if c.curve_images and c.max_seconds is not None:
            flags += ["--seconds-per-eval-all-images", str(c.max_seconds / CURVE_POINTS)]
        elif c.curve_images and c.max_num_iterations is not None:
            flags += ["--steps-per-eval-all-images", str(max(c.max_num_iterations // CURVE_POINTS, 1))]
        if c.num_threads is not None:
            flags += ["--machine.num-threads", str(c.num_threads)]
        flags += ["--machine.device-type", c.device_type, "--machine.seed", str(self.seed)]
        flags += ["--output-dir", str(self.runs), "--experiment-name", self.contender.slug]
        flags += ["--timestamp", self.folder.name]
        # A contender's own flags come last and so take precedence.
        return [*start, self.contender.method, *flags, *self.contender.flags, *c.data_flags]

    def resume_command(self) -> list[str]:
        """Return the command that resumes a training that has started."""
        return python_command("nerfloom.cli.train", "--resume", self.folder)

    def eval_command(self, conditions: Conditions) -> list[str]:
        """Return the command that evaluates the trained model under `conditions`."""
        command = python_command("nerfloom.cli.evaluate", "--load-config", self.opened)
        command += ["--output-path", str(self.evaluation), "--render-output-path", str(self.pictures)]
        command += ["--max-pictures", str(PICTURES), "--device-type", conditions.device_type]
        if conditions.max_eval_images is not None:
            command += ["--max-images", str(conditions.max_eval_images)]
        if conditions.lpips_weights is not None:
            command += ["--lpips-weights", conditions.lpips_weights]
        return [*command, *conditions.geometry]


@dataclass(frozen=True)
class Plan:
    """A comparison.

    Args:
        contenders: the contenders.
        conditions: the conditions shared by all runs.
    """

    contenders: tuple[Contender, ...]
    conditions: Conditions
    repeats: int
    """Number of seeds for each contender."""
    folder: Path
    """Output folder."""

    def __post_init__(self) -> None:
        labels = [contender.label for contender in self.contenders]
        if not labels:
            raise FlagError("--methods is empty; list methods, such as --methods instant-ngp kplanes")
        duplicates = sorted({label for label in labels if labels.count(label) > 1})
        if duplicates:
            raise FlagError(f"--methods has {', '.join(map(repr, duplicates))} twice; use --repeats for several runs")
        if self.repeats < 1:
            raise FlagError(f"--repeats is {self.repeats}; it must be at least 1")

    def runs(self) -> list[PlannedRun]:
        """Return all runs, seed by seed, so that every contender has an early result."""
        seeds = range(FIRST_SEED, FIRST_SEED + self.repeats)
        return [PlannedRun(contender, seed, self.folder / "runs") for seed in seeds for contender in self.contenders]

    def claim_folder(self) -> None:
        """Write the conditions, so that a later call continues under the same conditions.

        Raises:
            ConfigError: if the folder has a comparison under other conditions or cannot be written.
        """
        path, conditions = self.folder / "conditions.json", json.loads(json.dumps(asdict(self.conditions)))
        if path.exists():
            differing = _differences(_read(path), conditions)
            if differing:
                raise ConfigError(
                    f"{self.folder} has a comparison under other conditions ({differing}); choose another --output-dir"
                )
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, conditions)
        except OSError as error:
            raise ConfigError(f"cannot write {self.folder}: {error.strerror}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}; remove it, or choose another --output-dir") from error
    return content if isinstance(content, dict) else {}


def _differences(previous: dict[str, Any], conditions: dict[str, Any]) -> str:
    names = [name for name in conditions if previous.get(name) != conditions[name]]
    return ", ".join(f"{name} {previous.get(name)}, not {conditions[name]}" for name in names)
