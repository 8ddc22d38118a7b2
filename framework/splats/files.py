"""Files of Gaussians: PLY, SPZ or .splat, told apart by their content when read and by their suffix when written."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.splats.gaussian_limit import fitted_ply, fitted_spz
from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.look import ELSEWHERE, OURS, Look
from nerfloom.splats.ply import read_ply, write_ply
from nerfloom.splats.splat import read_splat
from nerfloom.splats.spz import MAGIC, encoded, out_of_range, read_spz

SUFFIXES = (".ply", ".spz")
"""Suffixes of files that can be written."""
SPLAT = ".splat"
"""Suffix of a further format that can be read; its files have no header."""
OTHERS = {
    ".ksplat": "GaussianSplats3D", ".sog": "PlayCanvas", ".splatv": "antimatter15/splaTV", ".rad": "Spark",
}  # fmt: skip
"""Suffixes of formats that cannot be read, and their programs."""


def is_splat_file(path: Path) -> bool:
    """Return whether `path` names a file of Gaussians, by its suffix."""
    return path.suffix.lower() in (*SUFFIXES, SPLAT, *OTHERS)


def read_gaussians(file: Path) -> Splats:
    """Read Gaussians and their settings of drawing from a PLY (compressed or not), SPZ or .splat file.

    Args:
        file: path of the file, with any suffix if it is PLY or SPZ.

    Raises:
        DataError: if the file cannot be read, is none of these, or is damaged.
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
    suffix = file.suffix.lower()
    if suffix == SPLAT:
        return Splats(read_splat(file), ELSEWHERE)
    what = f"of {OTHERS[suffix]}'s format" if suffix in OTHERS else "neither a PLY nor an SPZ file"
    raise DataError(f"{file} is {what}; Gaussians are read from .ply, .spz and .splat files: convert it to PLY")


def write_gaussians(
    file: Path, gaussians: Gaussians, max_megabytes: float | None = None, look: Look = OURS
) -> list[str]:
    """Write Gaussians to a file in the format of its suffix, and return what was lost.

    Args:
        file: path of the file, with a suffix of `SUFFIXES`.
        gaussians: N Gaussians on the CPU.
        max_megabytes: maximum size of the file in millions of bytes; None for any.
        look: the settings of drawing.

    Returns:
        Sentences about what was removed to fit the size, and about values outside the format's range.

    Raises:
        ConfigError: if the format cannot hold the Gaussians, or no file fits the size.
        OSError: if the file cannot be written.
    """
    most = None if max_megabytes is None else 1e6 * max_megabytes
    if file.suffix == ".ply":
        kept, changes = (gaussians, "") if most is None else fitted_ply(gaussians, most, look)
        write_ply(file, kept, look)
        lost = []
    elif file.suffix == ".spz":
        content, changes = (encoded(gaussians, look=look), "") if most is None else fitted_spz(gaussians, most, look)
        lost = out_of_range(gaussians)
        write_atomically(file, lambda stream: stream.write(content))
    else:
        raise ConfigError(f"{file}: Gaussians are written to {' or '.join(SUFFIXES)} files")
    return [f"{max_megabytes:g} MB hold {changes}", *lost] if changes else lost
