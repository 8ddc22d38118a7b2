"""Names in a data set and on the disk: accepted replacements, messages, and refused files."""

import unicodedata
from pathlib import Path

import pytest

from nerfloom.data.names_on_disk import are_files, distinct_names, files_below, match_names, nearest_on_disk, on_disk


def make(folder: Path, *files: str) -> Path:
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"1")
    return folder


COMPOSED, TAKEN_APART = (unicodedata.normalize(form, "photos/caf\u00e9 3.jpg") for form in ("NFC", "NFD"))


@pytest.mark.parametrize(
    ("name", "file", "words"),
    [
        ("photos\\a 1.jpg", "photos/a 1.jpg", "separators"),
        (".\\photos\\..\\photos\\a.jpg", "photos/a.jpg", "separators"),
        ("photos/a%201.jpg", "photos/a 1.jpg", "encoding"),
        ("photos/a 1.jpg", "photos/a%201.jpg", "encoding"),
        (COMPOSED, TAKEN_APART, "encoding"),
        (TAKEN_APART, COMPOSED, "encoding"),
        ("photos/a.jpg", "photos/A.JPG", "case"),
        ("Photos/a.jpg", "photos/a.jpg", "case"),
        ("photos/a.heic", "photos/a.jpg", "ending"),
        ("PHOTOS\\a.TIF", "photos/A.png", "ending"),
        ("/home/me/scan/photos/a.jpg", "photos/a.jpg", "folder"),
        ("C:\\scan\\photos\\a.jpg", "photos/a.jpg", "folder"),
        ("../photos/a.jpg", "photos/a.jpg", "folder"),
        ("a.jpg", "photos/a.jpg", "folder"),
        ("images/a.jpg", "photos/a.jpg", "folder"),
        ("D:\\scan\\A.JPG", "photos/left/a.jpg", "folder"),
    ],
)
def test_what_is_written_otherwise_is_found_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, file: str, words: str
) -> None:
    make(tmp_path, file, "masks/a.png", "depth/a.png")
    assert on_disk(tmp_path, [name]) == (tmp_path / file,)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "1 of 1" in said
    assert words in said
    on_disk(tmp_path, [name], quiet=True)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("name", ["photos/a.jpg", "./photos/a.jpg", "photos/b", "images/c.jpg", "images/c"])
def test_what_is_there_is_taken_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """A name may lack its ending, and images may be reduced beforehand."""
    make(tmp_path, "photos/a.jpg", "photos/b.JPG", "images_4/c.jpg")
    (path,) = on_disk(tmp_path, [name])
    expected = "images/c.jpg" if "c" in name else {"a": "photos/a.jpg", "b": "photos/b.JPG"}[Path(name).stem]
    assert path == tmp_path / expected
    assert ("ending" in capsys.readouterr().err) == (name == "images/c")


def test_names_have_the_folders_that_distinguish_files() -> None:
    scene = Path("/data/scene")
    assert distinct_names([scene / "1.jpg", scene / "2.jpg", scene / "1.jpg"]) == ("1.jpg", "2.jpg", "1.jpg")
    rig = [scene / side / day / name for side in "lr" for day in ("mon", "tue") for name in ("1.jpg", "2.jpg")]
    assert distinct_names(rig) == tuple(path.relative_to(scene).as_posix() for path in rig)
    assert distinct_names(rig[:4]) == ("mon/1.jpg", "mon/2.jpg", "tue/1.jpg", "tue/2.jpg")
    assert distinct_names([]) == ()


def test_files_in_a_linked_folder_are_found(tmp_path: Path) -> None:
    make(tmp_path / "disk", "a.JPG")
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "photos").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "circle").symlink_to(tmp_path / "scan")
    assert on_disk(tmp_path / "scan", ["photos/a.jpg"]) == (tmp_path / "scan" / "photos" / "a.JPG",)
    assert on_disk(tmp_path / "scan", ["images/a.jpg"]) == (tmp_path / "scan" / "photos" / "a.JPG",)


def test_absolute_names_that_exist_are_kept(tmp_path: Path) -> None:
    file = make(tmp_path / "elsewhere", "a.jpg") / "a.jpg"
    assert on_disk(tmp_path / "scan", [str(file)]) == (file,)


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["a.jpg"], ["A.jpg", "a.JPG"]),  # both differ in case
        (["a.jpg"], ["left/a.jpg", "right/a.jpg"]),
        (["left/a.jpg", "right/a.jpg"], ["photos/a.jpg"]),  # one file for two poses
        (["a.heic"], ["a.jpg", "a.png"]),
        (["a.jpg"], ["masks/a.jpg"]),
        (["a.jpg"], ["b.jpg"]),
    ],
)
def test_nothing_is_taken_where_two_come_into_question(tmp_path: Path, names: list[str], files: list[str]) -> None:
    make(tmp_path, *files)
    assert match_names(tmp_path, names).files == {}
    assert on_disk(tmp_path, names) == tuple(tmp_path / name for name in names)


def test_a_missing_image_is_not_replaced_by_one_of_another_folder(tmp_path: Path) -> None:
    """For left/2.jpg only the right eye's image exists, which has another pose."""
    make(tmp_path, "left/1.jpg", "right/1.jpg", "right/2.jpg")
    found = match_names(tmp_path, ["left/1.jpg", "left/2.jpg"]).files
    assert found == {"left/1.jpg": "left/1.jpg"}


def test_a_file_that_another_name_means_is_not_taken_twice(tmp_path: Path) -> None:
    make(tmp_path, "a.png")
    assert match_names(tmp_path, ["a.png", "a.jpg", "A.png"]).files == {"a.png": "a.png"}


def test_what_accompanies_images_needs_its_own_folder(tmp_path: Path) -> None:
    make(tmp_path, "images/1.png", "images/2.png", "scan/depth/2.png")
    assert match_names(tmp_path, ["depth/1.png"], shared=2).files == {}
    assert match_names(tmp_path, ["C:\\depth\\2.png"], shared=2).files == {"C:\\depth\\2.png": "scan/depth/2.png"}


def test_most_names_decide_where_images_have_moved(tmp_path: Path) -> None:
    make(tmp_path, *[f"images/cam{c}/{i}.jpg" for c in (1, 2) for i in range(3)], "images_2/cam1/0.jpg")
    names = [f"/data/x/cam{c}/{i}.jpg" for c in (1, 2) for i in range(3)] + ["/data/x/cam1/9.jpg"]
    found = match_names(tmp_path, names)
    assert found.files == {name: name.replace("/data/x", "images") for name in names[:-1]}
    assert "6 of 7" in found.notes[0]


def test_hidden_files_and_other_kinds_are_not_looked_at(tmp_path: Path) -> None:
    make(tmp_path, ".trash/a.jpg", "photos/.a.jpg", "photos/a.txt", "photos_2/b.jpg")
    assert files_below(tmp_path) == ["photos/b.jpg", "photos_2/b.jpg"]
    assert files_below(tmp_path / "nowhere") == []


def test_the_nearest_thing_is_named(tmp_path: Path) -> None:
    make(tmp_path, "photos/shot_001.jpg", "photos/shot_002.jpg", "sparse/0/images.bin")
    assert nearest_on_disk(tmp_path / "photos" / "shot001.jpg").startswith(
        f"{tmp_path / 'photos'} has no shot001.jpg, but shot_001.jpg"
    )
    assert nearest_on_disk(tmp_path / "photo" / "1.jpg") == f"{tmp_path} has no photo, but photos"
    assert nearest_on_disk(tmp_path / "xyz" / "1.jpg") == f"{tmp_path} has no xyz, but photos, sparse"
    (tmp_path / "empty").mkdir()
    assert nearest_on_disk(tmp_path / "empty" / "1.jpg") == f"{tmp_path / 'empty'} is empty"
    for link, missing in (("photos/3.jpg", "photos/3.jpg"), ("disk", "disk/1.jpg")):
        (tmp_path / link).symlink_to("/moved/away")
        expected = f"{tmp_path / link} is a link to /moved/away, which does not exist"
        assert nearest_on_disk(tmp_path / missing) == expected


def test_files_of_many_names_are_told_with_one_look_at_each_folder(tmp_path: Path) -> None:
    make(tmp_path, "a/1.jpg", "b/2.jpg")
    (tmp_path / "a" / "linked.jpg").symlink_to(tmp_path / "b" / "2.jpg")
    (tmp_path / "a" / "broken.jpg").symlink_to(tmp_path / "gone.jpg")
    names = ["a/1.jpg", "a/2.jpg", "a/linked.jpg", "a/broken.jpg", "b", "none/1.jpg"]
    paths = [tmp_path / name for name in names]
    assert are_files(paths) == [path.is_file() for path in paths] == [True, False, True, False, False, False]
