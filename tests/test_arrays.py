"""numpy's files of an array: what they hold is read, and no more memory is asked for than they have bytes."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from framework.arrays import read_array


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


def test_memory_is_asked_for_by_the_file_and_not_by_its_header(tmp_path: Path) -> None:
    """Of 24 bytes that claim to be a gigabyte."""
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(3))
    content = path.read_bytes()
    changed = content.replace(b"(3,), }" + 8 * b" ", b"(125000000,), }")
    assert changed != content
    assert len(changed) == len(content)
    path.write_bytes(changed)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="file size"):
            read_array(path)
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_several_arrays_are_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros(3), b=np.ones(2))
    with pytest.raises(ValueError, match="several arrays"):
        read_array(tmp_path / "a.npz")
