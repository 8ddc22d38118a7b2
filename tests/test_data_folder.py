"""Values of --data besides a data folder: parts of one, photographs, videos, nothing."""

import shlex
import shutil
from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.cli.process_data import USAGE
from nerfloom.training.data_folder import find_data, processed_folder


@pytest.mark.parametrize("part", ["transforms_train.json", "train", "."])
def test_a_part_of_a_data_folder_stands_for_it(part: str, shared_tiny: Path) -> None:
    assert find_data(shared_tiny / part) == (shared_tiny, "blender")
    assert find_data(shared_tiny / part, "blender") == (shared_tiny, "blender")


def test_what_is_called_otherwise_stands_for_itself(tiny: Path) -> None:
    """Photographs in a data folder do not stand for that folder."""
    shutil.copytree(tiny / "train", tiny / "new photographs")
    with pytest.raises(DataError, match="there are 10 images, but no camera poses"):
        find_data(tiny / "new photographs")
    (tiny / "other.json").write_text("{}")
    with pytest.raises(DataError, match=r"as a transforms\.json: --data .*other\.json nerfstudio$"):
        find_data(tiny / "other.json")
    (tiny / "scene.ZIP").touch()
    with pytest.raises(DataError, match="this is an archive; unpack it, and name the folder"):
        find_data(tiny / "scene.ZIP")
    assert find_data(tiny / "other.json", "nerfstudio") == (tiny / "other.json", "nerfstudio")


def advised(path: Path) -> list[str]:
    """The command in the message about a path."""
    with pytest.raises(DataError) as error:
        find_data(path)
    return shlex.split(str(error.value).partition("Estimate them first: ")[2].partition(" (then: ")[0])


def test_photographs_and_videos_get_a_command_to_paste(tiny: Path, tmp_path: Path) -> None:
    for folder in ("my photographs", "my photographs/below", "clips"):
        (tmp_path / folder).mkdir()
    shutil.copy(tiny / "train" / "r_0.png", tmp_path / "my photographs" / "below" / "0.PNG")
    (tmp_path / "clips" / "walk.MOV").touch()
    photographs, clip = tmp_path / "my photographs", tmp_path / "clips" / "walk.MOV"
    images = ["ns-process-data", "images", "--data", str(photographs), "--output-dir", f"{photographs}-processed"]
    assert advised(photographs) == images
    video = ["ns-process-data", "video", "--data", str(clip), "--output-dir", str(clip.with_name("walk-processed"))]
    assert advised(clip) == advised(clip.parent) == video
    assert all(f"  {kind} " in USAGE for kind in ("images", "video"))


def test_what_a_folder_looks_like_is_said_if_it_is_called_otherwise(
    shared_tiny: Path, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recipes of other programs name their formats, which many a capture is not in."""
    assert find_data(shared_tiny, "nerfstudio") == (shared_tiny, "nerfstudio")
    assert "looks like blender, not nerfstudio; to read it as such, leave out nerfstudio" in capsys.readouterr().err
    assert find_data(shared_tiny, "blender") == (shared_tiny, "blender")
    assert find_data(tiny / "train", "blender") == (tiny, "blender")
    assert not capsys.readouterr().err


def test_a_folder_around_the_data_is_told_where_they_are(shared_tiny: Path, tmp_path: Path) -> None:
    """Many archives have a folder of the same name inside, and many people keep their data sets together."""
    (tmp_path / "my scenes").mkdir()
    (tmp_path / "my scenes" / "a").symlink_to(shared_tiny)
    with pytest.raises(DataError) as error:
        find_data(tmp_path)
    place = shlex.split(str(error.value).partition("the data is in a folder inside: --data ")[2])
    assert place == [str(tmp_path / "my scenes" / "a")]
    shutil.copytree(shared_tiny, tmp_path / "my scenes" / "b")
    with pytest.raises(DataError, match="1 more folders have data"):
        find_data(tmp_path)


def test_the_output_has_a_name_even_for_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert processed_folder(Path(".")) == tmp_path.with_name(f"{tmp_path.name}-processed")
    assert processed_folder(Path("photos")) == Path("photos-processed")
