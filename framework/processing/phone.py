"""What captures of phones, whose poses are known, have in common: images are prepared, transforms.json is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from framework.console import say
from framework.errors import DataError
from framework.processing.output import FINISHED
from framework.processing.pipeline import prepared
from framework.processing.pyramid import write_pyramid
from framework.processing.transforms import Frame, Lens, content, write


def read_json(path: Path) -> Any:
    """Raises: DataError where the file is missing or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"there is no {path}") from error
    except (ValueError, OSError) as error:
        raise DataError(f"{path} is not JSON that can be read: {str(error).splitlines()[0]}") from error


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
