"""The report on a run of several methods."""

import json
from pathlib import Path

from nerfloom.stress.report import Result, markdown, notes, settings_of, table
from nerfloom.stress.scenes import ball_views
from nerfloom.stress.trial import Budget
from nerfloom.stress.verdict import Outcome, Verdict
from tests.training.helpers import tiny_run

MACHINE = {
    "processor": "a processor", "device": "cpu", "threads": 2, "kernels": "avx2", "torch": "2.6", "nerfloom": "1.0",
    "commit": "0123456789ab",
}  # fmt: skip


def verdict(name: str, outcome: Outcome, psnr: float | None, lost: float | None, why: str | None = None) -> Verdict:
    error, reason = (None, why) if outcome == "degraded" else (why, None)
    return Verdict(name, outcome, psnr, lost, 0, 300, 1.0, error, reason)


RESULTS = [
    Result("one", MACHINE, {}, (verdict("plain", "pass", 30.0, 0.0), verdict("hard", "degraded", 20.0, 10.0, "dark"))),
    Result("two --x a|b", MACHINE, {}, (verdict("plain", "pass", 25, 0), verdict("hard", "fail", None, None, "no"))),
]


def test_a_row_for_each_condition_and_a_column_for_each_method() -> None:
    assert table(RESULTS) == [
        ["condition", "one", "two --x a|b"],
        ["plain", "pass 30.0 dB", "pass 25.0 dB"],
        ["hard", "degraded -10.0", "fail"],
    ]


def test_what_is_no_pass_has_its_reason() -> None:
    assert notes(RESULTS) == ["one, hard: degraded: dark", "two --x a|b, hard: fail: no"]


def test_markdown() -> None:
    assert markdown(RESULTS) == (
        "| condition | one | two --x a\\|b |\n"
        "| --- | --- | --- |\n"
        "| plain | pass 30.0 dB | pass 25.0 dB |\n"
        "| hard | degraded -10.0 | fail |\n"
        "\n"
        "- one, hard: degraded: dark\n"
        "- two --x a|b, hard: fail: no\n"
        "\n"
        "a processor, cpu, 2 threads, avx2 kernels; torch 2.6, nerfloom 1.0 at 0123456789ab.\n"
    )


def test_settings_are_those_of_the_short_run_without_folders(tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", tmp_path / "data", tmp_path / "run")
    found = settings_of(run, Budget(7, None), ball_views().train.scene)
    assert found["max_num_iterations"] == 7
    assert found["num_levels"] == 4
    assert found["machine"]["seed"] == 42
    assert not {"data", "output_dir"} & set(found)
    assert str(tmp_path) not in json.dumps(found)
