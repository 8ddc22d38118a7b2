"""Statistics of the metrics of a set of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any

Rows = Sequence[dict[str, Any]]
"""Reports on images (`Evaluation.per_image`)."""


def statistics(rows: Rows) -> dict[str, Any]:
    """Return the statistics of all images of `rows` and, as `by_size`, of each image size if there are several.

    Returns:
        For each metric its mean, standard deviation (`_std`) and, unless every image has it, number of images
        (`_images`); None for absent values. Also the numbers of counted and of masked pixels.
    """
    pixels = {f"num_{name}": sum(row[name] for row in rows) for name in ("pixels", "ignored_pixels")}
    return {**_of_metrics(rows), **pixels, **_by_size(rows)}


def _by_size(rows: Rows) -> dict[str, Any]:
    """Return the statistics of images of each size, "1", "1/2", ..., as `by_size`; empty if all have one size."""
    sizes = sorted({row["reduction"] for row in rows if "reduction" in row})
    names = {size: "1" if size == 1 else f"1/{size}" for size in sizes}
    found = {names[size]: _of_metrics([row for row in rows if row["reduction"] == size]) for size in sizes}
    return {"by_size": found} if found else {}


def _of_metrics(rows: Rows) -> dict[str, float | None]:
    """Return the mean, the standard deviation and the number of images of each metric."""
    found: dict[str, float | None] = {}
    for name in ("psnr", "ssim", "ms_ssim", "lpips", "floaters", "normal_mae", "diffuse_psnr"):
        values = [row[name] for row in rows if row[name] is not None]
        found[name] = fmean(values) if values else None
        found[f"{name}_std"] = _deviation(values) if values else None
        if name != "psnr":  # every image has one
            found[f"{name}_images"] = len(values)
    return found


def _deviation(values: list[float]) -> float:
    """Return the standard deviation; NaN if a value is not finite (`stdev` would raise an error)."""
    if not all(map(math.isfinite, values)):
        return math.nan
    return stdev(values) if len(values) > 1 else 0.0
