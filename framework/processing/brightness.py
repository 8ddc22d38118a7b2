"""Brightness of images of any mode: conversion to 8 bits, range of brightness, and stretching of that range."""

from __future__ import annotations

import numpy as np
from PIL import Image

from nerfloom.base.errors import DataError

SAMPLES = 500
"""Number of rows and columns sampled to measure the range."""
ENDS = (1.0, 99.0)
"""Percentiles that define the range of brightness, so that single bright pixels do not count."""


def eight_bits(image: Image.Image) -> Image.Image:
    """Convert an `image` of any mode to RGB, or to RGBA if a pixel is transparent.

    Raises:
        DataError: for floating-point images, because their white level is unknown.
    """
    if image.mode == "F":
        raise DataError("floating-point pixels; convert it to an 8-bit PNG")
    if image.mode.startswith("I"):  # grey with 16 bits
        deep = np.asarray(image).astype(np.float64)
        return Image.fromarray((deep / 257).round().clip(0, 255).astype(np.uint8)).convert("RGB")
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info:
        rgba = image.convert("RGBA")
        return rgba if (np.asarray(rgba)[..., 3] < 255).any() else rgba.convert("RGB")
    return image.convert("RGB")


def tones(image: Image.Image) -> tuple[float, float]:
    """Return the ends of the range of brightness, from 0 to 1, of an `image` of any mode but floating point."""
    levels, top = _levels(image)
    step = max(min(levels.shape) // SAMPLES, 1)
    low, high = np.percentile(levels[::step, ::step], ENDS)
    return float(low) / top, float(high) / top


def stretched(image: Image.Image) -> Image.Image:
    """Return an `image`'s brightness with its range stretched to 0 to 255, in 8 bits; 16 bits are rounded last."""
    levels, top = _levels(image)
    low, high = (end * top for end in tones(image))
    return Image.fromarray(((levels - low) / max(high - low, 1e-9) * 255).round().clip(0, 255).astype(np.uint8))


def _levels(image: Image.Image) -> tuple[np.ndarray, float]:
    """Return the brightness (H, W) of an image in whole numbers, and the number for white."""
    if image.mode.startswith("I"):
        return np.asarray(image), 65535.0
    return np.asarray(eight_bits(image).convert("L")), 255.0
