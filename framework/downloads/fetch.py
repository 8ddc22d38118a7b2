"""Fetching of a file over HTTP: resumed after a break, checked against the source's sum, whole or not at all."""

from __future__ import annotations

import base64
import binascii
import errno
import hashlib
import http.client
import json
import os
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from email.message import Message
from pathlib import Path
from typing import BinaryIO

import nerfloom
from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say, track_bytes
from nerfloom.base.errors import DataError
from nerfloom.downloads.catalogue import Source

TIMEOUT = 30.0
"""Seconds without a byte after which a connection counts as broken."""
PAUSES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Seconds to wait before each further attempt. They start over whenever an attempt brought something."""
CHUNK = 1 << 20
"""Number of bytes that are read at a time."""
BUSY = (408, 425, 429, 500, 502, 503, 504)
"""HTTP statuses of servers that may answer later."""


class SourceError(DataError):
    """A source does not have the file, or not the right one; another source may."""


class _Broken(Exception):
    """The connection broke; another attempt may go on where it did."""


@dataclass(frozen=True)
class _Answered:
    """Facts that an earlier answer gave of the file, kept beside the part that is there.

    Args:
        url: address that was asked.
        validator: ETag or date of the file, by which the server knows whether it is still the same; empty if none.
        md5: the file's MD5 in hexadecimal, which Google's storage states; empty if none.
    """

    url: str
    validator: str = ""
    md5: str = ""


def fetch(source: Source, file: Path) -> None:
    """Download `file`. What is there of it from an earlier call is kept where the server still has the same file.

    Args:
        source: place to download from.
        file: file to write. Until it is complete and checked, it has the suffix .part.

    Raises:
        SourceError: if the server has no such file, sends a web page, does not answer, or the file is not as the
            source says. A wrong file is removed; of an incomplete one, what came is kept.
        DataError: if there is no room on the disk.
    """
    part, note = (file.with_name(file.name + suffix) for suffix in (".part", ".part.json"))
    attempts = 0
    while True:
        before = part.stat().st_size if part.exists() else 0
        try:
            answered = _transfer(source, part, note)
            break
        except _Broken as broken:
            came = part.exists() and part.stat().st_size > before
            attempts = 0 if came else attempts + 1
            if attempts > len(PAUSES):
                raise SourceError(f"{source.url}: {broken}; the same command goes on with what came") from broken
            time.sleep(PAUSES[max(attempts - 1, 0)])
    _check(source, answered, part)
    os.replace(part, file)
    note.unlink(missing_ok=True)


def digest(file: Path, algorithm: str) -> str:
    """Return the sum of a file's content in hexadecimal.

    Args:
        file: file to read.
        algorithm: "sha256" or "md5".
    """
    summed = hashlib.new(algorithm, usedforsecurity=False)
    with file.open("rb") as opened, track_bytes(f"checking {file.name}", file.stat().st_size) as advance:
        while chunk := opened.read(CHUNK):
            summed.update(chunk)
            advance(len(chunk))
    return summed.hexdigest()


def _transfer(source: Source, part: Path, note: Path) -> _Answered:
    """Receive what is missing of a file, and return what the server said of it."""
    known = _read_note(note)
    have = part.stat().st_size if part.exists() else 0
    # A part from another address is of another file, and a mixture of two versions must be noticed.
    if known.url != source.url or not (known.validator or source.sha256):
        have = 0
    headers = {"User-Agent": f"nerfloom/{nerfloom.__version__}", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if known.validator:
            headers["If-Range"] = known.validator
    with _network_errors():
        try:
            answer = urllib.request.urlopen(urllib.request.Request(source.url, headers=headers), timeout=TIMEOUT)
        except urllib.error.HTTPError as error:
            if error.code == 416 and have:
                return _at_the_end(error.headers, known, part, have)
            if error.code in BUSY:
                raise _Broken(f"the server answers {error.code} {error.reason}") from error
            raise SourceError(f"{source.url}: the server answers {error.code} {error.reason}") from error
    with answer:
        _refuse_page(source, answer.headers)
        start, total = _extent(answer.status, answer.headers, have)
        answered = _Answered(source.url, _validator(answer.headers), _stated_md5(answer.headers))
        _check_room(part, start, total)
        write_atomically(note, lambda file: file.write(json.dumps(asdict(answered)).encode()))
        with part.open("r+b" if part.exists() else "wb") as opened:
            opened.truncate(start)
            opened.seek(start)
            _receive(answer, opened, start, total)
    return answered


def _receive(answer: http.client.HTTPResponse, opened: BinaryIO, start: int, total: int | None) -> None:
    """Append an answer's body to an open file of `start` bytes, which has `total` in the end."""
    size = start
    with track_bytes("downloading", total, start) as advance:
        while True:
            with _network_errors():
                chunk = answer.read(CHUNK)
            if not chunk:
                break
            size += len(chunk)
            if total is not None and size > total:
                raise _Broken(f"more than the {total} bytes that were announced came")
            _write(opened, chunk)
            advance(len(chunk))
    opened.flush()
    os.fsync(opened.fileno())
    if total is not None and size < total:
        raise _Broken(f"the connection broke after {size} of {total} bytes")


def _write(opened: BinaryIO, chunk: bytes) -> None:
    try:
        opened.write(chunk)
        opened.flush()
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DataError(f"{opened.name}: the disk is full; make room, and the same command goes on") from error
        raise DataError(f"cannot write {opened.name}: {error.strerror}") from error


@contextmanager
def _network_errors() -> Iterator[None]:
    """Turn the errors of a connection into `_Broken`; an HTTP status is no such error."""
    try:
        yield
    except urllib.error.HTTPError:
        raise
    except urllib.error.URLError as error:
        raise _Broken(f"the server cannot be reached: {error.reason}") from error
    except http.client.HTTPException as error:
        raise _Broken(f"the connection broke: {type(error).__name__}") from error
    except OSError as error:
        raise _Broken(f"the connection broke: {error.strerror or error}") from error


def _extent(status: int, headers: Message, have: int) -> tuple[int, int | None]:
    """Return the byte at which an answer's body starts, and the size of the whole file, None if it is not said."""
    if status == 206:
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", headers.get("Content-Range", ""))
        if match is not None and int(match[1]) == have:
            return have, None if match[2] == "*" else int(match[2])
        raise _Broken("the server sent another part of the file than was asked for")
    length = headers.get("Content-Length", "")
    return 0, int(length) if re.fullmatch(r"\d{1,18}", length) else None


def _at_the_end(headers: Message, known: _Answered, part: Path, have: int) -> _Answered:
    """Return what is known of a file all of whose bytes are there; drop them if the file has another size now."""
    if headers.get("Content-Range", "") == f"bytes */{have}":
        return known
    part.unlink()
    raise _Broken("the file has changed on the server")


def _validator(headers: Message) -> str:
    tag = headers.get("ETag", "")
    return tag if tag and not tag.startswith("W/") else headers.get("Last-Modified", "")


def _stated_md5(headers: Message) -> str:
    """Return the MD5 that Google's storage states in base64, in hexadecimal; empty if there is none."""
    for entry in ",".join(headers.get_all("x-goog-hash", [])).split(","):
        name, _, value = entry.strip().partition("=")
        if name == "md5":
            try:
                return base64.b64decode(value, validate=True).hex()
            except binascii.Error:
                continue
    return ""


def _refuse_page(source: Source, headers: Message) -> None:
    if headers.get_content_type() in ("text/html", "application/xhtml+xml"):
        raise SourceError(f"{source.url}: the server sends a web page, not the file; it may ask for a login or a quota")


def _check_room(part: Path, start: int, total: int | None) -> None:
    free = shutil.disk_usage(part.parent).free
    if total is not None and total - start > free:
        needed = f"{(total - start) / 1e9:.1f} GB are to come, and {free / 1e9:.1f} GB are free"
        raise DataError(f"{part.parent}: the disk is too small: {needed}; make room, or name another --save-dir")


def _check(source: Source, answered: _Answered, part: Path) -> None:
    """Compare a complete file with the sum that its source states, if it states one, and remove it if it differs."""
    expected = [("sha256", source.sha256)] if source.sha256 else [("md5", answered.md5)] if answered.md5 else []
    for algorithm, value in expected:
        found = digest(part, algorithm)
        if found != value:
            part.unlink()
            raise SourceError(f"{source.url}: the file has the {algorithm} {found}, not {value}; it was removed")
    if not expected:
        say(f"note: {source.url} states no checksum; the file was not compared with any")


def _read_note(note: Path) -> _Answered:
    """Return what an earlier answer said; nothing if there was none."""
    try:
        content = json.loads(note.read_text(encoding="utf-8"))
        return _Answered(*(str(content[field]) for field in ("url", "validator", "md5")))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return _Answered("")
