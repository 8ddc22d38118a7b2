"""A trained run meets its data where they were placed in training, or says that they are not there."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import DataParser, ParsedScene
from nerfloom.base.errors import DataError
from nerfloom.base.splits import Split
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.registry import load_method
from nerfloom.training.run import TRANSFORMS, Run, write_transforms
from tests.dataparsers.captures import write_capture

TURNED = [[0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 1.0, -2.0], [1.0, 0.0, 0.0, 5.0]]


def trained_on(folder: Path, parser: DataParser, **changes: Any) -> Run:
    """A run, as training leaves it, of a capture that is scaled and turned; `changes` go into its transforms.json."""
    data = write_capture(folder / "capture", count=12, **changes)
    run = Run("nerfacto", dataclasses.replace(load_method("nerfacto").config, data=data), "nerfstudio", parser, folder)
    write_transforms(run, load_dataset(run.parse("train"), "train"))
    return run


def without_a_photograph(run: Run) -> None:
    assert run.config.data is not None
    (run.config.data / "images" / "003.png").unlink()


def poses_of(run: Run) -> dict[str, Tensor]:
    """The pose of every image, by name."""
    parsed = [run.parse(split) for split in ("train", "val")]  # type: ignore[arg-type]
    return {
        path.name: pose
        for scene in parsed
        for path, pose in zip(scene.image_paths, scene.cameras.camera_to_worlds, strict=True)
    }


def test_the_same_data_are_read_as_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = trained_on(tmp_path, Nerfstudio())
    fresh = dataclasses.replace(run, folder=tmp_path / "new")
    capsys.readouterr()
    before, after = poses_of(fresh), poses_of(run)
    assert len(after) == 12
    assert all(torch.equal(after[name], pose) for name, pose in before.items())
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("changes", [{}, {"applied_transform": TURNED, "applied_scale": 2.5}], ids=["plain", "applied"])
def test_without_a_photograph_the_others_stay_where_they_were(
    changes: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mean of the remaining positions would move every camera."""
    run = trained_on(tmp_path, Nerfstudio(), **changes)
    then = poses_of(run)
    without_a_photograph(run)
    capsys.readouterr()
    now, anew = poses_of(run), poses_of(dataclasses.replace(run, folder=tmp_path / "new"))
    said = " ".join(capsys.readouterr().err.split())
    assert len(now) == len(anew) == 11
    for name, pose in now.items():
        torch.testing.assert_close(pose, then[name], rtol=1e-5, atol=1e-5)
    assert min((pose - then[name]).abs().max().item() for name, pose in anew.items()) > 0.01
    assert f"have changed since {tmp_path} was trained" in said
    recorded, found = json.loads((tmp_path / TRANSFORMS).read_text()), run.parse("train")
    assert found.transform is not None
    then = torch.tensor(recorded["transform"], dtype=torch.float64)
    torch.testing.assert_close(found.transform, then, rtol=1e-5, atol=1e-5)
    assert found.scale == pytest.approx(recorded["scale"])


def test_a_placement_that_is_asked_for_is_that_of_the_run(tmp_path: Path) -> None:
    """Other settings, and another part of the photographs, do not change the placement."""
    run = trained_on(tmp_path, Nerfstudio())
    then = poses_of(run)
    without_a_photograph(run)
    asked = Nerfstudio(placement=tmp_path / TRANSFORMS, scale_factor=3.0, orientation_method="pca")
    now = poses_of(dataclasses.replace(run, parser=asked, folder=tmp_path / "new"))
    for name, pose in now.items():
        torch.testing.assert_close(pose, then[name], rtol=1e-5, atol=1e-5)
    missing = Nerfstudio(placement=tmp_path / "nowhere.json")
    with pytest.raises(DataError, match=r"nowhere\.json"):
        dataclasses.replace(run, parser=missing, folder=tmp_path / "new").parse("train")


@dataclass(frozen=True)
class Plugin(DataParser):
    """A format that knows nothing of placements."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        return Nerfstudio().parse(path, split)


def test_where_a_format_cannot_place_them_as_then_data_are_refused(tmp_path: Path) -> None:
    run = trained_on(tmp_path, Plugin())
    assert len(poses_of(run)) == 12
    without_a_photograph(run)
    with pytest.raises(DataError, match=r"was trained, by up to [\d.]+ %"):
        run.parse("val")


def test_a_damaged_placement_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = trained_on(tmp_path, Nerfstudio())
    (tmp_path / TRANSFORMS).write_text(json.dumps({"scale": -1}))
    assert len(run.parse("train").image_paths) == 10
    said = capsys.readouterr().err
    assert said.count("the placement of the data is not checked") == 1
    assert TRANSFORMS in said
