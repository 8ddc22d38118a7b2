"""Exports of apps as they are downloaded: converted like the folder in them, and refused if they lead out of it."""

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest

from nerfloom.processing import polycam, record3d
from tests.cli.helpers import called
from tests.truth.formats import write_polycam, write_record3d

FLAGS = ("--num-downscales", 0)


def zipped(archive: Path, files: dict[str, Path | bytes]) -> Path:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name, content if isinstance(content, bytes) else content.read_bytes())
    return archive


def polycam_zip(archive: Path, folder: Path, inside: str = "") -> Path:
    """Polycam's zip of an export, in a folder or not; with files that are not needed."""
    write_polycam(folder)
    files: dict[str, Path | bytes] = {
        f"{inside}{path.relative_to(folder).as_posix()}": path for path in sorted(folder.rglob("*")) if path.is_file()
    }
    return zipped(archive, {**files, f"{inside}mesh_info.json": b"{}", "__MACOSX/keyframes/images/._000.png": b"x"})


def recording(archive: Path, folder: Path) -> Path:
    """RECORDING.r3d: rgbd/N.png beside depth and confidence, and metadata without ending."""
    export = write_record3d(folder) / "EXR_RGBD"
    files: dict[str, Path | bytes] = {f"rgbd/{path.name}": path for path in sorted((export / "rgb").iterdir())}
    files |= {f"rgbd/{Path(name).stem}.depth": b"bvx2" for name in files if "rgbd" in name}
    return zipped(archive, {"metadata": export / "metadata.json", "icon": b"png", "sound.m4a": b"m4a", **files})


def process(kind: str, data: Path, output: Path) -> dict[str, Any]:
    done = called("ns-process-data", kind, "--data", data, "--output-dir", output, *FLAGS)
    assert done.returncode == 0, done.stderr
    return json.loads((output / "transforms.json").read_text())


@pytest.mark.parametrize("inside", ["", "8_11_2026/"])
def test_a_zip_of_polycam_is_as_its_folder(inside: str, tmp_path: Path) -> None:
    archive = polycam_zip(tmp_path / "poly.zip", tmp_path / "export", inside)
    expected = process("polycam", tmp_path / "export", tmp_path / "of folder")
    assert process("polycam", archive, tmp_path / "of zip") == expected
    assert not (tmp_path / "of zip" / "unpacked").exists()


def test_a_recording_of_record3d_is_as_its_export(tmp_path: Path) -> None:
    archive = recording(tmp_path / "walk.r3d", tmp_path / "export")
    expected = process("record3d", tmp_path / "export", tmp_path / "of folder")
    assert process("record3d", archive, tmp_path / "of zip") == expected
    assert sorted(path.name for path in (tmp_path / "of zip").iterdir()) == ["images", "transforms.json"]


@pytest.mark.parametrize("kind", ["polycam", "record3d"])
@pytest.mark.parametrize("content", ["outside", "nothing", "no zip", "a folder's bomb"])
def test_bad_archives_are_refused_and_nothing_is_written(kind: str, content: str, tmp_path: Path) -> None:
    archive, output = tmp_path / "data.zip", tmp_path / "out"
    files: dict[str, Path | bytes] = {"keyframes/images/1.jpg": b"1", "metadata": b"{}"}
    if content == "outside":
        zipped(archive, {**files, "../../outside.txt": b"out"})
    elif content == "nothing":
        zipped(archive, {"readme.txt": b"nothing of it"})
    elif content == "no zip":
        archive.write_bytes(b"PK, but no zip")
    else:
        zipped(archive, {**files, "keyframes/images/2.jpg": bytes(3_000_000), "rgbd/0.jpg": bytes(3_000_000)})
    done = called("ns-process-data", kind, "--data", archive, "--output-dir", output)
    assert done.returncode != 0
    said = " ".join(done.stderr.split())
    assert "data.zip" in said
    assert "Traceback" not in said
    assert not (tmp_path / "outside.txt").exists()
    assert not [path for path in output.rglob("*") if path.is_file()]


def test_a_damaged_recording_leaves_nothing_unpacked(tmp_path: Path) -> None:
    archive = recording(tmp_path / "walk.r3d", tmp_path / "export")
    content = bytearray(archive.read_bytes())
    start = content.index(b"rgbd/0.png") + 40  # within the first image
    content[start : start + 20] = bytes(20)
    archive.write_bytes(content)
    done = called("ns-process-data", "record3d", "--data", archive, "--output-dir", tmp_path / "out", *FLAGS)
    assert done.returncode != 0
    assert "walk.r3d" in " ".join(done.stderr.split())
    assert not (tmp_path / "out" / "unpacked").exists()
    shutil.rmtree(tmp_path / "out")


def test_what_is_taken_from_archives() -> None:
    assert polycam.place(("room", "keyframes", "images", "1.jpg")) == ("keyframes", "images", "1.jpg")
    assert polycam.place(("keyframes", "depth", "1.png")) is None
    assert polycam.place(("keyframes", "images", "deep", "1.jpg")) is None
    assert record3d.place(("metadata",)) == ("metadata.json",)
    assert record3d.place(("rgbd", "12.jpg")) == ("rgb", "12.jpg")
    assert record3d.place(("rgbd", "12.depth")) is None
