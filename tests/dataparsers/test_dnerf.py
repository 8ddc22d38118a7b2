"""The D-NeRF format: NeRF-Synthetic's, with times."""

from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.base.splits import Split
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.dnerf import DNeRF
from nerfloom.training.data_folder import find_data
from tests.conftest import EditJson


def test_times_make_a_moving_scene(tiny: Path, edit_json: EditJson) -> None:
    edit_json(lambda c: [frame.update(time=i / 9) for i, frame in enumerate(c["frames"])])
    assert find_data(tiny)[1] == "dnerf"
    data = load_dataset(DNeRF().parse(tiny, "train"), "train")
    assert data.scene.moving
    assert data.times is not None
    torch.testing.assert_close(data.times, torch.arange(10) / 9)


def test_without_times_it_is_the_blender_format(tiny: Path) -> None:
    assert find_data(tiny)[1] == "blender"
    with pytest.raises(DataError, match="no frame has a 'time'"):
        DNeRF().parse(tiny, "train")


@pytest.mark.parametrize("content", ["", "[]", "{", '{"frames": 3}', '{"frames": []}', '{"frames": ["time"]}'])
def test_broken_files_are_not_recognised_as_moving(content: str, tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text(content)
    assert not DNeRF.recognizes(tmp_path)
    assert Blender.recognizes(tmp_path)


@pytest.mark.data
@pytest.mark.parametrize(("split", "count"), [("train", 150), ("val", 5), ("test", 20)])
def test_real_moving_scene(real_data: Path, split: Split, count: int) -> None:
    folder = real_data / "bouncingballs"
    assert find_data(folder)[1] == "dnerf"
    parsed = DNeRF().parse(folder, split)
    assert parsed.times is not None
    assert len(parsed.times) == count
    assert 0 <= parsed.times.min() <= parsed.times.max() <= 1
