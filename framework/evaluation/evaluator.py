"""One evaluator for every method: the same numbers at the end of training and from `ns-eval`."""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal

import torch
from torch import Tensor

from framework.base.console import track
from framework.base.device import has_bfloat16, wait_for
from framework.base.errors import DataError
from framework.cameras.cameras import Cameras, subpixels
from framework.data.dataset import Dataset
from framework.data.pixels import composite
from framework.evaluation.appearance import appearances, fitted_appearance, right_half
from framework.evaluation.images import write_image
from framework.evaluation.metrics import load_lpips, psnr, ssim
from framework.evaluation.panels import composed, view_panels
from framework.kernels.math import safe_normalize
from framework.kernels.native import torch_on_one_thread
from framework.model import Model

LONGEST_STEM = 150
"""Bytes of a photograph's name that its pictures are called by."""


@dataclass(frozen=True)
class RenderedImage:
    """A whole picture."""

    rgb: Tensor
    """(H, W, 3)."""
    depth: Tensor
    """(H, W) median distance along the ray, scene units."""
    accumulation: Tensor
    """(H, W) opacity."""
    seconds: float
    """Time it took."""
    normals: Tensor | None = None
    """(H, W, 3) unit directions away from surfaces, scene coordinates, of a method that has them."""


@torch.no_grad()
def render_image(
    model: Model, cameras: Cameras, index: int, background: Tensor, times: Tensor | None = None, stride: int = 1
) -> RenderedImage:
    """What camera `index` sees, a chunk of pixels at a time, each the mean of `rays_per_pixel` rays.

    Args:
        model: in any mode; it is put into evaluation mode and back.
        cameras: on the model's device.
        background: (3,) colour behind what is not opaque.
        times: (M,) time of each camera.
        stride: only every so many-th row and column of the pixels; H and W are then what remains.
    """
    was_training, scene, per_pixel = model.training, model.scene, model.config.rays_per_pixel
    places = subpixels(per_pixel)
    model.eval()
    start = time.perf_counter()
    parts, normals = [], []
    with (
        torch_on_one_thread(model.runs_on_kernels),
        torch.autocast(model.device.type, torch.bfloat16, enabled=use_bfloat16(model)),
    ):
        grid = every(cameras.image_pixels(index).view(int(cameras.heights[index]), -1), stride)
        for pixels in grid.reshape(-1).split(max(model.config.eval_num_rays_per_chunk // per_pixel, 1)):
            rays = cameras.pixel_rays(pixels, scene.near, scene.far, times, places)
            # The number of a camera that is not a training camera must not be taken for one's.
            out = model.render(replace(rays, camera_indices=None), background).per_pixel(per_pixel)
            parts.append((out.rgb.float(), out.median_depth.float(), out.accumulation.float()))
            normals += [] if out.normals is None else [safe_normalize(out.normals.float())]
    wait_for(model.device)
    seconds = time.perf_counter() - start
    model.train(was_training)
    rgb, depth, accumulation = (torch.cat(column) for column in zip(*parts, strict=True))
    facing = torch.cat(normals).view(*grid.shape, 3) if normals else None
    return RenderedImage(
        rgb.view(*grid.shape, 3), depth.view(grid.shape), accumulation.view(grid.shape), seconds, facing
    )


def every(image: Tensor, stride: int) -> Tensor:
    """Every `stride`-th row and column of an image (H, W, ...), the first being at half of the stride."""
    return image[stride // 2 :: stride, stride // 2 :: stride]


def use_bfloat16(model: Model) -> bool:
    """The run's precision: as configured, else as the device allows."""
    chosen = model.config.mixed_precision
    return has_bfloat16(model.device) if chosen is None else chosen


def render_view(model: Model, dataset: Dataset, index: int, background: Tensor, stride: int = 1) -> RenderedImage:
    """The model's picture of the data set's view `index`, with the appearance meant for evaluation."""
    return render_image(model, dataset.cameras, index, background, dataset.times, stride)


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
    rgb = render_view(model, dataset, index, background, stride).rgb.clamp(0, 1)
    (rgb, target), kept = _judged(rgb, target, None if kept is None else every(kept, stride), half=False)
    return measure(rgb, target, kept)


def views_to_judge(dataset: Dataset, half: bool = False) -> list[int]:
    """The views of which masks leave something to judge.

    Args:
        half: whether only the right half counts.
    """
    return [index for index in range(len(dataset)) if _shows_something(dataset, index, half)]


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
    half = model.config.eval_appearance == "half" and bool(appearances(model))
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
            view = render_view(model, dataset, index, background)
        rgb = view.rgb.clamp(0, 1)
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
                "seconds": view.seconds,
            }
        )
        seconds += view.seconds
        rays += rgb.shape[0] * rgb.shape[1] * model.config.rays_per_pixel
        if pictures is not None and (max_pictures is None or len(rows) <= max_pictures):
            try:
                _write_pictures(pictures, f"{index:04d}_{_short_stem(dataset.names[index])}", rgb, target, view)
            except OSError as error:  # the figures are worth more
                pictures, pictures_note = None, f"cannot write pictures to {pictures}: {error.strerror or error}"
    results = {**_statistics(rows), "num_rays_per_sec": rays / seconds, "fps": len(rows) / seconds}
    protocol: Literal["mean", "half"] | None = ("half" if half else "mean") if appearances(model) else None
    return Evaluation(rows, {**results, "num_images": len(rows)}, lpips_note, protocol, pictures_note)


def _write_pictures(folder: Path, stem: str, rgb: Tensor, target: Tensor, view: RenderedImage) -> None:
    """A view's picture, its photograph, both compared, and its normals. Raises: OSError as it comes."""
    write_image(folder / f"{stem}.png", rgb)
    write_image(folder / f"{stem}_photograph.png", target)
    write_image(folder / f"{stem}_comparison.png", composed(view_panels(rgb, target, view.depth, view.accumulation)))
    if view.normals is not None:
        write_image(folder / f"{stem}_normals.png", (view.normals + 1) / 2)


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
