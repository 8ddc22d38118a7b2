"""COLMAP's binary files, checked before they are read: whether they hold as many records as they promise.

The library that reads them believes a count at the head of a file. Of a file cut short it makes cameras of whatever
the memory held, or reads without end, so each file is walked once, record by record.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from framework import DataError

LONGEST_NAME = 4096
"""Bytes of an image's name; no system opens a longer path."""
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16}
"""Number of a camera model -> how many parameters it has."""
POSE = 7 * 8
"""Bytes of a rotation (4) and a translation (3)."""

Walk = Callable[[mmap.mmap, int], int]
"""From where a record starts to where it ends; raises `struct.error` where the file ends before, or it is nonsense."""


def check_binary(folder: Path) -> None:
    """Walk through those of a model's binary files that exist.

    Raises: DataError that names a file that is cut short or holds something else.
    """
    for name, (walk, what) in RECORDS.items():
        if (folder / f"{name}.bin").is_file():
            _check_file(folder / f"{name}.bin", walk, what)


def count_images(folder: Path) -> int:
    """How many images a model says it has, binary or text; 0 where that cannot be read. Never raises."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as file:
                return struct.unpack("<Q", file.read(8))[0]
        with (folder / "images.txt").open(encoding="utf-8", errors="replace") as file:
            # Two lines an image, the second being empty where it has no keypoints.
            return sum(not line.startswith("#") for line in file) // 2
    except (OSError, struct.error):
        return 0


def _check_file(file: Path, walk: Walk, what: str) -> None:
    advice = "copy it anew, or export the model again with `colmap model_converter`"
    try:
        if file.stat().st_size < 8:
            raise DataError(f"{file} is cut short: it has no room for a count of {what}; {advice}")
        with file.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,) = struct.unpack_from("<Q", data, 0)
            place, walked = 8, 0
            try:
                while walked < count:
                    place = walk(data, place)
                    if place > len(data):
                        raise struct.error
                    walked += 1
            except (struct.error, OverflowError) as error:
                raise DataError(
                    f"{file} is cut short or damaged: it promises {count} {what}, and number {walked + 1} does not fit "
                    f"in its {len(data)} bytes; {advice}"
                ) from error
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error


def _camera(data: mmap.mmap, place: int) -> int:
    """Number u32, model i32, width u64, height u64, parameters f64."""
    (model,) = struct.unpack_from("<i", data, place + 4)
    if model not in PARAMETERS:  # a model newer than this list: the reader knows whether there is one
        return min(place + 24 + 8, len(data))
    return place + 24 + 8 * PARAMETERS[model]


def _image(data: mmap.mmap, place: int) -> int:
    """Number u32, pose, camera u32, name that ends with a zero byte, u64 keypoints of two f64 and a u64."""
    start = place + 4 + POSE + 4
    end = data.find(b"\0", start, start + LONGEST_NAME)
    if end < 0:
        raise struct.error
    (keypoints,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * keypoints


def _point(data: mmap.mmap, place: int) -> int:
    """Number u64, position three f64, colour three u8, error f64, u64 observations of two u32."""
    (observations,) = struct.unpack_from("<Q", data, place + 43)
    return place + 51 + 8 * observations


def _rig(data: mmap.mmap, place: int) -> int:
    """Number u32, u32 sensors of i32 and u32; all but the first with a u8 that says whether a pose follows."""
    (sensors,) = struct.unpack_from("<I", data, place + 4)
    place += 8 + (8 if sensors else 0)
    for _ in range(1, sensors):
        (has_pose,) = struct.unpack_from("<B", data, place + 8)
        place += 9 + (POSE if has_pose else 0)
    return place


def _frame(data: mmap.mmap, place: int) -> int:
    """Number u32, rig u32, pose, u32 pictures of i32, u32 and u64."""
    (pictures,) = struct.unpack_from("<I", data, place + 8 + POSE)
    return place + 12 + POSE + 16 * pictures


RECORDS: dict[str, tuple[Walk, str]] = {
    "rigs": (_rig, "rigs"),
    "cameras": (_camera, "cameras"),
    "frames": (_frame, "frames"),
    "images": (_image, "images"),
    "points3D": (_point, "points"),
}
"""File -> how to step over one of its records, and what they are."""
