"""PSNR and learning curve of a run, read from its folder."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from nerfloom.training.loaded import Loaded
from nerfloom.viewer.markdown import plain

MAX_REPORT = 2**24
"""Maximum size of a report, bytes."""


def heading(loaded: Loaded) -> str:
    """Return the method, the folder or file, the step and the PSNR of `loaded` as Markdown."""
    step = f" · step {loaded.step:,}" if loaded.is_run else ""
    lines = [f"**{plain(loaded.method)}** · {plain(loaded.origin.name)}{step}"]
    origin = loaded.origin
    content = _read(origin / "eval.json" if loaded.is_run else origin.with_suffix(".eval.json"))
    results = content.get("results") if isinstance(content, dict) else None
    if isinstance(results, dict) and (psnr := _finite(results.get("psnr"))) is not None:
        images = results.get("num_images")
        lines.append(f"PSNR {psnr:.2f} dB" + (f" on {images} images" if isinstance(images, int) else ""))
    return "  \n".join(lines)


def curve(folder: Path) -> tuple[list[float], list[float]]:
    """Return training seconds and PSNR of held-out images, dB, of the run in `folder`, by time; possibly none."""
    content = _read(folder / "learning_curve.json")
    points = []
    for row in content if isinstance(content, list) else ():
        if isinstance(row, dict):
            seconds, psnr = _finite(row.get("seconds")), _finite(row.get("psnr"))
            if seconds is not None and psnr is not None:
                points.append((seconds, psnr))
    points.sort()
    return [seconds for seconds, _ in points], [psnr for _, psnr in points]


def _read(path: Path) -> Any:
    try:
        if path.stat().st_size > MAX_REPORT:
            return None
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _finite(value: Any) -> float | None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < 1e30 and math.isfinite(value) else None
