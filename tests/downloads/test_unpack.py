"""Archives that want out of their folder, or more than a disk should hold, are refused before anything is written."""

import stat
import struct
import zipfile
from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.downloads import unpack as unpacking
from nerfloom.downloads.unpack import names_of, unpack


def write_zip(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def refused(archive: Path, folder: Path) -> str:
    """The message that refuses an archive; nothing was written."""
    before = sorted(folder.parent.rglob("*"))
    with pytest.raises(DataError) as error:
        unpack(archive, folder, lambda parts: parts)
    assert sorted(folder.parent.rglob("*")) == before
    return str(error.value)


def test_files_arrive_as_they_were(tmp_path: Path) -> None:
    files = {"a/b/c.txt": b"c" * 1000, "a/d.png": bytes(range(256)), "empty": b""}
    archive = write_zip(tmp_path / "x.zip", files)
    assert unpack(archive, tmp_path / "out", lambda parts: parts) == 3
    found = {p.relative_to(tmp_path / "out").as_posix(): p for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert {name: path.read_bytes() for name, path in found.items()} == files
    assert sorted(names_of(archive)) == [("a", "b", "c.txt"), ("a", "d.png"), ("empty",)]


def test_only_what_is_placed_is_written(tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", {"data/lego/1.png": b"1", "data/ship/2.png": b"2"})
    unpack(archive, tmp_path / "out", lambda parts: parts[1:] if parts[1] == "lego" else None)
    assert [p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*.png")] == ["lego/1.png"]


OUTSIDE = ("../out.txt", "a/../../out.txt", "/etc/out.txt", "a//b", "./a", "C:/out.txt", "a\\..\\b")
ODD = ("a/b:stream", "a/\x1b[2J", "a./b", "a /b", "x" * 300)


@pytest.mark.parametrize("name", [*OUTSIDE, *ODD])
def test_paths_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    archive = write_zip(tmp_path / "x.zip", {"good.txt": b"1", name: b"out"})
    assert "is unsafe; nothing was unpacked" in refused(archive, tmp_path / "deep" / "out")


def test_a_name_with_a_zero_byte_is_refused(tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", {"good.txtX../../out": b"1"})
    archive.write_bytes(archive.read_bytes().replace(b"txtX", b"txt\0"))
    assert "is unsafe" in refused(archive, tmp_path / "out")


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFBLK])
def test_links_and_devices_are_refused(kind: int, tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("link")
    entry.external_attr = (kind | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    assert "'link' is a link or a device" in refused(tmp_path / "x.zip", tmp_path / "out")


def test_a_bomb_is_refused(tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", {f"{n}.txt": bytes(10_000_000) for n in range(5)})
    assert archive.stat().st_size < 300_000
    assert "50000000" in refused(archive, tmp_path / "out")


def test_a_bomb_that_lies_about_its_size_writes_no_more_than_it_said(tmp_path: Path) -> None:
    """The directory states 10 bytes; the stream has ten million."""
    archive = write_zip(tmp_path / "x.zip", {"a.txt": bytes(10_000_000)})
    content = archive.read_bytes()
    lying = content.replace(struct.pack("<I", 10_000_000), struct.pack("<I", 10))
    assert lying != content
    archive.write_bytes(lying)
    with pytest.raises(DataError, match=r"'a\.txt' is damaged: .*; download it again"):
        unpack(archive, tmp_path / "out", lambda parts: parts)
    assert sum(path.stat().st_size for path in (tmp_path / "out").rglob("*")) <= 10


def test_overlapping_entries_are_refused(tmp_path: Path) -> None:
    """Many entries that share their data, as in the zip bombs of Fifield (2019)."""
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("a0", bytes(100_000))
        first = archive.filelist[0]
        for number in range(1, 50):
            entry = zipfile.ZipInfo(f"a{number}")
            for field in ("header_offset", "compress_size", "file_size", "CRC"):
                setattr(entry, field, getattr(first, field))
            archive.filelist.append(entry)
            archive.NameToInfo[entry.filename] = entry
    assert "overlap" in refused(tmp_path / "x.zip", tmp_path / "out")


def test_too_many_entries_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpacking, "MAX_FILES", 10)
    archive = write_zip(tmp_path / "x.zip", {f"{n}": b"" for n in range(11)})
    assert "has 11 entries; the limit is 10" in refused(archive, tmp_path / "out")


@pytest.mark.parametrize("names", [("a/b", "A/B"), ("a/b", "a"), ("a", "a/b/c/d")])
def test_two_entries_for_one_path_are_refused(names: tuple[str, str], tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", dict.fromkeys(names, b"1"))
    assert "several entries for the same path" in refused(archive, tmp_path / "out")


def test_an_encrypted_entry_is_refused(tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", {"a": b"1"}, zipfile.ZIP_STORED)
    content = bytearray(archive.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + offset] |= 1
    archive.write_bytes(content)
    assert "is encrypted" in refused(archive, tmp_path / "out")


def test_damaged_archives_are_one_line(tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "x.zip", {"a.txt": b"content " * 100}, zipfile.ZIP_STORED)
    whole = archive.read_bytes()
    archive.write_bytes(whole[: len(whole) // 2])
    assert "damaged or not a zip file" in refused(archive, tmp_path / "out")
    archive.write_bytes(whole.replace(b"content", b"CONTENT", 1))
    with pytest.raises(DataError, match=r"'a\.txt' is damaged: Bad CRC-32"):
        unpack(archive, tmp_path / "out", lambda parts: parts)


def test_a_disk_that_is_too_small_is_noticed_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = type("Usage", (), {"free": 100})()
    monkeypatch.setattr(unpacking.shutil, "disk_usage", lambda folder: small)
    archive = write_zip(tmp_path / "x.zip", {"a": bytes(200)})
    with pytest.raises(DataError, match="the disk is too small"):
        unpack(archive, tmp_path / "out", lambda parts: parts)
    assert list((tmp_path / "out").iterdir()) == []
