"""The phototourism format: a table says which of a reconstruction's photographs are to be learnt from."""

from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.llff import Llff
from nerfloom.dataparsers.phototourism import Phototourism
from tests.dataparsers.sparse_models import Capture, make_capture, misses, write_colmap, write_images

pytest.importorskip("pycolmap")


def write_table(file: Path, names: list[str]) -> None:
    """The last two are for test; p04 has no id, and one photograph is not in the reconstruction."""
    lines = ["filename\tid\tsplit\tdataset"]
    for index, name in enumerate(names):
        number = "" if index == 4 else str(float(100 - 2 * index))
        lines.append(f"{name}\t{number}\t{'test' if index >= 8 else 'train'}\tgate")
    file.write_text("\n".join([*lines, "other.png\t7.0\ttrain\tgate"]) + "\n")


@pytest.fixture
def capture() -> Capture:
    return make_capture()


@pytest.fixture
def folder(tmp_path: Path, capture: Capture) -> Path:
    write_images(tmp_path / "dense" / "images", capture.names[:5], (60, 40))
    write_images(tmp_path / "dense" / "images", capture.names[5:], (30, 20))
    write_colmap(tmp_path / "dense" / "sparse", capture)
    write_table(tmp_path / "gate.tsv", capture.names)
    return tmp_path


def test_splits_are_the_tables(folder: Path, capture: Capture) -> None:
    assert Phototourism.recognizes(folder)
    train, val, test = (Phototourism().parse(folder, split) for split in ("train", "val", "test"))
    assert [path.name for path in train.image_paths] == [f"p{index:02d}.png" for index in (0, 1, 2, 3, 5, 6, 7)]
    assert [path.name for path in test.image_paths] == ["p08.png", "p09.png"]
    assert val.image_paths == test.image_paths
    assert train.scale == test.scale
    x, y = capture.seen(9).T
    assert misses(test, 1, (50 * x + 31) / 2, (48 * y + 19) / 2, capture.points).max() < 1e-3
    data = load_dataset(train, "train")
    assert data.scene.appearance_varies
    assert data.image(0).shape[:2] == (40, 60)
    assert data.image(6).shape[:2] == (20, 30)


def test_a_table_that_a_spreadsheet_of_windows_has_saved(folder: Path) -> None:
    text = (folder / "gate.tsv").read_text()
    (folder / "gate.tsv").write_text(text, encoding="utf-8-sig")
    assert len(Phototourism().parse(folder, "train").image_paths) == 7


def test_a_reconstruction_at_the_usual_place_is_colmaps(folder: Path, capture: Capture) -> None:
    assert not Colmap.recognizes(folder)
    assert not Llff.recognizes(folder)
    write_colmap(folder / "sparse" / "0", capture)
    assert Colmap.recognizes(folder)
    assert not Phototourism.recognizes(folder)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("filename\tid\tdataset\na.png\t1\tb\n", "line 2 lacks one of the columns"),
        ("filename\tid\tsplit\tdataset\np00.png\n", "line 2 lacks one of the columns"),
        ("filename\tid\tsplit\tdataset\np00.png\t1\tmine\tb\n", "line 2: the split is 'mine'"),
        ("filename\tid\tsplit\tdataset\nx.png\t1\ttrain\tb\n", "lists none of the 10 images .* such as "),
        ("filename\tid\tsplit\tdataset\np00.png\t1\ttest\tb\n", "none of the 1 existing images .* split 'train'"),
        ("", "lists none of the 10 images .* such as "),
        ("\xff\xfe\x00", "is not a tab-separated table"),
    ],
)
def test_bad_tables_are_refused(folder: Path, text: str, words: str) -> None:
    (folder / "gate.tsv").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=words) as error:
        Phototourism().parse(folder, "train")
    assert "gate.tsv" in str(error.value)
    assert "\n" not in str(error.value)


def test_one_table_is_needed(folder: Path) -> None:
    (folder / "other.tsv").touch()
    with pytest.raises(DataError, match=r"there are gate\.tsv, other\.tsv"):
        Phototourism().parse(folder, "train")
    for file in folder.glob("*.tsv"):
        file.unlink()
    assert not Phototourism.recognizes(folder)
    with pytest.raises(DataError, match="there is none"):
        Phototourism().parse(folder, "train")
    with pytest.raises(DataError, match=r"--data"):
        Phototourism().parse(None, "train")
