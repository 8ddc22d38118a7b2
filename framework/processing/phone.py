"""Conversion of phone captures with known poses: preparation of images, and transforms.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.json_files import write_json
from nerfloom.processing.capture import Capture, PosedCamera, for_size_of, resized
from nerfloom.processing.finite_numbers import finite, side
from nerfloom.processing.images import prepare_all
from nerfloom.processing.output import FINISHED, ready
from nerfloom.processing.point_files import with_points
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.processing.transforms import POINTS, Frame, Lens, content, write_points


def undistorted_lens(size: Iterable[Any], intrinsics: Iterable[Any]) -> Lens:
    """Return a lens without distortion, of width and height `size` and fx, fy, cx, cy `intrinsics`, pixels.

    Raises:
        TypeError, ValueError, OverflowError: if a value is invalid (`UNUSABLE`).
    """
    width, height = (side(value) for value in size)
    fx, fy, cx, cy = (finite(value) for value in intrinsics)
    if min(fx, fy) <= 0:
        raise ValueError("a focal length must be above zero")
    return Lens("OPENCV", {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy})


def evenly_spaced(items: list, most: int) -> list:
    """Return at most `most` evenly spaced `items`, including the first and the last; report if there are more."""
    if len(items) <= most:
        return items
    say(f"{most} of {len(items)} images are taken, evenly spaced (--max-dataset-size)")
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int).tolist()]


def write_folder(
    folder: Path,
    posed: dict[Path, tuple[np.ndarray, Lens]],
    output: Path,
    num_downscales: int,
    applied: np.ndarray,
    z_is_up: bool,
    crop: int = 0,
    points: Path | None = None,
) -> None:
    """Prepare images and write a data folder.

    Args:
        folder: folder of the images.
        posed: camera-to-world pose (4, 4) with OpenGL axes, and lens of the uncropped image, by the image's path; the
            image may have another size.
        output: the output folder, claimed by `output.claim`.
        num_downscales: number of folders of reduced images.
        applied: (3, 4) transform from the phone's frame to the poses' frame.
        z_is_up: whether z is up in the frame of the poses, as the phone has measured; otherwise the up direction is
            estimated from the poses.
        crop: pixels to cut off at each side.
        points: PLY file of points in the phone's frame, or a folder of several; None for none.

    Raises:
        DataError: if no image is readable, an image and its lens differ in shape, or points cannot be used.
    """
    back = np.linalg.inv(np.vstack([applied, [0, 0, 0, 1]]))  # the points are in the phone's frame
    cameras = [PosedCamera(name.as_posix(), back @ pose, for_size_of(lens)) for name, (pose, lens) in posed.items()]
    cloud = with_points(Capture("the phone", cameras, Counter()), points)
    prepared, _ = prepare_all(folder, list(posed), output / "images", upright=False, crop=crop)
    frames = []
    for image in prepared:
        pose, stated = posed[Path(image.source)]
        try:
            lens = resized(stated, image.width + 2 * crop, image.height + 2 * crop)
        except DataError as error:
            raise DataError(f"{folder / image.source}: {error}") from error
        frames.append(Frame(image.name, pose, cropped(lens, crop), source=image.source))
    write_pyramid(output / "images", [image.name for image in prepared], num_downscales)
    if cloud.points is not None and cloud.colors is not None:
        write_points(output / POINTS, cloud.points @ applied[:, :3].T + applied[:, 3], cloud.colors)
        say(f"{len(cloud.points):,} points")
    more = {"orientation_override": "none"} if z_is_up else {}
    write_json(output / FINISHED, content(frames, applied, None if cloud.points is None else POINTS, more))
    say(f"{len(frames)} images with the phone's poses")
    say(ready(output))


def cropped(lens: Lens, crop: int) -> Lens:
    """Return the `lens` of images with `crop` pixels cut off at each side."""
    values = dict(lens.values)
    for key, change in (("w", 2 * crop), ("h", 2 * crop), ("cx", crop), ("cy", crop)):
        values[key] -= change
    return Lens(lens.model, values)
