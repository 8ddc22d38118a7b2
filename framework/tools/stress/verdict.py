"""What is said of a run under a condition, beside the plain run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from framework.base.console import say
from framework.tools.stress.conditions import PLAIN, Condition
from framework.tools.stress.faults import spoiled_batches
from framework.tools.stress.scenes import Views
from framework.tools.stress.trial import Budget, Trial, attempt
from framework.training.run import Run

Outcome = Literal["pass", "degraded", "refused", "fail"]
"""refused: with a clear error, where that is as good an answer as a result."""
LEAST_LEARNT = 3.0
"""dB above empty pictures that a plain run must reach: beside one that has learnt nothing, everything passes."""


@dataclass(frozen=True)
class Verdict:
    """A line of the table."""

    name: str
    """The condition."""
    outcome: Outcome
    psnr: float | None
    """Of the test views, dB; None where there is none."""
    lost: float | None
    """dB less than the plain run; negative where it is better, None where either has no PSNR."""
    skipped: int
    """Steps dropped because they were not finite."""
    steps: int
    """Steps done."""
    seconds: float
    """Of training."""
    error: str | None
    """Why it failed or was refused, in a line."""
    reason: str | None
    """What makes it degraded, and whether that was to be expected."""

    def line(self) -> str:
        """For people."""
        psnr = "" if self.psnr is None else f"  {self.psnr:.2f} dB"
        lost = "" if self.lost is None else f" ({0.0 - self.lost:+.2f})"
        steps = f"  {self.steps} steps" if self.steps else ""
        skipped = f", {self.skipped} dropped" if self.skipped else ""
        return f"{self.outcome}{psnr}{lost}{steps}{skipped}  " + (self.error or self.reason or "")

    def cell(self) -> str:
        """For a table: the outcome, and dB more or less than the plain run; of the plain run itself, its PSNR."""
        if self.psnr is None:
            return self.outcome
        if self.lost is None or self.name == PLAIN.name:
            return f"{self.outcome} {self.psnr:.1f} dB"
        return f"{self.outcome} {0.0 - self.lost:+.1f}"


def verdicts(run: Run, views: Views, conditions: Sequence[Condition], budget: Budget) -> Iterator[Verdict]:
    """Run a method under one condition after the other; a failure does not stop the rest.

    Args:
        run: the method and its settings.
        views: the plain photographs.
        conditions: the plain one first, for the others are compared with it.
    Raises: Stopped where somebody stops it.
    """
    plain = None
    for number, condition in enumerate(conditions, start=1):
        say(f"[{number}/{len(conditions)}] {condition.name}: {condition.what}")
        trial = attempt(condition, run, views, budget)
        plain = trial.psnr if condition is PLAIN else plain
        verdict = verdict_of(condition, trial, plain)
        say(f"  {verdict.line()}")
        yield verdict


def verdict_of(condition: Condition, trial: Trial, plain: float | None) -> Verdict:
    """Judge what a run showed; `plain` is the plain run's PSNR, dB, None where it has none."""
    lost = None if plain is None or trial.psnr is None else plain - trial.psnr
    reason = None
    if trial.error is not None:
        outcome: Outcome = "refused" if trial.refused and condition.may_refuse else "fail"
    else:
        reason = "; ".join(_weaknesses(condition, trial, lost)) or None
        outcome = "pass" if reason is None else "degraded"
    return Verdict(
        condition.name, outcome, trial.psnr, lost, trial.skipped, trial.steps, trial.seconds, trial.error, reason
    )


def _weaknesses(condition: Condition, trial: Trial, lost: float | None) -> list[str]:
    found = []
    if condition is PLAIN and trial.learnt is not None and trial.learnt < LEAST_LEARNT:
        found.append(f"only {trial.learnt:.1f} dB better than empty pictures: too little to compare others with")
    if lost is not None and lost > condition.allowed:
        found.append(condition.reason or f"not to be expected: at most {condition.allowed:g} dB may be lost")
    spoiled = 0 if condition.spoil is None else spoiled_batches(trial.steps)
    if trial.skipped < spoiled:
        found.append(f"{spoiled - trial.skipped} of {spoiled} spoiled batches were learnt from")
    if trial.skipped > spoiled and not condition.may_skip:
        found.append(f"{trial.skipped - spoiled} of {trial.steps} steps were not finite")
    return found
