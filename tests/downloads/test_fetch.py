"""Fetching from a server with faults: the result is the whole file, as the source states it, or nothing."""

import base64
import errno
import hashlib
import random
import shutil
import socket
from pathlib import Path
from typing import Any

import pytest

from nerfloom.base.errors import DataError
from nerfloom.downloads import fetch as fetching
from nerfloom.downloads.catalogue import Source
from nerfloom.downloads.fetch import SourceError, fetch
from tests.downloads.server import Served, serving

CONTENT = random.Random(0).randbytes(3_000_000)
SUM = hashlib.sha256(CONTENT).hexdigest()


def source_of(address: str, sha256: str | None = SUM) -> Source:
    return Source(f"{address}/file.zip", sha256)


def test_a_file_comes_whole_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    served = Served(CONTENT)
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT
    assert [path.name for path in tmp_path.iterdir()] == ["file.zip"]
    assert served.asked == [""]


def test_a_broken_connection_goes_on_where_it_broke(tmp_path: Path) -> None:
    served = Served(CONTENT, breaks_after=[1_000_000, 500_000])
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT
    assert served.asked == ["", "bytes=1000000-", "bytes=1500000-"]


def test_a_second_call_goes_on_where_the_first_gave_up(tmp_path: Path) -> None:
    served = Served(CONTENT, breaks_after=[1_000_000, 0, 0, 0])
    with serving({"/file.zip": served}) as address:
        with pytest.raises(SourceError, match="broke after 1000000 of 3000000 bytes; repeat the command"):
            fetch(source_of(address), tmp_path / "file.zip")
        assert not (tmp_path / "file.zip").exists()
        served.asked.clear()
        fetch(source_of(address), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT
    assert served.asked == ["bytes=1000000-"]


def test_a_file_that_has_changed_since_is_fetched_anew(tmp_path: Path) -> None:
    other = random.Random(1).randbytes(len(CONTENT))
    served = Served(other, breaks_after=[1_000_000, 0, 0, 0])
    with serving({"/file.zip": served}) as address:
        with pytest.raises(SourceError):
            fetch(source_of(address, None), tmp_path / "file.zip")
        served.content = CONTENT  # If-Range has the old tag, so the server sends all
        fetch(source_of(address, None), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_without_a_tag_and_a_sum_nothing_is_mixed(tmp_path: Path) -> None:
    served = Served(CONTENT, etag="", breaks_after=[1_000_000])
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address, None), tmp_path / "file.zip")
    assert served.asked == ["", ""]
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_a_part_from_another_source_is_not_continued(tmp_path: Path) -> None:
    first, second = Served(b"\0" * len(CONTENT), breaks_after=[1_000_000, 0, 0, 0]), Served(CONTENT)
    with serving({"/file.zip": first, "/mirror.zip": second}) as address:
        with pytest.raises(SourceError):
            fetch(source_of(address), tmp_path / "file.zip")
        fetch(Source(f"{address}/mirror.zip", SUM), tmp_path / "file.zip")
    assert second.asked == [""]
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_servers_without_ranges_send_all_again(tmp_path: Path) -> None:
    served = Served(CONTENT, breaks_after=[1_000_000], ranges=False)
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_a_part_that_is_complete_is_only_checked(tmp_path: Path) -> None:
    served = Served(CONTENT)
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
        (tmp_path / "file.zip").rename(tmp_path / "file.zip.part")
        (tmp_path / "file.zip.part.json").write_text(
            f'{{"url": "{address}/file.zip", "validator": "", "md5": ""}}'
        )  # as after a kill between the last byte and the check
        fetch(source_of(address), tmp_path / "file.zip")
    assert served.asked == ["", "bytes=3000000-"]
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


@pytest.mark.parametrize("stated", ["sha256 of the table", "md5 of the server"])
def test_a_wrong_checksum_removes_the_file(stated: str, tmp_path: Path) -> None:
    wrong = base64.b64encode(hashlib.md5(b"").digest()).decode()
    headers = {"x-goog-hash": f"crc32c=AAAAAA==,md5={wrong}"} if stated.startswith("md5") else {}
    source = None if headers else "0" * 64
    refusal = pytest.raises(SourceError, match=r"(sha256|md5) [0-9a-f]+, not [0-9a-f]+")
    with serving({"/file.zip": Served(CONTENT, headers=headers)}) as address, refusal:
        fetch(source_of(address, source), tmp_path / "file.zip")
    assert not list(tmp_path.glob("*.zip*.part")) + list(tmp_path.glob("*.zip"))


def test_the_md5_that_googles_storage_states_is_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    right = base64.b64encode(hashlib.md5(CONTENT).digest()).decode()
    with serving({"/file.zip": Served(CONTENT, headers={"x-goog-hash": f"md5={right}"})}) as address:
        fetch(source_of(address, None), tmp_path / "file.zip")
    assert "no checksum" not in capsys.readouterr().err
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_where_no_sum_is_stated_it_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving({"/file.zip": Served(CONTENT)}) as address:
        fetch(source_of(address, None), tmp_path / "file.zip")
    assert "states no checksum" in capsys.readouterr().err


def test_what_is_not_there_is_said_at_once(tmp_path: Path) -> None:
    with serving({}) as address, pytest.raises(SourceError, match="the server answers 404 Not Found"):
        fetch(source_of(address), tmp_path / "file.zip")
    assert list(tmp_path.iterdir()) == []


def test_busy_servers_are_asked_again(tmp_path: Path) -> None:
    served = Served(CONTENT, status=[503, 429])
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
    assert len(served.asked) == 3
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_a_web_page_is_not_taken_for_the_file(tmp_path: Path) -> None:
    page = Served(b"<html>Quota exceeded</html>", headers={"Content-Type": "text/html; charset=utf-8"})
    with (
        serving({"/file.zip": page}) as address,
        pytest.raises(SourceError, match="sent a web page instead of the file"),
    ):
        fetch(source_of(address, None), tmp_path / "file.zip")
    assert list(tmp_path.iterdir()) == []


def test_nobody_listens(tmp_path: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    with pytest.raises(SourceError, match="the server cannot be reached"):
        fetch(source_of(f"http://127.0.0.1:{port}"), tmp_path / "file.zip")


def test_a_disk_that_is_too_small_is_noticed_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = type("Usage", (), {"free": 1_000_000})()
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: small)
    with serving({"/file.zip": Served(CONTENT)}) as address, pytest.raises(DataError, match="the disk is too small"):
        fetch(source_of(address), tmp_path / "file.zip")


def test_a_disk_that_fills_up_keeps_what_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(opened: Any, chunk: bytes) -> None:
        if opened.tell() > 1_500_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        opened.write(chunk)
        opened.flush()

    with serving({"/file.zip": Served(CONTENT)}) as address:
        real, opens = Path.open, {}

        def open_small(path: Path, *arguments: Any, **more: Any) -> Any:
            opened = real(path, *arguments, **more)
            opens[path.name] = opened
            return _Full(opened, full) if path.name == "file.zip.part" and "b" in str(arguments) else opened

        with monkeypatch.context() as patched:
            patched.setattr(Path, "open", open_small)
            with pytest.raises(DataError, match="the disk is full; free some space and repeat the command"):
                fetch(source_of(address), tmp_path / "file.zip")
        assert 0 < (tmp_path / "file.zip.part").stat().st_size < len(CONTENT)
        fetch(source_of(address), tmp_path / "file.zip")
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


class _Full:
    """An open file on a disk that fills up."""

    def __init__(self, opened: Any, write: Any) -> None:
        self._opened, self._write = opened, write

    def __enter__(self) -> "_Full":
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._opened, name)

    def write(self, chunk: bytes) -> None:
        self._write(self._opened, chunk)


def test_a_damaged_note_only_costs_what_came(tmp_path: Path) -> None:
    (tmp_path / "file.zip.part").write_bytes(CONTENT[:1000])
    (tmp_path / "file.zip.part.json").write_text("[" * 100_000)
    served = Served(CONTENT)
    with serving({"/file.zip": served}) as address:
        fetch(source_of(address), tmp_path / "file.zip")
    assert served.asked == [""]
    assert (tmp_path / "file.zip").read_bytes() == CONTENT


def test_attempts_are_as_many_as_pauses(tmp_path: Path) -> None:
    served = Served(CONTENT, breaks_after=[0] * 10)
    with serving({"/file.zip": served}) as address, pytest.raises(SourceError, match="broke after 0 of"):
        fetch(source_of(address), tmp_path / "file.zip")
    assert len(served.asked) == len(fetching.PAUSES) + 1
