"""Files of Gaussians: PLY or SPZ, told apart by their content when read and by their suffix when written."""

from __future__ import annotations

from pathlib import Path

from framework.base.atomic import write_atomically
from framework.base.errors import ConfigError, DataError
from framework.splats.budget import fitted_ply, fitted_spz
from framework.splats.gaussians import Gaussians
from framework.splats.ply import read_ply, write_ply
from framework.splats.spz import MAGIC, encoded, out_of_range, read_spz

SUFFIXES = (".ply", ".spz")
"""Suffixes of files that can be written."""


def read_gaussians(file: Path) -> Gaussians:
    """Read Gaussians from a PLY or an SPZ file.

    Args:
        file: path of the file, with any suffix.

    Raises:
        DataError: if the file cannot be read, is neither, or is damaged.
    """
    try:
        with file.open("rb") as stream:
            start = stream.read(4)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    if start[:3] == b"ply":
        return read_ply(file)
    if start[:2] == b"\x1f\x8b" or start == MAGIC:
        return read_spz(file)
    raise DataError(f"{file} is neither a PLY nor an SPZ file; Gaussians are read from these two")


def write_gaussians(file: Path, gaussians: Gaussians, max_megabytes: float | None = None) -> list[str]:
    """Write Gaussians to a file of the format that its suffix names, and return what that cost.

    Args:
        file: path of the file, with a suffix of `SUFFIXES`.
        gaussians: N Gaussians on the CPU.
        max_megabytes: maximum size of the file in millions of bytes; None for any.

    Returns:
        Sentences on what was left out to make the file small enough, or is beyond the format's range.

    Raises:
        ConfigError: if the format cannot hold the Gaussians, or no file is that small.
        OSError: if the file cannot be written.
    """
    most = None if max_megabytes is None else 1e6 * max_megabytes
    if file.suffix == ".ply":
        kept, changes = (gaussians, "") if most is None else fitted_ply(gaussians, most)
        write_ply(file, kept)
        lost = []
    elif file.suffix == ".spz":
        content, changes = (encoded(gaussians), "") if most is None else fitted_spz(gaussians, most)
        lost = out_of_range(gaussians)
        write_atomically(file, lambda stream: stream.write(content))
    else:
        raise ConfigError(f"{file}: Gaussians are written to {' or '.join(SUFFIXES)} files")
    return [f"{max_megabytes:g} MB hold {changes}", *lost] if changes else lost
