"""blocks.yml: written files are read, and every fault is refused in one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.blocks.block import IDENTITY, TrainedBlock
from nerfloom.blocks.files import BlockList, is_blocks_file, read_blocks, write_blocks
from nerfloom.training.run_path import config_file

COLOR = ((1.1, 0.0, 0.0, 0.25), (0.0, 1.0, 1e-7, 0.0), (0.0, 0.0, 0.9, -0.1))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file with two blocks; one has its run elsewhere."""
    (tmp_path / "scene" / "runs" / "000").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    blocks = (
        TrainedBlock((4e5, 5.2e6, 1e-5), 25.5, (0, 1, 7), tmp_path / "scene" / "runs" / "000"),
        TrainedBlock((0.1, 0.2, 0.3), 1e-3, (7, 8), tmp_path / "elsewhere", COLOR),
    )
    write_blocks(tmp_path / "scene" / "blocks.yml", BlockList(((-1.0, -1.0, -2.0), (1.0, 1.0, 2.0)), 0.05, 1e3, blocks))
    return tmp_path / "scene" / "blocks.yml"


def test_what_is_written_is_read(file: Path, tmp_path: Path) -> None:
    found = read_blocks(file)
    assert found.box == ((-1.0, -1.0, -2.0), (1.0, 1.0, 2.0))
    assert (found.near, found.far) == (0.05, 1e3)
    one, other = found.blocks
    assert one == TrainedBlock((4e5, 5.2e6, 1e-5), 25.5, (0, 1, 7), file.parent / "runs" / "000", IDENTITY)
    assert (other.run, other.color, other.cameras) == (tmp_path / "elsewhere", COLOR, (7, 8))


def test_the_folder_can_be_moved_with_its_runs(file: Path, tmp_path: Path) -> None:
    assert "runs/000" in file.read_text()
    moved = file.parent.rename(tmp_path / "moved")
    assert read_blocks(moved / "blocks.yml").blocks[0].run == moved / "runs" / "000"


def test_names_of_such_files(file: Path) -> None:
    assert is_blocks_file(file)
    assert is_blocks_file(Path("town.blocks.yml"))
    assert not is_blocks_file(Path("config.yml"))
    assert config_file(file.parent) == file


def changed(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.pop("version"), "version None"),
        (lambda c: c.update(version=2), "version 2"),
        (lambda c: c.update(blocks=[]), "'blocks'"),
        (lambda c: c.pop("blocks"), "'blocks'"),
        (lambda c: c.update(box=[1, 2]), "'box'"),
        (lambda c: c.update(box=[[1, 1, 1], [0, 2, 2]]), "box"),
        (lambda c: c.update(near=5.0, far=1.0), "near 5"),
        (lambda c: c.update(far=".inf"), "'far'"),
        (lambda c: c["blocks"].insert(0, "word"), "block 0"),
        (lambda c: c["blocks"][1].update(run="no/such"), "block 1: its run"),
        (lambda c: c["blocks"][1].update(run=3), "block 1: 'run'"),
        (lambda c: c["blocks"][1].update(radius=0), "block 1: 'radius'"),
        (lambda c: c["blocks"][1].update(radius=True), "block 1: 'radius'"),
        (lambda c: c["blocks"][0].update(center=[1, 2]), "block 0: 'center'"),
        (lambda c: c["blocks"][0].update(center=[1, 2, "x"]), "block 0: 'center'"),
        (lambda c: c["blocks"][0].update(cameras=[0, -1]), "block 0: 'cameras'"),
        (lambda c: c["blocks"][0].update(cameras=[True]), "block 0: 'cameras'"),
        (lambda c: c["blocks"][0].update(cameras="0"), "block 0: 'cameras'"),
        (lambda c: c["blocks"][0].update(color=[[1, 0, 0, 0]]), "block 0: 'color'"),
        (lambda c: c["blocks"][0].update(color=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "block 0: 'color'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(change: Callable[[dict[str, Any]], Any], said: str, file: Path) -> None:
    changed(file, change)
    with pytest.raises((DataError, ConfigError)) as error:
        read_blocks(file)
    message = str(error.value)
    assert str(file) in message
    assert said in message
    assert "\n" not in message


@pytest.mark.parametrize("text", ["", "- 1\n", "version: !!python/object:os.system x\n", "a: &a [*a]\n", "\0"])
def test_what_is_no_such_file_is_refused(text: str, file: Path) -> None:
    file.write_text(text)
    with pytest.raises((ConfigError, DataError)) as error:
        read_blocks(file)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"blocks\.yml"):
        read_blocks(tmp_path / "blocks.yml")
