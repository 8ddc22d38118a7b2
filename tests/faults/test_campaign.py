"""Many faults in a row, in processes of their own: nothing that was committed is lost."""

from pathlib import Path

import pytest

from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from tests.faults import campaign
from tests.faults.campaign import Injected, Report, Stage
from tests.faults.runs import ended, wait_for_checkpoint

pytest.importorskip("fcntl")


@pytest.mark.slow
def test_nothing_that_was_committed_is_lost(tmp_path: Path) -> None:
    found = campaign.run(tmp_path, 20).as_plain()
    print(found)
    assert found["problems"] == []
    assert (found["injected"], found["committed_lost"]) == (20, 0)
    assert found["runs_with_the_same_end"] == found["runs"] > 1
    assert {"SIGKILL", "SIGTERM", "full disk", "second process"} <= set(found["faults"])


def killed_and_robbed(stage: Stage) -> int:
    """A fault that takes the newest checkpoint with it."""
    process = stage.start()
    wait_for_checkpoint(process, stage.folder)
    process.kill()
    ended(process)
    newest = list_checkpoints(stage.folder / FOLDER)[-1]
    newest.unlink()
    return int(newest.stem.removeprefix("step-"))


@pytest.mark.slow
def test_a_loss_is_noticed(tmp_path: Path) -> None:
    """Or the campaign proves nothing."""
    found = campaign.run(tmp_path, 1, faults={"theft": killed_and_robbed}).as_plain()
    assert found["faults"] == {"theft": 1}
    assert found["committed_lost"] == 1
    assert found["runs_with_the_same_end"] == 0
    assert "what was committed is lost" in found["problems"][0]


def test_what_is_left_is_compared_with_what_was_committed() -> None:
    faults = (Injected("SIGKILL", -1, -1), Injected("full disk", 3, 3), Injected("SIGKILL", 5, 4))
    assert Report(faults, 2, ("run 2: lost",)).as_plain() == {
        "injected": 3,
        "faults": {"SIGKILL": 2, "full disk": 1},
        "committed_lost": 1,
        "runs": 2,
        "runs_with_the_same_end": 1,
        "problems": ["run 2: lost"],
    }
