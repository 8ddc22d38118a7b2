"""Verdicts on runs under hard conditions, compared with the plain run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from nerfloom.base.console import say
from nerfloom.registry import load_method
from nerfloom.stress.conditions import PLAIN, Condition
from nerfloom.stress.faults import spoiled_batches
from nerfloom.stress.scenes import Views
from nerfloom.stress.trial import Budget, Trial, attempt
from nerfloom.training.run import Run

Outcome = Literal["pass", "degraded", "refused", "fail", "not applicable"]
"""Outcome of a run. refused: it ended with a clear error, which is accepted instead of a result. not applicable: there
was no run, because the condition does not affect the method."""
MIN_LEARNT = 3.0
"""Minimum PSNR of the plain run above the PSNR of empty images, dB; with a lower one, every run would pass."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a run under a condition."""

    name: str
    """Name of the condition."""
    outcome: Outcome
    """Outcome of the run."""
    psnr: float | None
    """PSNR of the test views, dB; None if it is not finite."""
    lost: float | None
    """PSNR of the plain run minus this one's, dB; None if either has none."""
    skipped: int
    """Number of steps dropped because they were not finite."""
    steps: int
    """Number of training steps done."""
    seconds: float
    """Seconds of training."""
    error: str | None
    """Message of the error of a failed or refused run; None without an error."""
    reason: str | None
    """Reasons for degraded or not applicable; None otherwise."""

    def line(self) -> str:
        """Return the verdict as a line of text."""
        psnr = "" if self.psnr is None else f"  {self.psnr:.2f} dB"
        lost = "" if self.lost is None else f" ({0.0 - self.lost:+.2f})"
        steps = f"  {self.steps} steps" if self.steps else ""
        skipped = f", {self.skipped} dropped" if self.skipped else ""
        return f"{self.outcome}{psnr}{lost}{steps}{skipped}  " + (self.error or self.reason or "")

    def cell(self) -> str:
        """Return the text of a table cell: the outcome and the difference of PSNR, or the PSNR of the plain run."""
        if self.psnr is None:
            return self.outcome
        if self.lost is None or self.name == PLAIN.name:
            return f"{self.outcome} {self.psnr:.1f} dB"
        return f"{self.outcome} {0.0 - self.lost:+.1f}"


def verdicts(run: Run, views: Views, conditions: Sequence[Condition], budget: Budget) -> Iterator[Verdict]:
    """Run a method under each condition in turn, and yield the verdicts; a failure does not stop the rest.

    Args:
        run: the method and its settings.
        views: the plain images.
        conditions: the conditions; the first is `PLAIN`, the reference.
        budget: length of each run.

    Raises:
        Stopped: if a signal stops a run.
    """
    plain = None
    for number, condition in enumerate(conditions, start=1):
        say(f"[{number}/{len(conditions)}] {condition.name}: {condition.what}")
        if condition.rays is not None and load_method(run.method).model.batches == "views":
            verdict = _not_applicable(condition, "a step draws a whole image")
        else:
            trial = attempt(condition, run, views, budget)
            plain = trial.psnr if condition is PLAIN else plain
            verdict = verdict_of(condition, trial, plain)
        say(f"  {verdict.line()}")
        yield verdict


def _not_applicable(condition: Condition, why: str) -> Verdict:
    return Verdict(condition.name, "not applicable", None, None, 0, 0, 0.0, None, why)


def verdict_of(condition: Condition, trial: Trial, plain: float | None) -> Verdict:
    """Return the verdict on a `trial` under a `condition`, given the `plain` run's PSNR, dB, or None."""
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
    weaknesses = []
    if condition is PLAIN and trial.learnt is not None and trial.learnt < MIN_LEARNT:
        weaknesses.append(f"only {trial.learnt:.1f} dB better than empty images: too little for comparisons")
    if lost is not None and lost > condition.allowed:
        weaknesses.append(condition.reason or f"unexpected: at most {condition.allowed:g} dB may be lost")
    spoiled = 0 if condition.spoil is None else spoiled_batches(trial.steps)
    if trial.skipped < spoiled:
        weaknesses.append(f"{spoiled - trial.skipped} of {spoiled} spoiled batches were learnt from")
    if trial.skipped > spoiled and not condition.may_skip:
        weaknesses.append(f"{trial.skipped - spoiled} of {trial.steps} steps were not finite")
    return weaknesses
