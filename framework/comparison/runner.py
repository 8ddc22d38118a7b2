"""Execution of a comparison's runs as jobs: a training and an evaluation each."""

from __future__ import annotations

from functools import partial

from nerfloom.base.device import num_gpus
from nerfloom.comparison.measures import read_json
from nerfloom.comparison.plan import Conditions, Plan, PlannedRun
from nerfloom.jobs.job import Failure, Job, Resources, Step
from nerfloom.jobs.launcher import Launcher


def run_all(plan: Plan, launcher: Launcher) -> dict[PlannedRun, Failure]:
    """Train and evaluate every unfinished run of a `plan` by a `launcher`.

    Returns:
        The failed runs.

    Raises:
        ConfigError: if the launcher cannot run them.
        Stopped: on a signal, after the running ones have saved.
    """
    planned = {job_of(run, plan.conditions): run for run in plan.runs()}
    return {planned[job]: failure for job, failure in launcher.run(list(planned)).items()}


def job_of(planned: PlannedRun, conditions: Conditions) -> Job:
    """Return a `planned` run under `conditions` as a job."""
    config = planned.folder / "config.yml"
    train = Step(tuple(planned.train_command(conditions)), config, tuple(planned.resume_command()))
    return Job(
        title=planned.title,
        description=conditions.budget(),
        steps=(train, Step(tuple(planned.eval_command(conditions)))),
        log=planned.log,
        finished=partial(is_done, planned, judges_surface=bool(conditions.geometry)),
        resources=Resources(conditions.num_threads, num_gpus(conditions.device_type)),
    )


def is_done(planned: PlannedRun, judges_surface: bool = False) -> bool:
    """Return whether a `planned` run is trained and judged, its surface too if `judges_surface`, with finite images."""
    summary, evaluation = read_json(planned.folder / "summary.json"), read_json(planned.evaluation)
    if not isinstance(summary, dict) or summary.get("interrupted") is not False or not isinstance(evaluation, dict):
        return False
    judged = not judges_surface or evaluation.get("geometry") is not None
    return judged and evaluation.get("results", {}).get("psnr") is not None
