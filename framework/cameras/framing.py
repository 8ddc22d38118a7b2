"""Image size and field of view of cameras."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras


def perspective(poses: Tensor, width: int, height: int, fov: Tensor | float) -> Cameras:
    """Return pinhole cameras at `poses` (M, 3, 4) with square pixels and the axis in the middle of the image.

    Images have `width` x `height` pixels; `fov` is the vertical field of view of all, or (M,) of each, in degrees.
    """
    count, device = len(poses), poses.device
    half = torch.deg2rad(torch.as_tensor(fov, dtype=torch.float64)) / 2
    focal = (height / 2 / half.tan()).float().expand(count).to(device)
    cx, cy = (torch.full((count,), side / 2, device=device) for side in (width, height))
    widths, heights = (torch.full((count,), side, device=device) for side in (width, height))
    return Cameras(poses.float(), focal, focal, cx, cy, widths, heights)


def size_of(size: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    """Return (width, height) `size` resized to `width` and `height`; None for one of them keeps the aspect ratio."""
    before_width, before_height = size
    if width is None:
        width = before_width if height is None else max(round(before_width * height / before_height), 1)
    return width, max(round(before_height * width / before_width), 1) if height is None else height


def framed(cameras: Cameras, width: int | None = None, height: int | None = None, fov: float | None = None) -> Cameras:
    """Return cameras with images of another size, and another field of view.

    An image of another aspect ratio shows a part of the image plane of the same area, so that neither wide nor tall
    images show much that the first ones did not. With `fov`, cameras become pinhole cameras.

    Args:
        cameras: M cameras with images of one size.
        width: width of the images, pixels; None to keep it, or the aspect ratio if `height` is given.
        height: height of the images, pixels; None likewise.
        fov: vertical field of view, degrees; None to keep the cameras'.

    Raises:
        ConfigError: if a panorama was to have another aspect ratio.
    """
    before = before_width, before_height = int(cameras.widths[0]), int(cameras.heights[0])
    width, height = size_of(before, width, height)
    if fov is not None:
        found = perspective(cameras.camera_to_worlds, width, height, fov)
        return replace(
            cameras,
            model="pinhole",
            lens=None,
            fx=found.fx,
            fy=found.fy,
            cx=found.cx,
            cy=found.cy,
            widths=found.widths,
            heights=found.heights,
        )
    across, down = width / before_width, height / before_height
    if cameras.model != "equirectangular":
        across = down = (across * down) ** 0.5
    elif (width, height) not in (size_of(before, width, None), size_of(before, None, height)):
        raise ConfigError(
            f"panoramas of {before_width}x{before_height} keep their aspect ratio: give --width or --height alone, or "
            "--fov for a perspective"
        )
    cx = width / 2 + (cameras.cx - before_width / 2) * across
    cy = height / 2 + (cameras.cy - before_height / 2) * down
    widths, heights = torch.full_like(cameras.widths, width), torch.full_like(cameras.heights, height)
    fx, fy = cameras.fx * across, cameras.fy * down
    return replace(cameras, fx=fx, fy=fy, cx=cx, cy=cy, widths=widths, heights=heights)
