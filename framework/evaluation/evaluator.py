"""One evaluator for every method: the same numbers at the end of training and from `ns-eval`."""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal

import torch
from torch import Tensor

from framework.base.config import AppearanceConfig
from framework.base.console import track
from framework.base.device import wait_for
from framework.base.errors import DataError
from framework.cameras.view import View, every
from framework.data.dataset import Dataset
from framework.data.pixels import composite
from framework.evaluation.appearance import appearance_of, fitted_appearance, right_half
from framework.evaluation.images import write_image
from framework.evaluation.metrics import load_lpips, psnr, ssim
from framework.evaluation.panels import composed, view_panels
from framework.model import Model
from framework.rendering.rendered import Picture

LONGEST_STEM = 150
"""Bytes of a photograph's name that its pictures are called by."""


def evaluation_background(model: Model) -> Tensor:
    """(3,) what training is over; white where that is random, but black where no photograph has alpha."""
    asked = model.config.background
    black = asked == "black" or (asked != "white" and not model.scene.has_alpha)
    return torch.full((3,), 0.0 if black else 1.0, device=model.device)


@dataclass(frozen=True)
class Measured:
    """How near a picture comes to its photograph."""

    psnr: float
    """dB."""
    ssim: float | None
    """None for a picture that is smaller than SSIM's window."""


def measure(rgb: Tensor, target: Tensor, kept: Tensor | None) -> Measured:
    """PSNR of the kept pixels; SSIM of the whole, in which the rest should agree.

    Args:
        rgb, target: (H, W, 3) picture and photograph.
        kept: (H, W) bool which pixels count; all if None.
    """
    judged = (rgb, target) if kept is None else (rgb[kept], target[kept])
    return Measured(psnr(*judged), ssim(rgb, target) if min(rgb.shape[:2]) >= 11 else None)


def measure_view(model: Model, dataset: Dataset, index: int, background: Tensor, stride: int = 1) -> Measured:
    """How near the picture of view `index` comes to its photograph, of every `stride`-th row and column of both."""
    target = composite(every(dataset.image(index), stride).float() / 255, background)
    kept = dataset.kept_of(index)
    rgb = model.render_view(dataset.view(index, stride), background).rgb.clamp(0, 1)
    (rgb, target), kept = _judged(rgb, target, None if kept is None else every(kept, stride), half=False)
    return measure(rgb, target, kept)


def views_to_judge(dataset: Dataset, half: bool = False) -> list[int]:
    """The views of which masks leave something to judge.

    Args:
        half: whether only the right half counts.
    """
    return [index for index in range(len(dataset)) if _shows_something(dataset, index, half)]


def timed_view(model: Model, view: View, background: Tensor) -> tuple[Picture, float]:
    """Render a view; return the picture, and the seconds that it took.

    Args:
        model: the trained model.
        view: the camera, on the model's device.
        background: (3,) colour behind what is not opaque.
    """
    start = time.perf_counter()
    picture = model.render_view(view, background)
    wait_for(model.device)
    return picture, time.perf_counter() - start


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found."""

    per_image: list[dict[str, Any]]
    """name, psnr, ssim and lpips of each image."""
    results: dict[str, Any]
    """Means, standard deviations and speed, under nerfstudio's keys."""
    lpips_note: str
    """Which LPIPS was used, or why none."""
    eval_appearance: Literal["mean", "half"] | None = None
    """How held-out photographs were given an appearance; None for a method without."""
    pictures_note: str | None = None
    """Why pictures are missing, where they could not be written."""

    def line(self) -> str:
        """The results in a line."""
        r = self.results
        ssim, lpips = ("absent" if r[name] is None else f"{r[name]:.4f}" for name in ("ssim", "lpips"))
        return (
            f"PSNR {r['psnr']:.2f} dB  SSIM {ssim}  LPIPS {lpips}  "
            f"{r['num_rays_per_sec'] / 1e3:.1f}k rays/s  {1 / r['fps']:.2f} s/image  ({r['num_images']} images)"
        )


def evaluate(
    model: Model,
    dataset: Dataset,
    *,
    max_images: int | None = None,
    pictures: Path | None = None,
    max_pictures: int | None = None,
    round_to_uint8: bool = False,
    title: str = "Evaluating",
) -> Evaluation:
    """Render views and compare them with their photographs.

    What masks ignore does not count: PSNR is that of the other pixels, and for SSIM and LPIPS, which look at
    surroundings, the picture takes the photograph's own colours there. A photograph of which nothing is left is passed
    over. Where a method has appearance vectors and `eval_appearance` says so, only the right half counts.

    Args:
        model: the trained model.
        dataset: views with photographs, on the model's device.
        max_images: at most this many views, evenly spread; all if None.
        pictures: folder for renders, their photographs, comparisons (photograph, render, error, depth, opacity), and
            normals where there are any, red, green and blue being x, y and z from -1 to 1; none if None.
        max_pictures: write only the first so many.
        round_to_uint8: measure the picture as it would be stored.
    Raises: DataError where there is nothing to evaluate.
    """
    has_appearance = appearance_of(model) is not None
    half = has_appearance and isinstance(model.config, AppearanceConfig) and model.config.eval_appearance == "half"
    shown = views_to_judge(dataset, half)
    chosen = [shown[place] for place in spread(len(shown), max_images)]
    if not chosen:
        raise DataError(f"there is no image to evaluate: masks leave nothing of the {len(dataset)} that there are")
    lpips, lpips_note = load_lpips()
    background = evaluation_background(model)
    rows, seconds, rays = [], 0.0, 0
    pictures_note: str | None = None
    for index in track(chosen, title, total=len(chosen)):
        target = composite(dataset.image(index).float() / 255, background)
        with fitted_appearance(model, dataset, index, background) if half else nullcontext():
            picture, spent = timed_view(model, dataset.view(index), background)
        rgb = picture.rgb.clamp(0, 1)
        if round_to_uint8:
            rgb = (rgb * 255).round() / 255
        found, kept = _judged(rgb, target, dataset.kept_of(index), half)
        measured = measure(*found, kept)
        rows.append(
            {
                "name": dataset.names[index],
                "psnr": measured.psnr,
                "ssim": measured.ssim,
                "lpips": None if lpips is None else lpips(*found),
                "seconds": spent,
            }
        )
        seconds += spent
        rays += picture.num_rays
        if pictures is not None and (max_pictures is None or len(rows) <= max_pictures):
            try:
                _write_pictures(pictures, f"{index:04d}_{_short_stem(dataset.names[index])}", rgb, target, picture)
            except OSError as error:  # the figures are worth more
                pictures, pictures_note = None, f"cannot write pictures to {pictures}: {error.strerror or error}"
    results = {**_statistics(rows), "num_rays_per_sec": rays / seconds, "fps": len(rows) / seconds}
    protocol: Literal["mean", "half"] | None = ("half" if half else "mean") if has_appearance else None
    return Evaluation(rows, {**results, "num_images": len(rows)}, lpips_note, protocol, pictures_note)


def _write_pictures(folder: Path, stem: str, rgb: Tensor, target: Tensor, picture: Picture) -> None:
    """A view's picture, its photograph, both compared, and its normals. Raises: OSError as it comes."""
    write_image(folder / f"{stem}.png", rgb)
    write_image(folder / f"{stem}_photograph.png", target)
    panels = view_panels(rgb, target, picture.median_depth, picture.accumulation)
    write_image(folder / f"{stem}_comparison.png", composed(panels))
    if picture.normals is not None:
        write_image(folder / f"{stem}_normals.png", (picture.normals + 1) / 2)


def _short_stem(name: str) -> str:
    """A photograph's name without its ending, so short that something may stand before and behind it."""
    return os.fsencode(Path(name).stem)[:LONGEST_STEM].decode("utf-8", "ignore")


def _judged(
    rgb: Tensor, target: Tensor, kept: Tensor | None, half: bool
) -> tuple[tuple[Tensor, Tensor], Tensor | None]:
    """Picture and photograph as metrics see them, and which of their pixels count (None for all)."""
    if half:
        rgb, target = right_half(rgb), right_half(target)
        kept = None if kept is None else right_half(kept)
    return (rgb if kept is None else torch.where(kept[..., None], rgb, target), target), kept


def _shows_something(dataset: Dataset, index: int, half: bool) -> bool:
    """Whether masks leave any of what is judged of an image."""
    kept = dataset.kept_of(index)
    return kept is None or bool((right_half(kept) if half else kept).any())


def spread(total: int, limit: int | None) -> list[int]:
    """At most `limit` of the numbers 0 .. total - 1, evenly spread."""
    if limit is None or limit >= total:
        return list(range(total))
    return [index * total // limit for index in range(limit)]


def _statistics(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """Mean and standard deviation of each metric; None where it is absent."""
    out: dict[str, float | None] = {}
    for name in ("psnr", "ssim", "lpips"):
        values = [row[name] for row in rows if row[name] is not None]
        out[name] = fmean(values) if values else None
        out[f"{name}_std"] = (stdev(values) if len(values) > 1 else 0.0) if values else None
    return out
