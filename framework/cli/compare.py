"""The command `ns-compare`: several methods on one data set, under the same conditions, and a report."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.base.errors import ConfigError
from nerfloom.cli.common import check_weights, entry_point, take
from nerfloom.cli.flags import read_flags
from nerfloom.cli.geometry_flags import GeometryFlags
from nerfloom.cli.job_flags import JobFlags
from nerfloom.training.run_path import check_data, check_writable, data_name

if TYPE_CHECKING:
    from nerfloom.comparison.measures import Row
    from nerfloom.comparison.plan import Plan
    from nerfloom.jobs.launcher import Launcher


@dataclass(frozen=True)
class CompareFlags(JobFlags, GeometryFlags):
    """Compare methods on one data set: each is trained and evaluated under the same conditions, in its own process.

    Writes report.html, report.md, results.json and results.csv. If run again, it continues where it was stopped."""

    methods: tuple[str, ...] = ()
    """Methods; quote a method with flags: instant-ngp "vanilla-nerf --sampler occupancy"."""
    max_seconds: float | None = None
    """Seconds of training of each method, without evaluation and saving."""
    max_num_iterations: int | None = None
    """Training steps of each method."""
    target_psnr: float | None = None
    """Stop training a method when its validation views reach this PSNR, dB."""
    repeats: int = 1
    """Number of runs of each method, with different seeds."""
    output_dir: Path | None = None
    """Folder of runs and report. Default: outputs/compare-DATA."""
    max_eval_images: int | None = None
    """Maximum number of held-out views in the final evaluation, evenly spaced. Default: one per second of training, at
    least 25; all without --max-seconds. The report states the number."""
    lpips_weights: Path | None = None
    """File of LPIPS weights with AlexNet (.npz). Default: the weights of the lpips package, if installed."""
    curve_images: int = 4
    """Number of views in evaluations during training; 0: none."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-compare on the `arguments` of the process."""
    from nerfloom.base.plain import from_plain, read_yaml

    recipe, arguments = take(arguments, "--load-config")
    default = CompareFlags() if recipe is None else from_plain(CompareFlags(), read_yaml(Path(recipe)), recipe)
    flags = read_flags(CompareFlags, "ns-compare", arguments, default=default)
    if flags.data is not None:
        check_data(flags.data)
    check_writable(flags.output_dir or Path("outputs"), "the comparison's folder")
    plan = plan_of(flags)
    from nerfloom.base.console import say

    rows = compare(plan, flags.chosen_launcher(plan.folder))
    failed = [row.label for row in rows if row.failures]
    say(f"report: {plan.folder / 'report.html'} (also report.md, results.json, results.csv)")
    if failed:
        raise ConfigError(f"{len(failed)} of {len(rows)} methods failed: {', '.join(failed)}; the report says why")


def plan_of(flags: CompareFlags) -> Plan:
    """Return the plan of the comparison that `flags` describe.

    Raises:
        ConfigError: if a flag's value is invalid, or flags contradict each other.
    """
    from nerfloom.comparison.plan import Conditions, Contender, Plan, split_words, views_for
    from nerfloom.training.data_folder import find_data

    if flags.data is not None and not os.path.isdir(flags.data):
        flags = replace(flags, data=find_data(flags.data)[0])
    check_weights(flags.lpips_weights)
    flags.check_geometry()
    conditions = Conditions(
        data=None if flags.data is None else str(flags.data.resolve()),
        data_flags=split_words(flags.data_flags, "--data-flags"),
        max_seconds=flags.max_seconds,
        max_num_iterations=flags.max_num_iterations,
        target_psnr=flags.target_psnr,
        num_threads=flags.num_threads,
        device_type=flags.device_type,
        curve_images=flags.curve_images,
        max_eval_images=views_for(flags.max_seconds) if flags.max_eval_images is None else flags.max_eval_images,
        lpips_weights=None if flags.lpips_weights is None else str(flags.lpips_weights.resolve()),
        geometry=() if flags.reference is None else flags.words(),
    )
    name = data_name(flags.data)
    folder = flags.output_dir or Path("outputs") / f"compare-{name}"
    return Plan(tuple(Contender.of(text) for text in flags.methods), conditions, flags.repeats, folder.resolve())


def compare(plan: Plan, launcher: Launcher | None = None) -> list[Row]:
    """Run the missing runs of a comparison, write its report and print its table.

    Args:
        plan: the methods, conditions and folder.
        launcher: runs them; None for processes on this machine, one after the other.

    Returns:
        A row of the table for each method.
    """
    from nerfloom.base.console import console, say
    from nerfloom.comparison import plots
    from nerfloom.comparison.measures import measure, rows_of
    from nerfloom.comparison.report import console_table, write_report
    from nerfloom.comparison.runner import run_all
    from nerfloom.jobs.processes import Processes

    if not plots.available():
        say(f"the report will be {plots.MISSING}")
    launcher = Processes() if launcher is None else launcher
    plan.claim_folder()
    failures: dict[str, list[str]] = {}
    for planned, failure in run_all(plan, launcher).items():
        failures.setdefault(planned.contender.label, []).append(
            f"seed {planned.seed}: {failure.reason} ({failure.log})"
        )
    runs = [run for run in (measure(planned, plan.conditions) for planned in plan.runs()) if run is not None]
    rows = rows_of([contender.label for contender in plan.contenders], runs, failures)
    write_report(plan, rows, launcher.sharing)
    console.print(console_table(rows))
    return rows


if __name__ == "__main__":
    main()
