"""Tables of results: each row a run in a process of its own, judged on every held-out image and kept in a JSON file.

A table is a YAML file. Its `rows` are blocks: every data set of a block with every method, budget and seed of it is a
row. If a block's `geometry` names a reference, the surfaces of its rows are compared with it. If it names a run
`after` which its rows come, such as instant-ngp-300s, the word RUN among their flags is the folder of that run of the
same data and seed: of the teacher of a method, or of the run that `ns-bake` bakes. The results of a table are one JSON
file, `rows`, by name. Rows that are in it are not run again, so that a table of many hours grows over days. A row that
was stopped goes on where it was.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from benchmarks.curves import conditions
from benchmarks.made import PROGRAMS, check_data, contender_of, planned_run
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.plain import from_plain, read_yaml
from nerfloom.benchmarks.results import add_row, read_rows
from nerfloom.cli.geometry_flags import FILES, GeometryFlags
from nerfloom.comparison.measures import decisions_of, read_json
from nerfloom.comparison.plan import FIRST_SEED, Conditions, Contender, PlannedRun, split_words
from nerfloom.comparison.runner import job_of
from nerfloom.jobs.job import Job
from nerfloom.jobs.launcher import Launcher
from nerfloom.training.report import SUMMARY

TRIED = 3
"""Number of held-out images to evaluate in a trial, which has other budgets than the table."""
RUN = "RUN"
"""Word among a row's flags that stands for the folder of the run that it comes after."""
Result = dict[str, Any]
"""The stored result of a row: the output of ns-eval and, as `run`, how it was made."""


@dataclass(frozen=True)
class Block:
    """Settings of a block's rows."""

    seconds: tuple[float, ...] = ()
    """Seconds of training."""
    seeds: int = 1
    """Number of seeds."""
    after: str = ""
    """Method and seconds of an earlier row, such as instant-ngp-300s, that the word RUN in the flags stands for."""
    geometry: GeometryFlags = field(default_factory=GeometryFlags)
    """Reference of the surfaces, in the folder of all data, and how they are compared with it."""


@dataclass(frozen=True)
class Row:
    """A run of a table.

    Args:
        data: short name of its data in the table.
        method: short name of its method.
    """

    data: str
    method: str
    planned: PlannedRun
    """The run."""
    conditions: Conditions
    """Its data and budget."""
    geometry: GeometryFlags
    """Settings that judge its surface; without a reference the surface is not judged."""
    after: Row | None = None
    """The row that it is made from; None if it is made from the data alone."""

    @property
    def seconds(self) -> float:
        """Seconds of training."""
        assert self.conditions.max_seconds is not None
        return self.conditions.max_seconds

    @property
    def name(self) -> str:
        """Name of the row, also in the results."""
        seed = "" if self.planned.seed == FIRST_SEED else f"-seed{self.planned.seed}"
        return f"{self.data}-{self.method}-{self.seconds:g}s{seed}"


@dataclass(frozen=True)
class Table:
    """The rows of a file.

    Args:
        name: name of the table: its file's, without `.yml`.
        rows: the rows, seed by seed.
        images: heading of a column -> name of the held-out image with the PSNR to show.
    """

    name: str
    rows: tuple[Row, ...]
    images: Mapping[str, str]


def read_table(
    path: Path,
    root: Path,
    runs: Path,
    scale: float = 1.0,
    lpips_weights: Path | None = None,
    num_threads: int | None = None,
) -> Table:
    """Read a table.

    Args:
        path: the YAML file.
        root: folder that contains the folders of all data.
        runs: folder for runs.
        scale: factor of all budgets; if not 1, the rows are trials.
        lpips_weights: LPIPS's weights file, for the rows that are run; None to use the lpips package.
        num_threads: CPU threads of each row that is run; None for all cores.

    Raises:
        ConfigError: if the file is not a table, or names an unknown method.
    """
    content = read_yaml(path)
    images, blocks = _texts(content.get("images", {}), f"{path}: images"), content.get("rows")
    if not isinstance(blocks, list) or content.keys() - {"images", "rows"}:
        raise ConfigError(f"{path}: a table has a list of 'rows' and optionally 'images', nothing else")
    rows: dict[str, Row] = {}
    weights = None if lpips_weights is None else str(lpips_weights.resolve())
    for number, block in enumerate(blocks):
        where = f"{path}: rows {number + 1}"
        for row in _rows(block, where, root.resolve(), runs.resolve(), scale, rows.values()):
            row = replace(row, conditions=replace(row.conditions, lpips_weights=weights, num_threads=num_threads))
            if not re.fullmatch(r"[\w.-]+", row.name):
                raise ConfigError(f"{path}: {shown(row.name)} is not a name for a row; use letters, digits and hyphens")
            if row.name in rows:
                raise ConfigError(f"{path}: two rows are called {row.name}; rename the data or method of one")
            rows[row.name] = row
    return Table(path.stem, tuple(rows.values()), images)


def _rows(block: Any, where: str, root: Path, runs: Path, scale: float, earlier: Iterable[Row]) -> Iterator[Row]:
    """Yield the rows of a block."""
    if not isinstance(block, dict):
        raise ConfigError(f"{where} is {shown(block)}; it must have data, methods, seconds, and optionally seeds")
    data, methods = (_texts(block.get(name), f"{where}: {name}") for name in ("data", "methods"))
    others = {name: value for name, value in block.items() if name not in ("data", "methods")}
    numbers = from_plain(Block(), others, where)
    if not data or not methods or not numbers.seconds or numbers.seeds < 1:
        raise ConfigError(f"{where} has no rows; it must have data, methods, seconds, and at least one seed")
    contenders, geometry = _contenders(methods, numbers, where), _below(root, numbers.geometry)
    for seed in range(FIRST_SEED, FIRST_SEED + numbers.seeds):
        for data_name, place in data.items():
            after = _earlier(numbers.after, earlier, data_name, seed, scale, where) if numbers.after else None
            # The label gives runs with other flags of the method or data another folder.
            origin = f"on {place or 'the embedded scene'}" + (f" after {numbers.after}" if after else "")
            for seconds in numbers.seconds:
                for method_name, contender in contenders.items():
                    conditions = _conditions(place, root, seconds * scale, None if scale == 1 else TRIED)
                    conditions = replace(conditions, geometry=geometry.words() if geometry.reference else ())
                    check_data(contender, conditions, where)
                    flags = tuple(str(after.planned.folder) if after and w == RUN else w for w in contender.flags)
                    labelled = replace(contender, label=f"{methods[method_name]} {origin}", flags=flags)
                    planned = planned_run(labelled, seed, runs / f"{seconds * scale:g}s")
                    yield Row(data_name, method_name, planned, conditions, geometry, after)


def _contenders(methods: Mapping[str, str], block: Block, where: str) -> dict[str, Contender]:
    """Return the contenders of a block by their short names, after checking that they fit its settings."""
    contenders = {name: contender_of(method) for name, method in methods.items()}
    for contender in contenders.values():
        if (RUN in contender.flags) != bool(block.after):
            raise ConfigError(f"{where}: the word {RUN} in a method's flags and 'after' belong together; give both")
        if block.seeds > 1 and contender.method in PROGRAMS and not block.after:
            raise ConfigError(f"{where}: {contender.method} has no seed; leave out 'seeds'")
    return contenders


def _earlier(name: str, rows: Iterable[Row], data: str, seed: int, scale: float, where: str) -> Row:
    """Return the one of the earlier `rows` of `data` with a `seed` and a `name` of method and seconds."""
    of_data = (row for row in rows if (row.data, row.planned.seed) == (data, seed))
    found = next((row for row in of_data if f"{row.method}-{row.seconds / scale:g}s" == name), None)
    if found is None:
        raise ConfigError(f"{where}: after: no row above is {shown(name)} of {data} with seed {seed}")
    return found


def _below(root: Path, geometry: GeometryFlags) -> GeometryFlags:
    """Return flags with their files in the folder `root`."""
    given = {name: getattr(geometry, name) for name in FILES}
    files: dict[str, Any] = {name: root / file for name, file in given.items() if file is not None}
    return replace(geometry, **files)


def _texts(value: Any, where: str) -> dict[str, str]:
    """Return a mapping of names to texts unchanged, or raise ConfigError."""
    if isinstance(value, dict) and all(isinstance(item, str) for item in (*value, *value.values())):
        return value
    raise ConfigError(f"{where} is {shown(value)}; it must have names with a text each")


def _conditions(place: str, root: Path, seconds: float, views: int | None) -> Conditions:
    """Return the conditions of a row."""
    words = split_words(place, "data")
    folder = words[0] if words and not words[0].startswith("--") else None
    if folder is None:
        return conditions(None, words, seconds, views)
    return conditions(str(root / folder), words[1:], seconds, views)


def kept(row: Row, file: Path) -> Result | None:
    """Return the result of a `row` in the `file` of its table, or None if it is not there.

    Raises:
        ConfigError: if the result is of another command.
    """
    if (found := read_rows(file).get(row.name)) is None:
        return None
    made_by = found.get("run", {}).get("label", row.planned.contender.label)
    if made_by != row.planned.contender.label:
        raise ConfigError(
            f"{file}: {row.name} belongs to '{made_by}', not to '{row.planned.contender.label}'; remove or rename it"
        )
    return found


def run_rows(rows: Sequence[Row], root: Path, file: Path, launcher: Launcher) -> dict[str, str]:
    """Train and judge the rows that are missing, and keep each when it is done.

    Rows that come after a run start when it has ended. It is run too, and kept, if its files are not there.

    Args:
        rows: the rows.
        root: folder of the folders of all data, which is left out of the results.
        file: the table's results.
        launcher: runs them.

    Returns:
        Name of each failed row -> reason.

    Raises:
        ConfigError: if the launcher cannot run them, or a surface cannot be judged.
        Stopped: on a signal, after the running rows have saved.
    """
    needed = {row.name: row for row in rows if kept(row, file) is None}
    for row in tuple(needed.values()):
        while row.after is not None and not _job(row := row.after).finished():
            needed[row.name] = row
    for row in needed.values():
        row.geometry.check_geometry()

    def keep(job: Job) -> None:
        add_row(file, job.title, found := result_of(needed[job.title], root))
        say(f"  {job.title}: PSNR {found['results']['psnr']:.2f} dB")

    failures, waiting = dict[str, str](), dict(needed)
    while ready := [_job(row) for row in waiting.values() if row.after is None or _job(row.after).finished()]:
        for job in ready:
            del waiting[job.title]
        found = launcher.run(ready, keep)
        failures |= {job.title: f"{failure.reason} (full output: {failure.log})" for job, failure in found.items()}
    for row in waiting.values():
        if row.after is not None and row.after.name in failures:
            failures[row.name] = f"{row.after.name}, which it comes after, failed"
    return failures


def _job(row: Row) -> Job:
    """Return a row as a job, with its name as the title."""
    return replace(job_of(row.planned, row.conditions), title=row.name)


def result_of(row: Row, root: Path) -> Result:
    """Return the result of a finished `row`, without paths of the machine: names of files begin below `root`."""
    planned = row.planned
    evaluation, summary = read_json(planned.evaluation), read_json(planned.folder / SUMMARY)
    words = planned.user_command(row.conditions)
    if row.after is not None:
        words = [RUN if word == str(row.after.planned.folder) else word for word in words]
        before = read_json(row.after.planned.evaluation)["results"]
        summary["after"] = {"row": row.after.name, "psnr": before["psnr"], "fps": before["fps"]}
    run = {
        "label": planned.contender.label,
        "command": shlex.join(words).replace(f"{root.resolve()}/", ""),
        "seed": planned.seed,
        "date": datetime.now(timezone.utc).date().isoformat(),
        **{name: value for name, value in summary.items() if name != "method"},
        "decisions": list(decisions_of(planned.folder)),
    }
    images = evaluation.pop("per_image")
    if evaluation.get("geometry") is not None:
        evaluation["geometry"]["reference"] = Path(evaluation["geometry"]["reference"]).name
    return {**evaluation, "experiment_name": row.data, "run": run, "per_image": images}
