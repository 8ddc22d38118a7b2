"""Download of a file over HTTP: resumed after a break, compared with the source's sum, complete or not at all."""

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
"""Maximum seconds without a byte; then a connection counts as broken."""
PAUSES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Seconds to wait before each further attempt; the sequence starts over after an attempt that received data."""
CHUNK = 1 << 20
"""Number of bytes read at a time."""
BUSY = (408, 425, 429, 500, 502, 503, 504)
"""HTTP statuses of servers that may respond later."""


class SourceError(DataError):
    """A source lacks the file or has a wrong one; another source may have it."""


class _Broken(Exception):
    """The connection broke; another attempt may continue from there."""


@dataclass(frozen=True)
class _Answered:
    """Properties of the file from an earlier response, stored beside the partial file.

    Args:
        url: requested address.
        validator: ETag or date of the file, that lets the server check that it is unchanged; empty if none.
        md5: the file's MD5 in hexadecimal, as stated by Google's storage; empty if none.
    """

    url: str
    validator: str = ""
    md5: str = ""


def fetch(source: Source, file: Path) -> None:
    """Download `file`, continuing an earlier partial download if the server still has the same file.

    Args:
        source: place to download from.
        file: file to write. Until it is complete and checked, it has the suffix .part.

    Raises:
        SourceError: if the server lacks the file, sends a web page or does not respond, or if the file differs from the
            source's description. A wrong file is removed; an incomplete one is kept.
        DataError: if the disk is full.
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
                raise SourceError(f"{source.url}: {broken}; repeat the command to continue the download") from broken
            time.sleep(PAUSES[max(attempts - 1, 0)])
    _check(source, answered, part)
    os.replace(part, file)
    note.unlink(missing_ok=True)


def digest(file: Path, algorithm: str) -> str:
    """Return the checksum of a `file` by `algorithm`, "sha256" or "md5", in hexadecimal."""
    summed = hashlib.new(algorithm, usedforsecurity=False)
    with file.open("rb") as opened, track_bytes(f"checking {file.name}", file.stat().st_size) as advance:
        while chunk := opened.read(CHUNK):
            summed.update(chunk)
            advance(len(chunk))
    return summed.hexdigest()


def _transfer(source: Source, part: Path, note: Path) -> _Answered:
    """Receive the missing part of a file, and return the server's statements about it."""
    known = _read_note(note)
    have = part.stat().st_size if part.exists() else 0
    # A part from another address belongs to another file, and a mixture of two versions must be noticed.
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
    """Append a response's body to an open file of `start` bytes; its complete size is `total`."""
    size = start
    with track_bytes("downloading", total, start) as advance:
        while True:
            with _network_errors():
                chunk = answer.read(CHUNK)
            if not chunk:
                break
            size += len(chunk)
            if total is not None and size > total:
                raise _Broken(f"the server sent more than the announced {total} bytes")
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
            raise DataError(f"{opened.name}: the disk is full; free some space and repeat the command") from error
        raise DataError(f"cannot write {opened.name}: {error.strerror}") from error


@contextmanager
def _network_errors() -> Iterator[None]:
    """Convert connection errors to `_Broken`; an HTTP status is not a connection error."""
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
    """Return the byte where a response's body starts, and the size of the whole file; None if unknown."""
    if status == 206:
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", headers.get("Content-Range", ""))
        if match is not None and int(match[1]) == have:
            return have, None if match[2] == "*" else int(match[2])
        raise _Broken("the server sent another part of the file than requested")
    length = headers.get("Content-Length", "")
    return 0, int(length) if re.fullmatch(r"\d{1,18}", length) else None


def _at_the_end(headers: Message, known: _Answered, part: Path, have: int) -> _Answered:
    """Return the facts of a file that is completely received; raise `_Broken` if its size has changed."""
    if headers.get("Content-Range", "") == f"bytes */{have}":
        return known
    part.unlink()
    raise _Broken("the file has changed on the server")


def _validator(headers: Message) -> str:
    tag = headers.get("ETag", "")
    return tag if tag and not tag.startswith("W/") else headers.get("Last-Modified", "")


def _stated_md5(headers: Message) -> str:
    """Return in hexadecimal the MD5 that Google's storage states in base64; empty if there is none."""
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
        raise SourceError(f"{source.url}: the server sent a web page instead of the file; it may need a login")


def _check_room(part: Path, start: int, total: int | None) -> None:
    free = shutil.disk_usage(part.parent).free
    if total is not None and total - start > free:
        needed = f"{(total - start) / 1e9:.1f} GB are missing, {free / 1e9:.1f} GB are free"
        raise DataError(f"{part.parent}: the disk is too small: {needed}; free some space or use another --save-dir")


def _check(source: Source, answered: _Answered, part: Path) -> None:
    """Compare a complete file with the sum stated by its source, if any, and remove the file if they differ."""
    expected = [("sha256", source.sha256)] if source.sha256 else [("md5", answered.md5)] if answered.md5 else []
    for algorithm, value in expected:
        found = digest(part, algorithm)
        if found != value:
            part.unlink()
            raise SourceError(f"{source.url}: the file has the {algorithm} {found}, not {value}; it was removed")
    if not expected:
        say(f"note: {source.url} states no checksum; the file was not verified")


def _read_note(note: Path) -> _Answered:
    """Return the stored statements of an earlier response; empty ones if there are none."""
    try:
        content = json.loads(note.read_text(encoding="utf-8"))
        return _Answered(*(str(content[field]) for field in ("url", "validator", "md5")))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return _Answered("")
