"""What captures of phones, whose poses are known, have in common: images are prepared, transforms.json is written."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from framework.base.console import say
from framework.base.errors import DataError
from framework.data.image_files import one_line
from framework.tools.processing.output import FINISHED
from framework.tools.processing.pipeline import prepared
from framework.tools.processing.pyramid import write_pyramid
from framework.tools.processing.transforms import Frame, Lens, content, write

UNUSABLE = (KeyError, TypeError, ValueError, OverflowError)
"""What goes wrong where a JSON file lacks a number, or has something else in its place."""


def read_json(path: Path) -> dict[str, Any]:
    """Raises: DataError where the file is missing, not JSON, or no object."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"there is no {path}") from error
    except (ValueError, OSError, RecursionError) as error:
        raise DataError(f"{path} is not JSON that can be read: {one_line(error)}") from error
    if not isinstance(found, dict):
        raise DataError(f"{path} must hold a JSON object: names and values between braces")
    return found


def finite(value: Any) -> float:
    """A number out of a JSON file. Raises: one of `UNUSABLE` where it is none, or not finite."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} is not finite")
    return number


def undistorted_lens(size: Iterable[Any], intrinsics: Iterable[Any]) -> Lens:
    """The lens of a JSON file's width and height, and fx, fy, cx, cy, all in pixels.

    Raises: one of `UNUSABLE` where they are not such.
    """
    width, height = (int(finite(value)) for value in size)
    fx, fy, cx, cy = (finite(value) for value in intrinsics)
    if min(fx, fy) <= 0:
        raise ValueError("a focal length must be above zero")
    return Lens("OPENCV", {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy})


def evenly(items: list, most: int) -> list:
    """At most `most` of the items, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int).tolist()]


def write_folder(
    folder: Path,
    posed: dict[Path, tuple[np.ndarray, Lens]],
    output: Path,
    num_downscales: int,
    applied: np.ndarray,
    crop: int = 0,
) -> None:
    """Prepare images and write the data folder `output`, which has been claimed.

    Args:
        folder: where the images are.
        posed: (4, 4) camera-to-world pose with OpenGL axes, and lens of the whole image, by the image's path there.
        applied: (3, 4) from the phone's frame to that of the poses.
        crop: pixels to cut off at each side.
    Raises: DataError where no image can be read, or one has not its lens's size.
    """
    photographs, _ = prepared(folder, list(posed), output / "images", upright=False, crop=crop)
    frames = []
    for photograph in photographs:
        pose, whole = posed[Path(photograph.source)]
        lens = cropped(whole, crop)
        size = (photograph.width, photograph.height)
        if size != (lens.values["w"], lens.values["h"]):
            expected = f"{whole.values['w']}x{whole.values['h']}"
            found = f"{size[0] + 2 * crop}x{size[1] + 2 * crop}"
            raise DataError(f"{folder / photograph.source} is {found} pixels, but its camera is for {expected}")
        frames.append(Frame(photograph.name, pose, lens, source=photograph.source))
    write_pyramid(output / "images", [photograph.name for photograph in photographs], num_downscales)
    # The phone knows where down is: the frame is upright already, and need not be guessed from the poses.
    write(output / FINISHED, content(frames, applied, None, {"orientation_override": "none"}))
    say(f"{len(frames)} images with the phone's poses")
    say(f"data folder: {output}")


def cropped(lens: Lens, crop: int) -> Lens:
    """The lens of images of which `crop` pixels are cut off at each side."""
    values = dict(lens.values)
    for key, change in (("w", 2 * crop), ("h", 2 * crop), ("cx", crop), ("cy", crop)):
        values[key] -= change
    return Lens(lens.model, values)
