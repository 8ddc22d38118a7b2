"""numpy's files of an array: their content is read, and no more memory is allocated than they have bytes."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from nerfloom.base.arrays import read_array


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f4", ">f8", "|u1"])
def test_what_was_written_is_read_and_belongs_to_no_file(kind: str, order: str, tmp_path: Path) -> None:
    array = np.asarray(np.arange(12).reshape(3, 4), dtype=kind, order=order)  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", array)
    found = read_array(tmp_path / "a.npy")
    (tmp_path / "a.npy").write_bytes(b"")
    assert found.dtype == array.dtype
    assert np.array_equal(found, array)
    assert type(found) is np.ndarray


CLAIMS = {
    "a gigabyte of numbers": (b"(3,), }" + 8 * b" ", b"(125000000,), }"),
    "a header of three gigabytes": (b"\x93NUMPY\x01\x00v\x00{'", b"\x93NUMPY\x02\x00v\x00{\xbb"),
}
"""Bytes of a file of 152 bytes, and their replacements."""


@pytest.mark.parametrize("claim", CLAIMS)
def test_memory_is_asked_for_by_the_file_and_not_by_its_header(claim: str, tmp_path: Path) -> None:
    path, (before, after) = tmp_path / "a.npy", CLAIMS[claim]
    np.save(path, np.zeros(3))
    content = path.read_bytes()
    assert content.count(before) == 1
    assert len(before) == len(after)
    path.write_bytes(content.replace(before, after))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"file size|shorter than its header"):
            read_array(path)
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_several_arrays_are_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros(3), b=np.ones(2))
    with pytest.raises(ValueError, match="several arrays"):
        read_array(tmp_path / "a.npz")
