"""A trained run meets its data where it was placed in training, or says that it is not there."""

import dataclasses
import json
from pathlib import Path

import pytest

from dataparsers.nerfstudio import Nerfstudio
from framework.base.errors import DataError
from framework.base.registry import load_method
from framework.data.dataset import load_dataset
from framework.training.run import TRANSFORMS, Run, write_transforms
from tests.dataparsers.captures import write_capture


@pytest.fixture
def trained(tmp_path: Path) -> Run:
    """A run, as training leaves it, of a capture that is scaled and turned."""
    data = write_capture(tmp_path / "capture", count=12)
    config = dataclasses.replace(load_method("nerfacto").config, data=data)
    folder = tmp_path / "run"
    folder.mkdir()
    run = Run("nerfacto", config, "nerfstudio", Nerfstudio(), folder)
    write_transforms(run, load_dataset(run.parse("train"), "train"))
    return run


def without_a_photograph(run: Run) -> None:
    assert run.config.data is not None
    (run.config.data / "images" / "003.png").unlink()


def test_the_same_data_are_read_as_before(trained: Run) -> None:
    for split in ("train", "val"):
        assert len(trained.parse(split).image_paths) == {"train": 10, "val": 2}[split]  # type: ignore[arg-type]


def test_data_that_are_placed_otherwise_are_refused(trained: Run) -> None:
    """Every picture would be off: without a photograph, the mean position of the others is another."""
    without_a_photograph(trained)
    for split in ("train", "val"):
        with pytest.raises(DataError, match=r"placed otherwise than when .*run was trained, by up to [\d.]+ %"):
            trained.parse(split)  # type: ignore[arg-type]
    new = dataclasses.replace(trained, folder=trained.folder.with_name("new"))
    assert len(new.parse("train").image_paths) == 9


def test_another_scale_is_refused(trained: Run) -> None:
    larger = dataclasses.replace(trained, parser=Nerfstudio(scale_factor=1.1))
    with pytest.raises(DataError, match=r"by up to 9\.1 % of their distance"):
        larger.parse("train")


def test_a_damaged_placement_is_reported(trained: Run, capsys: pytest.CaptureFixture[str]) -> None:
    (trained.folder / TRANSFORMS).write_text(json.dumps({"scale": -1}))
    assert len(trained.parse("train").image_paths) == 10
    said = capsys.readouterr().err
    assert said.count("going on without a check of how the data is placed") == 1
    assert TRANSFORMS in said
