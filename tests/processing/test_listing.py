"""The files of a folder, and reports on left-out files."""

from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.processing.listing import find_images, kind_of
from nerfloom.processing.sequence import is_sequence


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


def test_other_files_are_counted_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    touch(tmp_path, "a.AVIF", "b.heic", "c.jpg", "raw/d.dng", "raw/e.dng", "clip.mov", ".hidden.dng")
    assert [path.as_posix() for path in find_images(tmp_path)] == ["a.AVIF", "b.heic", "c.jpg"]
    said = capsys.readouterr().err.replace("\n", " ")
    assert "left out: 3 files that are not images: 2 .dng, 1 .mov; the first: clip.mov" in said
    with pytest.raises(DataError, match=r"has no images .*: 2 \.dng; the first: d\.dng"):
        find_images(tmp_path / "raw")


def test_masks_beside_photographs_are_no_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    touch(tmp_path, "images/1.jpg", "images/2.jpg", "Masks/1.png", "Masks/2.png", "depth/left/1.png")
    assert [path.as_posix() for path in find_images(tmp_path)] == ["images/1.jpg", "images/2.jpg"]
    assert "left out: 3 images in folders such as " in capsys.readouterr().err
    assert [path.as_posix() for path in find_images(tmp_path / "depth")] == ["left/1.png"]
    touch(tmp_path / "labels of a museum", "mask/1.jpg")
    assert [path.as_posix() for path in find_images(tmp_path / "labels of a museum")] == ["mask/1.jpg"]


def test_linked_photographs_are_found_once(tmp_path: Path) -> None:
    touch(tmp_path / "disk" / "deep", "1.jpg", "2.jpg")
    folder = touch(tmp_path / "given", "0.jpg")
    (folder / "camera").symlink_to(tmp_path / "disk")
    (folder / "camera, again").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "circle").symlink_to(folder)
    (folder / "9.jpg").symlink_to(tmp_path / "gone.jpg")  # listed, so that it is reported when it is read
    assert [path.as_posix() for path in find_images(folder)] == [
        "0.jpg",
        "9.jpg",
        "camera/deep/1.jpg",
        "camera/deep/2.jpg",
    ]


def test_a_video_and_a_folder_are_told_apart(tmp_path: Path) -> None:
    images, films = touch(tmp_path / "i", "1.jpg", "x.mp4"), touch(tmp_path / "v", "clip.MP4", "notes.txt")
    assert kind_of("images", images) == ("images", images)
    assert kind_of("video", images) == ("images", images)
    assert kind_of("images", films) == kind_of("video", films) == ("video", films / "clip.MP4")
    assert kind_of("images", films / "clip.MP4") == ("video", films / "clip.MP4")
    assert kind_of("video", tmp_path / "none") == ("video", tmp_path / "none")
    touch(films, "other.mkv")
    with pytest.raises(DataError, match="has 2 videos and no images; choose one"):
        kind_of("images", films)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["IMG_0001.jpg", "IMG_0002.jpg", "IMG_0005.jpg"], True),
        (["a/1.png", "a/2.png", "a/3.png", "a/4.png", "a/5.png", "b/1.png", "b/2.png"], True),
        (["PXL_20240501_101500123.jpg", "PXL_20240501_101532456.jpg", "PXL_20240501_102001789.jpg"], True),
        (["9971_38.jpg", "12033_15.jpg", "45501_97.jpg"], False),
        (["1359873828_f0.jpg", "14053639689_10.jpg", "14053679420_82.jpg"], False),
        (["door.jpg", "garden.jpg", "window.jpg"], False),
        (["1.jpg"], False),
    ],
)
def test_names_in_sequence(names: list[str], expected: bool) -> None:
    assert is_sequence([Path(name) for name in names]) == expected


def test_what_servers_and_systems_add_is_no_photograph(tmp_path: Path) -> None:
    touch(
        tmp_path, "a/1.jpg", "a/@eaDir/1.jpg/SYNOFILE_THUMB_XL.jpg", "__MACOSX/a/1.jpg", "a/._1.jpg", "#recycle/2.jpg"
    )
    touch(tmp_path, "a/Thumbs.db")
    assert [path.as_posix() for path in find_images(tmp_path)] == ["a/1.jpg"]


def test_only_whole_names_of_folders_say_that_files_are_no_photographs(tmp_path: Path) -> None:
    given = ["normal street/1.jpg", "Maskenball/1.jpg", "depths of the sea/1.jpg", "labelled/1.jpg"]
    touch(tmp_path, *given, "masks_2/1.png", "Depth_Maps/1.png", "normals/1.png", "thumbnails/1.jpg", "mask/a/1.png")
    assert sorted(path.as_posix() for path in find_images(tmp_path)) == sorted(given)
