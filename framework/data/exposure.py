"""Exposure and device of photographs, as their files state them: EXIF, or a data format's own entries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.image_files import read_heif

MAKER, MODEL, DETAILS = 0x010F, 0x0110, 0x8769
"""EXIF tags of the device, and of the table that holds the following tags."""
SECONDS, F_NUMBER, ISO = 0x829A, 0x829D, 0x8827
"""EXIF tags of exposure time, f-number and sensitivity."""
MAX_STOPS = 10.0
"""Maximum distance from the median exposure of the images, stops. Beyond it a statement is not believed."""


@dataclass(frozen=True)
class Taken:
    """Exposure and device of a photograph."""

    stops: float = math.nan
    """Exposure: log2 of exposure time (s) times ISO sensitivity over squared f-number; NaN if unknown."""
    device: str = ""
    """Maker and model of the camera; empty if unknown."""

    @classmethod
    def of(cls, seconds: float, f_number: float, iso: float, device: str = "") -> Taken:
        """Return how a photograph was taken; the exposure is unknown unless all numbers are positive and finite.

        Args:
            seconds: exposure time.
            f_number: focal length over the diameter of the aperture.
            iso: sensitivity.
            device: maker and model.
        """
        if not all(0 < value < math.inf for value in (seconds, f_number, iso)):
            return cls(device=device)
        return cls(math.log2(seconds) + math.log2(iso) - 2 * math.log2(f_number), device)


def read_taken(paths: Sequence[Path]) -> tuple[Taken, ...]:
    """Read how photographs were taken from the EXIF of their files; unknown for files without or with damaged EXIF.

    Args:
        paths: image files; some may be missing.
    """
    with ThreadPoolExecutor() as pool:
        return tuple(track(pool.map(_read_exif, paths), "Reading exposures", total=len(paths)))


def exposures_of(taken: Sequence[Taken] | None) -> Tensor | None:
    """Return the exposure (M,) of images, in stops from their mean, 0 where unknown; None if none is known to differ.

    Args:
        taken: how each of M images was taken; None if unknown.
    """
    stops = torch.tensor([each.stops for each in taken or ()], dtype=torch.float64)
    known = stops.isfinite()
    if not bool(known.any()):
        return None
    known &= (stops - stops[known].median()).abs() <= MAX_STOPS
    exposures = torch.where(known, stops - stops[known].mean(), 0.0).float()
    return exposures if bool((exposures.abs() > 1e-6).any()) else None


def devices_of(taken: Sequence[Taken] | None, cameras: Cameras) -> Tensor | None:
    """Return the index (M,) int64 of the device that took each image; None if one took all.

    Images of one maker and model are by one device. If an image does not say, images are by one device if they have the
    same size and lens.

    Args:
        taken: how each of M images was taken; None if unknown.
        cameras: M cameras.
    """
    if taken and all(each.device for each in taken):
        names = sorted({each.device for each in taken})
        found = torch.tensor([names.index(each.device) for each in taken])
    else:
        c = cameras
        values = [c.fx, c.fy, c.cx, c.cy, c.widths, c.heights, *(() if c.lens is None else c.lens.unbind(-1))]
        lenses = torch.stack([value.cpu().float() for value in values], dim=-1)
        found = lenses.unique(dim=0, return_inverse=True)[1]
    return found if int(found.max()) > 0 else None


def _read_exif(path: Path) -> Taken:
    try:
        read_heif()
        with Image.open(path) as image:
            content = image.info.get("exif")  # `Image.getexif` would decode a PNG without it
        if not isinstance(content, bytes):
            return Taken()
        exif = Image.Exif()
        exif.load(content)
        details = exif.get_ifd(DETAILS)
        device = " ".join(f"{exif.get(tag, '')}".strip("\0 ") for tag in (MAKER, MODEL)).strip()
        seconds, f_number, iso = (_number(details.get(tag)) for tag in (SECONDS, F_NUMBER, ISO))
        return Taken.of(seconds, f_number, iso, device)
    except Exception:  # of any type, by missing files and by Pillow; a damaged image is reported when it is decoded
        return Taken()


def _number(value: Any) -> float:
    """Return an entry of EXIF as a number, the first of several; NaN if it is not one."""
    first = value[0] if isinstance(value, tuple) and value else value
    try:
        return float(first)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return math.nan
