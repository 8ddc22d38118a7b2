"""Files that are complete or absent."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import pytest

from nerfloom.base.atomic import write_atomically


def test_two_threads_write_one_file(tmp_path: Path) -> None:
    """Two browsers of a viewer do so. The file has the content of the last writer, and no other file is left."""
    file = tmp_path / "crop.yaml"

    def write_during_another(stream: BinaryIO) -> None:
        stream.write(b"the first, ")
        with ThreadPoolExecutor(1) as pool:
            pool.submit(write_atomically, file, lambda other: other.write(b"the second")).result()
        assert file.read_bytes() == b"the second"
        stream.write(b"which ends last")

    write_atomically(file, write_during_another)
    assert file.read_bytes() == b"the first, which ends last"
    assert [one.name for one in tmp_path.iterdir()] == ["crop.yaml"]


@pytest.mark.parametrize("stem", ["a" * 250, "\u00e9" * 125])
def test_a_name_may_be_as_long_as_the_system_allows(tmp_path: Path, stem: str) -> None:
    write_atomically(tmp_path / f"{stem}.ply", lambda file: file.write(b"1"))
    assert [path.name for path in tmp_path.iterdir()] == [f"{stem}.ply"]
