"""The line of a run in training: share, time left, and the held-out PSNR with its age, of this process alone."""

from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.progress import StepReport, share_and_time
from nerfloom.training.state import State
from tests.training.helpers import tiny_trainer

FIRST = StepReport(101, 60.0, 0.5, {"rgb": torch.tensor(0.25)}, 20.0, 4_100.0, None)


def test_the_time_left_is_that_of_the_speed_of_this_process() -> None:
    assert share_and_time(FIRST, FIRST) == "50 %, – left"
    assert share_and_time(FIRST, replace(FIRST, seconds=70.0, progress=0.6)) == "60 %, 40 s left"
    assert share_and_time(FIRST, replace(FIRST, seconds=110.0, progress=1.0)) == "100 %, 0 s left"


def test_the_held_out_psnr_has_its_age_or_is_a_dash() -> None:
    assert FIRST.line() == "step 101  loss 0.25000  PSNR 20.00 dB  held out –  4.1k rays/s"
    assert "  held out 31.20 dB (12 s ago)  " in replace(FIRST, held_out=(31.2, 12.0)).line()


def test_the_newest_evaluation_counts_and_none_of_an_earlier_process() -> None:
    state = State(step=300, seconds=90.0)
    assert state.newest_held_out(0) is None
    state.looks = ((10.0, 50, 15.0), (40.0, 150, 21.0))
    assert state.newest_held_out(0) == (21.0, 50.0)
    state.curve = ((60.0, 200, 22.5),)
    assert state.newest_held_out(199) == (22.5, 30.0)
    state.looks += ((70.0, 250, 23.0),)
    assert state.newest_held_out(200) == (23.0, 20.0)
    assert state.newest_held_out(250) is None


def test_a_resumed_run_does_not_show_what_an_earlier_process_has_measured(shared_tiny: Path, tmp_path: Path) -> None:
    first = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "a", evaluated=True, max_num_iterations=4)
    report = first.train_step()
    first.state.looks = ((report.seconds, report.step, 5.52),)
    report = first.train_step()
    assert (report.held_out or (0.0,))[0] == 5.52
    second = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "b", evaluated=True, max_num_iterations=4)
    second.restore(load_checkpoint(first.save()))
    assert second.train_step().held_out is None
