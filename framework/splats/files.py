"""Files of Gaussians: a table of formats, told apart by their content when read and by their suffix when written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.lfs import ADVICE, is_pointer
from nerfloom.splats.gaussian_limit import fitted, fitted_ply, fitted_spz
from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.gltf import encoded_glb
from nerfloom.splats.ksplat import read_ksplat
from nerfloom.splats.look import ELSEWHERE, OURS, Look
from nerfloom.splats.ply import read_ply, stream_ply, write_ply
from nerfloom.splats.sog import META, read_sog
from nerfloom.splats.sog_writing import encoded_sog, write_sog
from nerfloom.splats.splat import read_splat
from nerfloom.splats.spz import read_spz
from nerfloom.splats.spz_container import MAGIC, SpzVersion
from nerfloom.splats.stream import GaussianStream


@dataclass(frozen=True)
class Order:
    """A request to write Gaussians to a file."""

    gaussians: Gaussians
    """N Gaussians on the CPU."""
    look: Look
    """The settings of drawing."""
    most_bytes: float | None
    """Maximum size of the file; None for any."""
    spz_version: SpzVersion
    """Version of SPZ files."""


Written = tuple[str, list[str]]
"""Description of the parts removed to fit the size, empty if none, and sentences about other losses."""


@dataclass(frozen=True)
class Format:
    """A format of files of Gaussians."""

    ending: str
    """Suffix of its files, or their whole name."""
    starts: tuple[bytes, ...] = ()
    """First bytes of its files; empty if only the ending identifies them."""
    read: Callable[[Path], Splats] | None = None
    """Reads a file; None if the format is not read."""
    write: Callable[[Path, Order], Written] | None = None
    """Writes a file; None if the format is not written."""
    program: str = ""
    """Name of the format, or of its program, for messages."""
    stream: Callable[[Path], GaussianStream] | None = None
    """Reads a file part by part; None if it is read as a whole."""


def _write_ply(file: Path, order: Order) -> Written:
    kept, changes = order.gaussians, ""
    if order.most_bytes is not None:
        kept, changes = fitted_ply(order.gaussians, order.most_bytes, order.look)
    write_ply(file, kept, order.look)
    return changes, []


def _write_spz(file: Path, order: Order) -> Written:
    content, lost, changes = fitted_spz(order.gaussians, order.most_bytes, order.look, order.spz_version)
    write_atomically(file, lambda stream: stream.write(content))
    return changes, lost


def _write_sog(file: Path, order: Order) -> Written:
    content, lost, changes = fitted(order.gaussians, order.most_bytes, lambda kept: encoded_sog(kept, order.look))
    write_sog(file, content)
    return changes, lost


def _write_glb(file: Path, order: Order) -> Written:
    content, lost, changes = fitted(order.gaussians, order.most_bytes, lambda kept: encoded_glb(kept, order.look))
    write_atomically(file, lambda stream: stream.write(content))
    return changes, lost


FORMATS = (
    Format(".ply", (b"ply",), read_ply, _write_ply, stream=stream_ply),
    Format(".spz", (b"\x1f\x8b", MAGIC), read_spz, _write_spz),
    Format(".sog", (b"PK\x03\x04",), read_sog, _write_sog),
    Format(META, (), read_sog, _write_sog),
    Format(".glb", (b"glTF",), None, _write_glb, "glTF"),
    Format(".splat", (), lambda file: Splats(read_splat(file), ELSEWHERE)),
    Format(".ksplat", (), lambda file: Splats(read_ksplat(file), ELSEWHERE)),
    Format(".splatv", program="antimatter15/splaTV"),
    Format(".rad", program="Spark"),
)
"""Every format. Formats that are neither read nor written have a message of their own."""
SUFFIXES = tuple(each.ending for each in FORMATS if each.write is not None and each.ending.startswith("."))
"""Suffixes of files that can be written."""
READ = tuple(each.ending for each in FORMATS if each.read is not None)
"""Endings of files that can be read."""


def is_splat_file(path: Path) -> bool:
    """Return whether `path` names a file of Gaussians, by its ending."""
    return _named(path) is not None


def read_gaussians(file: Path) -> Splats:
    """Read Gaussians and their settings of drawing from a file of any format of `READ`.

    Args:
        file: path of the file. Formats that begin with bytes of their own may have any suffix. A folder of the format
            SOG is named by its meta.json.

    Raises:
        DataError: if the file cannot be read, is of no such format, or is damaged.
        ConfigError: if a package is missing, which SPZ of version 4 needs.
    """
    return _reader(file)[1](file)


def stream_gaussians(file: Path) -> GaussianStream:
    """Return the Gaussians of a file, to be read part by part. A binary PLY file is never in memory as a whole.

    Args:
        file: path of the file, as in `read_gaussians`.

    Raises:
        DataError, ConfigError: as `read_gaussians`; of a PLY file, parts may raise them.
    """
    found, read = _reader(file)
    return GaussianStream.of(read(file)) if found.stream is None else found.stream(file)


def _reader(file: Path) -> tuple[Format, Callable[[Path], Splats]]:
    """Return the format of a file, by its content or its name, and the function that reads it."""
    try:
        with file.open("rb") as stream:
            start = stream.read(4)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    found = next((each for each in FORMATS if each.starts and start.startswith(each.starts)), _named(file))
    if found is not None and found.read is not None and (not found.starts or start.startswith(found.starts)):
        return found, found.read
    if is_pointer(file):
        raise DataError(f"{file} cannot be read: {ADVICE}")
    program = "" if found is None else found.program
    what = f"of {program}'s format" if program else "no file of Gaussians, or its beginning is damaged"
    raise DataError(f"{file} is {what}; Gaussians are read from {_listed(READ, 'and')} files: convert it to PLY")


def write_gaussians(
    file: Path,
    gaussians: Gaussians,
    max_megabytes: float | None = None,
    look: Look = OURS,
    spz_version: SpzVersion = 2,
) -> list[str]:
    """Write Gaussians to a file in the format of its suffix, and return the losses.

    Args:
        file: path of the file, with a suffix of `SUFFIXES`; the path of a meta.json makes a folder of the format SOG.
        gaussians: N Gaussians on the CPU; for a .glb file in a frame with y up (`Placement.y_up`).
        max_megabytes: maximum size of the file in millions of bytes; None for any.
        spz_version: version of an SPZ file.

    Returns:
        Sentences about the parts removed to fit the size, and about other parts that the format does not hold.

    Raises:
        ConfigError: if the format cannot hold the Gaussians, no file fits the size, or a package is missing, which SPZ
            of version 4 needs.
        OSError: if the file cannot be written.
    """
    found = _named(file)
    if found is None or found.write is None:
        raise ConfigError(f"{file}: Gaussians are written to {_listed(SUFFIXES, 'or')} files")
    most = None if max_megabytes is None else 1e6 * max_megabytes
    changes, lost = found.write(file, Order(gaussians, look, most, spz_version))
    return [f"{max_megabytes:g} MB hold {changes}", *lost] if changes else lost


def _named(path: Path) -> Format | None:
    """Return the format of a file's name; None if there is none."""
    return next((each for each in FORMATS if each.ending in (path.suffix.lower(), path.name)), None)


def _listed(words: tuple[str, ...], last: str) -> str:
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
