"""The verdict on a run's figures."""

import math

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.stress.conditions import MAX_LOSS, PLAIN, Condition
from nerfloom.stress.faults import spoiled_pixel
from nerfloom.stress.trial import Trial, in_a_line
from nerfloom.stress.verdict import MIN_LEARNT, Outcome, verdict_of

HARD = Condition("hard", "anything")
EXPLAINED = Condition("explained", "anything", reason="who could do better")
LENIENT = Condition("lenient", "anything", may_refuse=True, may_skip=True)
SPOILED = Condition("spoiled", "anything", spoil=spoiled_pixel(math.nan))
"""100 of the batches of 300 steps."""
BROKEN = "RuntimeError: it broke"


@pytest.mark.parametrize(
    ("condition", "trial", "outcome", "lost", "why"),
    [
        (PLAIN, Trial(30.0, 300), "pass", 0.0, None),
        (PLAIN, Trial(30.0, 300, learnt=MIN_LEARNT), "pass", 0.0, None),
        (PLAIN, Trial(30.0, 300, learnt=1.0), "degraded", 0.0, "only 1.0 dB better than empty images"),
        (HARD, Trial(30.0, 300, learnt=0.0), "pass", 0.0, None),
        (HARD, Trial(29.0, 300), "pass", 1.0, None),
        (HARD, Trial(41.0, 300), "pass", -11.0, None),
        (HARD, Trial(30.0 - MAX_LOSS - 0.1, 300), "degraded", MAX_LOSS + 0.1, "unexpected: at most 2 dB"),
        (EXPLAINED, Trial(12.0, 300), "degraded", 18.0, "who could do better"),
        (EXPLAINED, Trial(29.5, 300), "pass", 0.5, None),
        (HARD, Trial(30.0, 300, skipped=7), "degraded", 0.0, "7 of 300 steps were not finite"),
        (LENIENT, Trial(30.0, 300, skipped=100), "pass", 0.0, None),
        (EXPLAINED, Trial(12.0, 300, 7), "degraded", 18.0, "who could do better; 7 of 300 steps were not finite"),
        (SPOILED, Trial(30.0, 300, skipped=100), "pass", 0.0, None),
        (SPOILED, Trial(30.0, 300, skipped=60), "degraded", 0.0, "40 of 100 spoiled batches were learnt from"),
        (SPOILED, Trial(30.0, 300, skipped=107), "degraded", 0.0, "7 of 300 steps were not finite"),
        (HARD, Trial(error=BROKEN), "fail", None, BROKEN),
        (HARD, Trial(error="no such thing", refused=True), "fail", None, "no such thing"),
        (LENIENT, Trial(error="no such thing", refused=True), "refused", None, "no such thing"),
        (LENIENT, Trial(error=BROKEN), "fail", None, BROKEN),
        (HARD, Trial(29.0, 300, error="the parameter x is not finite"), "fail", 1.0, "the parameter x is not finite"),
    ],
)
def test_verdicts(condition: Condition, trial: Trial, outcome: Outcome, lost: float | None, why: str | None) -> None:
    found = verdict_of(condition, trial, plain=30.0)
    assert (found.name, found.outcome) == (condition.name, outcome)
    assert found.lost == (None if lost is None else pytest.approx(lost))
    assert (found.steps, found.skipped, found.psnr) == (trial.steps, trial.skipped, trial.psnr)
    said = found.error or found.reason
    assert (said is None) == (why is None)
    assert (why or "") in (said or "")
    assert (found.error is not None) == (outcome in ("fail", "refused"))
    assert (found.reason is not None) == (outcome == "degraded")
    assert outcome in found.line()


def test_without_a_plain_run_to_compare_with_a_sound_run_passes() -> None:
    found = verdict_of(HARD, Trial(12.0, 300), plain=None)
    assert (found.outcome, found.psnr, found.lost) == ("pass", 12.0, None)
    assert "nan" not in found.line()
    assert math.isfinite(found.seconds)


@pytest.mark.parametrize(
    ("condition", "trial", "plain", "cell"),
    [
        (PLAIN, Trial(31.3, 300), 31.3, "pass 31.3 dB"),
        (HARD, Trial(29.0, 300), 30.0, "pass -1.0"),
        (HARD, Trial(41.0, 300), 30.0, "pass +11.0"),
        (HARD, Trial(12.0, 300), None, "pass 12.0 dB"),
        (EXPLAINED, Trial(12.0, 300), 30.0, "degraded -18.0"),
        (HARD, Trial(error=BROKEN), 30.0, "fail"),
        (HARD, Trial(29.0, 300, error="the parameter x is not finite"), 30.0, "fail -1.0"),
        (LENIENT, Trial(error="no such thing", refused=True), 30.0, "refused"),
    ],
)
def test_what_stands_in_a_table(condition: Condition, trial: Trial, plain: float | None, cell: str) -> None:
    assert verdict_of(condition, trial, plain).cell() == cell


def test_an_error_is_a_line_and_says_its_type_unless_it_is_for_users() -> None:
    assert in_a_line(ConfigError("one  two")) == "one two"
    assert in_a_line(ValueError("one\n  two")) == "ValueError: one two"
    assert in_a_line(KeyError("name")) == "KeyError: 'name'"
