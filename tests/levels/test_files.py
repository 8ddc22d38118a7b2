"""Files of levels: the layout as documented, the loss of 16 bits, and hostile files refused in one line."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.levels.files import ALIGNMENT, MAGIC, MAX_HEADER, PREAMBLE, read_levels
from tests.levels.made import built, cloud, leaves


def header_of(file: Path) -> tuple[dict[str, Any], int]:
    content = file.read_bytes()
    _, begin, length, _ = PREAMBLE.unpack(content[:64])
    return json.loads(content[begin : begin + length]), begin


def write_header(file: Path, text: bytes, begin: int) -> None:
    """Exchange the header, with the right checksum."""
    chunks = file.read_bytes()[64:begin]
    file.write_bytes(PREAMBLE.pack(MAGIC, begin, len(text), hashlib.sha256(text).digest()) + chunks + text)


def refusal(file: Path) -> str:
    with pytest.raises(DataError) as error:
        read_levels(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)
    return str(error.value)


def test_numpy_maps_the_arrays_where_the_layout_says(tmp_path: Path) -> None:
    path = tmp_path / "x.levels"
    file = built(path, cloud(500, 2))
    header, begin = header_of(path)
    place = 64
    for index, count in enumerate(header["count"]):
        assert place % ALIGNMENT == 0
        chunk, at = file.read(index), place
        for name, shape in (
            ("means", (count, 3)), ("log_scales", (count, 3)), ("rotations", (count, 4)), ("logits", (count,)),
            ("colors", (count, 3)), ("harmonics", (count, 3, 8)),
        ):  # fmt: skip
            mapped = np.memmap(path, "<f4", "r", offset=at, shape=shape)
            np.testing.assert_array_equal(mapped, getattr(chunk, name).numpy())
            at += 4 * mapped.size
            del mapped
        place = -(-at // ALIGNMENT) * ALIGNMENT
    assert place == begin
    assert header["parent"][-1] == -1
    assert header["look"] == {"antialiased": False, "blur": 0.3, "sort": "distance"}


def test_16_bits_are_close_and_half_as_large(tmp_path: Path) -> None:
    given = cloud(500, 3)
    given.rotations[0] *= 1e10
    whole, half = built(tmp_path / "a.levels", given, memory=1.0), built(tmp_path / "b.levels", given, 100, 16, 1.0)
    assert leaves(whole) == leaves(half)
    for index in leaves(whole):
        one, other = whole.read(index), half.read(index)
        assert torch.equal(one.means, other.means)
        for name in ("log_scales", "logits", "colors", "harmonics"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=2**-11, atol=1e-6)
        turns = [torch.nn.functional.normalize(part.rotations, dim=-1) for part in (one, other)]
        torch.testing.assert_close(*turns, rtol=0, atol=2**-10)
    sizes = [(tmp_path / name).stat().st_size for name in ("a.levels", "b.levels")]
    assert sizes[1] < 0.65 * sizes[0]


def test_damaged_chunks_are_refused_when_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.levels"
    file = built(path, cloud(500))
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="chunk 0 is damaged"):
        read_levels(path).read(0)
    assert len(read_levels(path).read(1)) == int(file.nodes.counts[1])
    path.write_bytes(content[:100])  # while it is open
    with pytest.raises(DataError, match="chunk 1 is damaged"):
        file.read(1)
    path.unlink()
    with pytest.raises(DataError, match="cannot read"):
        file.read(0)


def test_truncated_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "x.levels"
    built(path, cloud(500))
    whole = path.read_bytes()
    for length in (0, 10, 63, 64, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        refusal(path)
    path.write_bytes(whole + b" ")
    refusal(path)
    path.write_bytes(b"PLEVELS1" + whole[8:])
    assert "other bytes" in refusal(path)
    path.write_bytes(whole[:-1] + b"]")
    assert "checksum" in refusal(path)
    path.write_bytes(PREAMBLE.pack(MAGIC, 64, 2**63, bytes(32)))
    assert "9,223,372,036,854,775,808 bytes" in refusal(path)
    with path.open("wb") as stream:  # a header that would fill the memory, of a sparse file
        stream.write(PREAMBLE.pack(MAGIC, 64, MAX_HEADER + 1, bytes(32)))
        stream.truncate(64 + MAX_HEADER + 1)
    refusal(path)
    path.unlink()
    assert "cannot read" in refusal(path)


def grown(name: str, index: int, value: Any) -> Callable[[dict[str, Any]], None]:
    """A change of one entry."""
    return lambda header: header[name].__setitem__(index, value)


HOSTILE: list[tuple[str, Callable[[dict[str, Any]], Any]]] = [
    ("version", lambda header: header.update(version=2)),
    ("degree", lambda header: header.update(degree=4)),
    ("degree", lambda header: header.update(degree=True)),
    ("bits", lambda header: header.update(bits=8)),
    ("chunks do not end", lambda header: header.update(bits=16)),
    ("chunks do not end", lambda header: header.update(degree=3)),
    ("chunks do not end", grown("count", 0, 1)),
    ("no more than the file has", grown("count", 0, 2**62)),
    ("'count'", grown("count", 0, 2**70)),
    ("'count'", grown("count", 0, 1.5)),
    ("'count'", grown("count", 0, [1])),
    ("'count'", lambda header: header.update(count=["x" * 10**6] + 10**6 * [""])),  # 4 TB as an array
    ("must have Gaussians", grown("count", 0, 0)),
    ("must have Gaussians", grown("count", 0, -5)),
    ("'count'", lambda header: header.update(count=[])),
    ("'count'", lambda header: header.pop("count")),
    ("'crc32'", lambda header: header["crc32"].pop()),
    ("not a tree", grown("parent", 0, 0)),
    ("not a tree", grown("parent", 0, -1)),
    ("not a tree", grown("parent", 0, 10**6)),
    ("not a tree", grown("parent", -1, 0)),
    ("'low'", grown("low", 0, [0.0, 0.0, float("nan")])),
    ("'low'", grown("low", 0, [0.0, 0.0])),
    ("below zero", grown("low", 0, [10.0, 0.0, 0.0])),
    ("below zero", grown("error", 0, -1.0)),
    ("'error'", grown("error", 0, float("inf"))),
    ("larger", grown("error", 0, 1e9)),
    ("larger", grown("reach", 0, 1e9)),
    ("larger", grown("low", 0, [-10.0, -10.0, -10.0])),
    ("'origin'", lambda header: header.update(origin=[0, 0])),
    ("'origin'", lambda header: header.update(origin="here")),
    ("Look", lambda header: header.update(look=None)),
    ("Look", lambda header: header["look"].update(sort="colour")),
    ("Look", lambda header: header["look"].update(colour=1)),
    ("blur", lambda header: header["look"].update(blur=1e9)),
    ("blur", lambda header: header["look"].update(blur=float("nan"))),
]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "x.levels"
    built(path, cloud(500))
    return path


@pytest.mark.parametrize("number", range(len(HOSTILE)))
def test_hostile_headers(good: Path, tmp_path: Path, number: int) -> None:
    because, change = HOSTILE[number]
    path = tmp_path / "x.levels"
    path.write_bytes(good.read_bytes())
    header, begin = header_of(path)
    change(header)
    write_header(path, json.dumps(header).encode(), begin)
    said = refusal(path)
    assert because in said


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b'{"version": 1' + b"0" * 5000 + b"}"]
)
def test_headers_that_are_none(good: Path, tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "x.levels"
    path.write_bytes(good.read_bytes())
    write_header(path, text, header_of(path)[1])
    assert "is not a file of levels, or is damaged" in refusal(path)
