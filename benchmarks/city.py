"""A city in blocks on paper: sizes, messages and times from a few inputs, by formulas, and from measured results.

Block-NeRF (Tancik et al. 2022) built a neighbourhood of 2.8 million images. Nothing here is measured at that size.
Values that depend on speed use results of this package at a small size. Where there is no result, none is shown.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from nerfloom.base.errors import FlagError

METHOD = "nerfacto"
"""Method of the blocks with the results used."""
RENDERED = 200 * 200
"""Number of pixels of the pictures in methods-procedural.json."""


@dataclass(frozen=True)
class City:
    """The inputs."""

    images: int = 2_800_000
    """Number of training images."""
    blocks: int = 100
    """Number of blocks."""
    overlap: float = 0.5
    """Share of a block's extent that it has in common with the next one, along two axes."""
    width: int = 1280
    """Width of an image, pixels."""
    height: int = 720
    """Height of an image, pixels."""
    image_bytes: int = 300_000
    """Size of an image's file, bytes."""
    seconds: float = 600.0
    """Seconds of training of a block."""
    workers: int = 10
    """Number of blocks that are trained at a time."""
    gaussians: int = 5_000_000
    """Number of Gaussians of a block of splats."""

    def __post_init__(self) -> None:
        if not 0 <= self.overlap < 1:
            raise FlagError(f"--overlap is {self.overlap:g}; it must be at least 0 and less than 1")
        for name in (field.name for field in fields(City) if field.name != "overlap"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise FlagError(f"--{name.replace('_', '-')} is {value:g}; it must be above zero and finite")


class Constants(NamedTuple):
    """Constants of the package."""

    kept: int
    """Maximum number of blocks in memory."""
    small: int
    """Minimum length of the longer side of the small pictures of training images, pixels."""
    looked: int
    """Number of training images that a visibility network learns from."""
    matched: int
    """Maximum number of shared images that match the colours of two blocks."""
    coarse: int
    """Shorter side of the picture with rays for visibility, pixels."""
    shares: int
    """Number of points along such a ray."""
    network: int
    """Number of parameters of a visibility network."""
    row: int
    """Size of a Gaussian in a file of levels with numbers of 32 bits, bytes."""
    short_row: int
    """The same with numbers of 16 bits."""
    stored: int
    """Size of a Gaussian in training with a memory limit, bytes."""


@dataclass(frozen=True)
class Measured:
    """Measured values; NaN if there is no result."""

    rays: float = math.nan
    """Rays of training per second."""
    pixels: float = math.nan
    """Pixels of pictures per second."""
    parameters: float = math.nan
    """Parameters of a block."""
    network_seconds: float = math.nan
    """Seconds of a visibility network, with its pictures."""
    levels_seconds: float = math.nan
    """Seconds of building levels of a million Gaussians."""
    levels_frames: float = math.nan
    """Pictures of levels per second at 1280 x 720."""


class Row(NamedTuple):
    """A row of the table."""

    what: str
    formula: str
    value: str


def constants() -> Constants:
    """Return the constants of the package."""
    from nerfloom.blocks.composed import KEPT, LOOK_SIDE
    from nerfloom.blocks.matching import MAX_VIEWS
    from nerfloom.blocks.visibility import SHARES, WIDTHS
    from nerfloom.levels.files import row_size
    from nerfloom.training.block_visibility import MAX_SIGHTS, SIDE

    network, row = sum((before + 1) * after for before, after in pairwise(WIDTHS)), row_size(3, 32)
    stored = 3 * row + 4 * 6  # parameters and two moments, and the counts of updates of six columns
    return Constants(
        KEPT, SIDE, MAX_SIGHTS, MAX_VIEWS, LOOK_SIDE, len(SHARES), network, row, row_size(3, 16), stored
    )  # fmt: skip


def measured(results: Path) -> Measured:
    """Return the measured values in a folder of results.

    Args:
        results: folder with methods-procedural.json (`ns-bench methods`) and city.json. Each file may be missing.
            Values in city.json have the names of `Measured` and take precedence.
    """
    runs = _read(results / "methods-procedural.json").get("runs", [])
    own: dict[str, Any] = next((run for run in runs if run["method"] == METHOD), {})
    found = {
        "rays": own.get("rays_per_second", math.nan),
        "pixels": RENDERED / own.get("render_seconds", math.nan),
        "parameters": own.get("parameters", math.nan),
    } | _read(results / "city.json")
    return Measured(**{field.name: float(found.get(field.name, math.nan)) for field in fields(Measured)})


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def rows(c: City, k: Constants, m: Measured) -> list[Row]:
    """Return the rows of the table for the inputs `c`, the constants `k` of the package, and measured values `m`."""
    times = 1 / (1 - c.overlap) ** 2  # blocks in a plane overlap along two axes
    own, picture, digits = c.images / c.blocks * times, c.width * c.height, len(str(c.images - 1))
    small = _kept(c, max(c.width, c.height) // k.small)
    coarse = _kept(c, min(c.width, c.height) // k.coarse)
    gaussians = c.blocks * c.gaussians
    return [
        Row("images of a block", "m = M / B / (1 - o)^2", _count(own)),
        Row("blocks of an image", "1 / (1 - o)^2", _count(times)),
        Row("image files", "M f", _size(c.images * c.image_bytes)),
        Row("image files that all workers read", "M f / (1 - o)^2", _size(c.images * c.image_bytes * times)),
        Row("decoded pixels of a block", "3 m w h", _size(3 * own * picture)),
        Row("time of training", "B S / W", _time(c.blocks * c.seconds / c.workers)),
        Row("machine time of training", "B S", _time(c.blocks * c.seconds)),
        Row("rays of a block's training", "r S", _count(m.rays * c.seconds)),
        Row("time for one ray through each pixel of a block", "m w h / r", _time(own * picture / m.rays)),
        Row("`recipe.json` of a block", f"{digits + 6} m", _size(own * (digits + 6))),
        Row("`plan.json`", f"{digits + 8} m B", _size(own * c.blocks * (digits + 8))),
        Row("`blocks.yml`", f"{digits + 2} m B", _size(own * c.blocks * (digits + 2))),
        Row("two checkpoints of a block", "24 P", _size(24 * m.parameters)),
        Row("checkpoints of all blocks", "24 P B", _size(24 * m.parameters * c.blocks)),
        Row("models in memory for pictures", f"{k.kept} x 4 P", _size(4 * k.kept * m.parameters)),
        Row("visibility networks", f"{4 * k.network:,} B", _size(4 * k.network * c.blocks)),
        Row("pictures for them", f"{k.looked} x {small:,} B / q", _time(k.looked * small * c.blocks / m.pixels)),
        Row("visibility networks, with pictures and training", "B v", _time(c.blocks * m.network_seconds)),
        Row(
            "pictures for matching colours",
            f"2 x {k.matched} x {small:,} (B - 1) / q",
            _time(2 * k.matched * small * (c.blocks - 1) / m.pixels),
        ),
        Row("points for the visibility of a view", f"{k.shares} x {coarse:,}", _count(k.shares * coarse)),
        Row("picture of one block", "w h / q", _time(picture / m.pixels)),
        Row(f"picture of {k.kept} blocks", f"{k.kept} w h / q", _time(k.kept * picture / m.pixels)),
        Row("Gaussians of blocks of splats", "B G", _count(gaussians)),
        Row("files of a block in training with `--memory-limit`", f"{k.stored} G", _size(k.stored * c.gaussians)),
        Row("`.levels` file", f"2 x {k.row} B G", _size(2 * k.row * gaussians)),
        Row("`.levels` file with `--bits 16`", f"2 x {k.short_row} B G", _size(2 * k.short_row * gaussians)),
        Row("time of building levels", "B G l / 10^6", _time(gaussians / 1e6 * m.levels_seconds)),
        Row("pictures of levels per second", "none", _count(m.levels_frames)),
    ]  # fmt: skip


def _kept(c: City, stride: int) -> int:
    """Return the number of pixels of an image with rows and columns `stride` pixels apart."""
    return math.prod(len(range(stride // 2, side, stride)) for side in (c.width, c.height))


def _count(value: float) -> str:
    return _known(value, f"{value:,.0f}" if value >= 100 else f"{value:.3g}")


def _size(value: float) -> str:
    """Return bytes as text with three digits."""
    unit = next((unit for unit in ("TB", "GB", "MB", "kB") if value >= _BYTES[unit]), "B")
    return _known(value, f"{value / _BYTES[unit]:.3g} {unit}")


_BYTES = {"TB": 1e12, "GB": 1e9, "MB": 1e6, "kB": 1e3, "B": 1.0}


def _time(value: float) -> str:
    """Return seconds as text with three digits."""
    unit = next((unit for unit in ("days", "h", "min") if value >= 2 * _SECONDS[unit]), "s")
    return _known(value, f"{value / _SECONDS[unit]:.3g} {unit}")


_SECONDS = {"days": 86_400.0, "h": 3_600.0, "min": 60.0, "s": 1.0}


def _known(value: float, text: str) -> str:
    return "not measured" if math.isnan(value) else text


def markdown(c: City, k: Constants, m: Measured) -> str:
    """Return the inputs and the rows as two tables in Markdown; `c`, `k` and `m` are as in `rows`."""
    per_second = (("r", "rays of training per second", m.rays), ("q", "pixels of pictures per second", m.pixels))
    inputs = [
        ("M", "images", _count(c.images)),
        ("B", "blocks", _count(c.blocks)),
        ("o", "`--overlap`, along each of two axes", f"{c.overlap:g}"),
        ("w, h", "width and height of an image, pixels", f"{c.width}, {c.height}"),
        ("f", "file of an image", _size(c.image_bytes)),
        ("S", "training of a block", _time(c.seconds)),
        ("W", "workers", _count(c.workers)),
        ("G", "Gaussians of a block of splats", _count(c.gaussians)),
        *((letter, f"{what}, `{METHOD}` on two cores", _count(value)) for letter, what, value in per_second),
        ("P", f"parameters of a block of `{METHOD}`", _count(m.parameters)),
        ("v", "seconds of a visibility network, with its pictures", _count(m.network_seconds)),
        ("l", "seconds of building levels of a million Gaussians", _count(m.levels_seconds)),
    ]
    first = ["| | input | value |", "|---|---|---|", *(f"| {' | '.join(each)} |" for each in inputs)]
    second = ["| | formula | value |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows(c, k, m))]
    return "\n".join([*first, "", *second])
