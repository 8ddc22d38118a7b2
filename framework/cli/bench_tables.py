"""The benchmark `ns-bench tables`: its flags, and what it does with them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError, shown
from nerfloom.cli.bench_results import RESULTS
from nerfloom.cli.common import check_weights, make_room


@dataclass(frozen=True, kw_only=True)
class TablesFlags:
    """Train and judge the rows of tables of results, each in its own process, and keep each as a JSON file.

    Rows whose file is there are left out, and a row that was stopped goes on: the same command continues."""

    tables: tuple[Path, ...]
    """Files of the tables, such as configs/tables/captures.yml."""
    data_root: Path = Path("data")
    """Folder of the folders of data that the tables name."""
    only: str = ""
    """Regular expression that is found in the names of the rows to run, such as ^fox or seed43; all if not given."""
    show: Literal["rows", "markdown"] | None = None
    """Run none. rows: list them, and how long those that are missing will take. markdown: print the tables, with means
    over seeds."""
    seconds_scale: float = 1.0
    """Factor of all budgets, such as 0.02 to try a table; then three held-out images of each row are judged."""
    lpips_weights: Path | None = None
    """File of weights of LPIPS with AlexNet (.npz), for the rows that are run."""
    run_dir: Path = Path("outputs/tables")
    """Folder of the runs, with the last checkpoint and some pictures of each."""
    output_dir: Path = RESULTS
    """Folder of the results, a file for each row."""


def measure_tables(flags: TablesFlags) -> None:
    """Run what is missing, or list or print what there is.

    Args:
        flags: the flags of the command.

    Raises:
        ConfigError: if a table cannot be read, or a row failed.
    """
    from nerfloom.tools.benchmarks.table_text import listing, markdown
    from nerfloom.tools.benchmarks.tables import read_table, run_rows

    if not flags.seconds_scale > 0:
        raise FlagError(f"--seconds-scale is {flags.seconds_scale}; it must be more than 0")
    try:
        wanted = re.compile(flags.only)
    except re.error as error:
        raise FlagError(f"--only {shown(flags.only)} is no regular expression: {error}") from error
    check_weights(flags.lpips_weights)
    tables = [
        read_table(path, flags.data_root, flags.run_dir, flags.seconds_scale, flags.lpips_weights)
        for path in flags.tables
    ]
    if flags.show == "markdown":
        print("\n\n".join(markdown(table, flags.output_dir, wanted) for table in tables))
        return
    named = {row.name: row for table in tables for row in table.rows}  # tables may share rows
    rows = [row for row in named.values() if wanted.search(row.name)]
    if not rows:
        raise FlagError(f"--only {shown(flags.only)}: no row has such a name; --show rows lists them")
    if flags.show == "rows":
        print(listing(rows, flags.output_dir))
        return
    make_room(flags.output_dir / f"{rows[0].name}.json")
    failures = run_rows(rows, flags.data_root, flags.output_dir)
    say(f"{len(rows) - len(failures)} of {len(rows)} rows are in {flags.output_dir}")
    if failures:
        raise ConfigError(f"{len(failures)} rows failed, first {next(iter(failures))}: {next(iter(failures.values()))}")
