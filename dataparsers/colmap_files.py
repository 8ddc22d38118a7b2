"""Validation of COLMAP's binary files: whether they hold the number of records that they state.

pycolmap trusts the count at the beginning of a file. It reads cameras in a truncated file from uninitialised memory, or
reads without end. So each file is traversed once, record by record, before it is read.
"""

from __future__ import annotations

import codecs
import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from nerfloom import DataError
from nerfloom.base.lfs import ADVICE, is_pointer

MAX_NAME_LENGTH = 4096
"""Maximum length of an image's name, bytes; no system opens longer paths."""
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16}
"""Number of a camera model -> number of its parameters."""
POSE = 7 * 8
"""Size of a rotation (4) and a translation (3), bytes."""
NAME = 4 + POSE + 4
"""Position of the name in an image's record, after its number, pose and camera, bytes."""

Walk = Callable[[mmap.mmap, int], int]
"""Function from the start of a record to its end. It raises `struct.error` if the file ends before that or the record
is invalid."""


def check_binary(folder: Path) -> None:
    """Traverse the existing binary files of a model in `folder`.

    Raises:
        DataError: if a file is truncated or damaged.
    """
    for name, (walk, records) in RECORDS.items():
        if (folder / f"{name}.bin").is_file():
            _check_file(folder / f"{name}.bin", walk, records)


def check_text(folder: Path) -> None:
    """Check that the existing text files of a model in `folder` begin as COLMAP expects.

    Raises:
        OSError: if a file cannot be read.
        DataError: if a file begins with a byte-order mark, as some editors write it.
    """
    for file in (folder / f"{name}.txt" for name in RECORDS):
        if not file.is_file():
            continue
        if is_pointer(file):
            raise DataError(f"{file} cannot be read: {ADVICE}")
        with file.open("rb") as opened:
            if opened.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8:
                raise DataError(
                    f"{file} begins with a byte-order mark, which COLMAP does not read; save it without one"
                )


def image_names(folder: Path) -> list[str]:
    """Return the readable names of the images in the model in `folder`. Never raises."""
    names: list[str] = []
    try:
        if not (folder / "images.bin").is_file():
            return list(text_names(folder / "images.txt").values())
        with (folder / "images.bin").open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,) = struct.unpack_from("<Q", data, 0)
            offset = 8
            while len(names) < count:
                start = offset + NAME
                names.append(data[start : data.find(b"\0", start, start + MAX_NAME_LENGTH)].decode("utf-8", "replace"))
                offset = _image(data, offset)
    except (OSError, ValueError, struct.error, OverflowError):  # DataError is a ValueError
        pass
    return names


def text_names(file: Path) -> dict[int, str]:
    """Return image number -> name in images.txt, `file`, including spaces, where pycolmap cuts names off.

    Raises:
        OSError: if the file cannot be read.
        DataError: if a line is no image, or an image's second line, which may be empty, is missing.
    """
    names: dict[int, str] = {}
    rule = "each image has two lines, and the second has its keypoints, or is empty"
    with file.open(encoding="utf-8", errors="surrogateescape", newline="\n") as lines:
        numbered = enumerate(lines, start=1)
        for number, line in numbered:
            words = line.strip().split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            if len(words) < 10 or not words[0].isdecimal() or not all(map(_is_number, words[:9])):
                raise DataError(
                    f"{file}: line {number} is damaged: an image has a number, 4 numbers of a rotation, 3 of a "
                    "translation, the number of a camera and a name, with decimal points; export the model again"
                )
            names[int(words[0])] = words[9]
            _, second = next(numbered, (0, None))
            if second is None:
                raise DataError(f"{file} ends after the first line of image {words[-1]!r}; {rule}: add a line")
            points = second.split(maxsplit=9)
            if len(points) == 10 and points[0].isdecimal() and not _is_number(points[9].split()[-1]):
                raise DataError(f"{file}: the line after image {words[-1]!r} is another image; {rule}")
    return names


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _check_file(file: Path, walk: Walk, records: str) -> None:
    if is_pointer(file):
        raise DataError(f"{file} cannot be read: {ADVICE}")
    advice = "copy it again, or export the model again with `colmap model_converter`"
    try:
        if file.stat().st_size < 8:
            raise DataError(f"{file} is truncated: the number of {records} is missing; {advice}")
        with file.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,) = struct.unpack_from("<Q", data, 0)
            offset, index = 8, 0
            try:
                while index < count:
                    offset = walk(data, offset)
                    if offset > len(data):
                        raise struct.error
                    index += 1
            except (struct.error, OverflowError) as error:
                raise DataError(
                    f"{file} is truncated or damaged: it states {count} {records}, and number {index + 1} does not fit "
                    f"in its {len(data)} bytes; {advice}"
                ) from error
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error


def _camera(data: mmap.mmap, offset: int) -> int:
    """Return the end of a camera: number u32, model i32, width u64, height u64, parameters f64."""
    (model,) = struct.unpack_from("<i", data, offset + 4)
    if model not in PARAMETERS:  # a model newer than this list, which pycolmap may know
        return min(offset + 24 + 8, len(data))
    return offset + 24 + 8 * PARAMETERS[model]


def _image(data: mmap.mmap, offset: int) -> int:
    """Return the end of an image: number u32, pose, camera u32, zero-terminated name, u64 keypoints of 24 bytes."""
    start = offset + NAME
    end = data.find(b"\0", start, start + MAX_NAME_LENGTH)
    if end < 0:
        raise struct.error
    (keypoints,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * keypoints


def _point(data: mmap.mmap, offset: int) -> int:
    """Return the end of a point: number u64, position 3 f64, colour 3 u8, error f64, u64 observations of two u32."""
    (observations,) = struct.unpack_from("<Q", data, offset + 43)
    return offset + 51 + 8 * observations


def _rig(data: mmap.mmap, offset: int) -> int:
    """Return the end of a rig: number u32, u32 sensors of i32 and u32, all but the first with u8 and maybe a pose."""
    (sensors,) = struct.unpack_from("<I", data, offset + 4)
    offset += 8 + (8 if sensors else 0)
    for _ in range(1, sensors):
        (has_pose,) = struct.unpack_from("<B", data, offset + 8)
        offset += 9 + (POSE if has_pose else 0)
    return offset


def _frame(data: mmap.mmap, offset: int) -> int:
    """Return the end of a frame: number u32, rig u32, pose, u32 data of i32, u32 and u64."""
    (pictures,) = struct.unpack_from("<I", data, offset + 8 + POSE)
    return offset + 12 + POSE + 16 * pictures


RECORDS: dict[str, tuple[Walk, str]] = {
    "rigs": (_rig, "rigs"),
    "cameras": (_camera, "cameras"),
    "frames": (_frame, "frames"),
    "images": (_image, "images"),
    "points3D": (_point, "points"),
}
"""File -> function that steps over one of its records, and the name of the records."""
