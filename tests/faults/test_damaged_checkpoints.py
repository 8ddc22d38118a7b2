"""Checkpoints that a disk has damaged: the one before is taken, and that is said; never is one taken as it is."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from nerfloom.cli.session import resume
from nerfloom.training.checkpoint import list_checkpoints, load_checkpoint
from nerfloom.training.run import read_run
from nerfloom.training.trained import load_trained
from tests.training.helpers import tiny_trainer


@pytest.fixture(scope="module")
def whole(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of eight steps with checkpoints at four and eight, which nothing damages."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    settings = {"max_num_iterations": 8, "steps_per_save": 4, "max_eval_images": 0}
    tiny_trainer("instant-ngp", shared_tiny, folder, **settings).train()
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(whole, tmp_path / "run")


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 0x01
    path.write_bytes(content)


def places(path: Path) -> dict[str, int]:
    """Bytes of a checkpoint, by the part that has them."""
    content = path.read_bytes()
    weights = next(value for value in load_checkpoint(path)["model"].values() if len(value.unique()) > 500)
    return {
        "the first": 0,
        "what is said": content.index(b"data.pkl") + 200,
        "a weight": content.index(weights.contiguous().numpy().tobytes()[:400]) + 16,
        "the middle": len(content) // 2,
        "the list of files": content.rindex(b"PK\x01\x02") + 20,
        "the seal's name": content.rindex(b"sha256:"),
        "the seal": len(content) - 5,
    }


@pytest.mark.parametrize(
    "where", ["the first", "what is said", "a weight", "the middle", "the list of files", "the seal's name", "the seal"]
)
def test_a_run_goes_on_from_the_one_before(where: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newest = list_checkpoints(folder / "nerfstudio_models")[-1]
    assert newest.name == "step-000000008.ckpt"
    flip(newest, places(newest)[where])
    trained = load_trained(folder / "config.yml", device_type="cpu")
    assert trained.checkpoint.name == "step-000000004.ckpt"
    run = read_run(folder / "config.yml")
    resume(dataclasses.replace(run, config=dataclasses.replace(run.config, max_num_iterations=6)))
    said = " ".join(capsys.readouterr().err.split())
    assert said.count(f"{newest} is damaged") == 2
    assert said.count("trying the previous one") == 2
    assert "at step 4" in said
