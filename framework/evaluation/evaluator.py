"""The evaluator of every method, used at the end of training and by `ns-eval`."""

from __future__ import annotations

import math
import os
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
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
from framework.evaluation.lpips import NETWORK, SMALLEST_OF_LPIPS, Lpips, load_lpips
from framework.evaluation.metrics import SMALLEST_OF_SCALES, ms_ssim, psnr, quick_ssim
from framework.evaluation.panels import composed, view_panels
from framework.evaluation.statistics import statistics
from framework.kernels.ssim import WINDOW
from framework.model import Model, RendersFromImages
from framework.rendering.rendered import Picture

BEFORE = 0.9
"""Share of a sparse point's distance before which a view that sees the point should show nothing."""
FAR_BELOW, MOST_NAMED = 3.0, 3
"""Distance from the mean PSNR, dB, from which a view is named, and the maximum number of views that are."""
WORST = "worst"
"""Name, without suffix, of the files of the view with the lowest PSNR; the next evaluation overwrites them."""
MASKED = (
    "PSNR is of kept pixels, SSIM and MS-SSIM are of windows without ignored pixels, LPIPS is the mean of its map over "
    "kept pixels, for which ignored pixels are copied from the true image"
)
"""What is measured of images of which masks ignore pixels."""
LONGEST_STEM = 150
"""Maximum number of bytes of an image's name in the names of the files written for it."""


def evaluation_background(model: Model) -> Tensor:
    """Return the background colour (3,) of an evaluation of `model`.

    It is that of training; if that is random or automatic, white, or black if no image has alpha.
    """
    asked = model.config.background
    black = asked == "black" or (asked != "white" and not model.scene.has_alpha)
    return torch.full((3,), 0.0 if black else 1.0, device=model.device)


@dataclass(frozen=True)
class Measured:
    """Metrics of a rendered image."""

    psnr: float
    """Peak signal-to-noise ratio, dB."""
    ssim: float | None
    """Structural similarity; None if no window of SSIM lies inside what counts."""


def measure(rgb: Tensor, target: Tensor, kept: Tensor | None) -> Measured:
    """Compute the PSNR of the kept pixels, and the SSIM over the windows that have no other pixels.

    Args:
        rgb, target: (H, W, 3) rendered and true image in [0, 1].
        kept: (H, W) bool, pixels that count; all if None.
    """
    judged = (rgb, target) if kept is None else (rgb[kept], target[kept])
    return Measured(psnr(*judged), quick_ssim(rgb, target, kept) if min(rgb.shape[:2]) >= WINDOW else None)


def measure_view(model: Model, dataset: Dataset, index: int, background: Tensor, stride: int = 1) -> Measured:
    """Render a view and compute its metrics.

    Args:
        model: the trained model.
        dataset: views with images, on the model's device.
        index: index of the view.
        background: (3,) colour behind transparent pixels.
        stride: distance between rendered rows and columns, pixels.
    """
    target = composite(every(dataset.image(index), stride).float() / 255, background)
    kept = dataset.kept_of(index)
    rgb = model.render_rgb(dataset.view(index, stride), background).clamp(0, 1)
    (rgb, target), kept = _judged(rgb, target, None if kept is None else every(kept, stride), half=False)
    return measure(rgb, target, kept)


def views_to_judge(dataset: Dataset, half: bool = False) -> list[int]:
    """Return the indices of the images of which masks keep some pixels, and that are not given to a method.

    Args:
        dataset: the images.
        half: whether only the right half counts.
    """
    given = dataset.source_images
    judged = range(len(dataset)) if given is None else (~given).nonzero()[:, 0].tolist()
    return [index for index in judged if _has_kept_pixels(dataset, index, half)]


def timed_view(model: Model, view: View, background: Tensor) -> tuple[Picture, float]:
    """Render a view; return the rendered image and the seconds that it took.

    Args:
        model: the trained model.
        view: the view, on the model's device.
        background: (3,) colour behind transparent pixels.
    """
    start = time.perf_counter()
    picture = model.render_view(view, background)
    wait_for(model.device)
    return picture, time.perf_counter() - start


def floaters(picture: Picture, dataset: Dataset, index: int) -> float | None:
    """Return the share, in per cent, of the sparse points that a view sees with something before them.

    These are the points that a reconstruction's tracks say the image sees, and whose pixel's median depth is less than
    `BEFORE` of their distance: so half of the pixel's light is stopped in space that the image shows to be empty. This
    is defined for every method that renders depth.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.

    Returns:
        The share; None if the image sees no point whose distance is known well enough.
    """
    if dataset.sparse_depth is None:
        return None
    start, end = dataset.cameras.ends[index : index + 2]
    pixels = dataset.sparse_depth.pixels
    known = dataset.sparse_depth[(pixels >= start) & (pixels < end)]
    known = known[known.deviations < (1 - BEFORE) / 3 * known.distances]
    if not len(known):
        return None
    before = picture.median_depth.reshape(-1)[known.pixels - start] < BEFORE * known.distances
    return 100 * before.float().mean().item()


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a set of images."""

    per_image: list[dict[str, Any]]
    """Name, psnr, ssim, ms_ssim, lpips, floaters and rendering seconds of each image, the number of pixels that count
    and that masks ignore, and its reduction if images have several sizes."""
    results: dict[str, Any]
    """Means, standard deviations and rendering speed, with nerfstudio's keys; the number of images that each mean is
    over; the numbers of pixels that count and that masks ignore; by_size, the statistics of images of each size."""
    lpips_note: str
    """Network of LPIPS and source of its weights, or the reason why it is absent."""
    eval_appearance: Literal["mean", "half"] | None = None
    """Source of the held-out images' appearance; None if the method has none."""
    pictures_note: str | None = None
    """Reason why rendered images could not be written; None if there is none."""

    @property
    def warning(self) -> str | None:
        """The warning that some rendered images are not finite; None if all are finite."""
        bad = [row["name"] for row in self.per_image if not math.isfinite(row["psnr"])]
        if not bad:
            return None
        return (
            f"{len(bad)} of {len(self.per_image)} rendered images are not finite, first {bad[0]}: their metrics are "
            "null, and so are the means; see whether a pose of the data or the checkpoint is, or evaluate an older "
            "checkpoint (ns-eval --load-checkpoint)"
        )

    @property
    def masks_note(self) -> str | None:
        """The text that says what is measured of masked images; None if all pixels count."""
        if not self.results["num_ignored_pixels"]:
            return None
        images = self.results["num_images"]
        lacking = {name: images - self.results[f"{name}_images"] for name in ("ssim", "ms_ssim")}
        absent = [f"{number} of {images} images have no {name}" for name, number in lacking.items() if number]
        return MASKED + (f"; {' and '.join(absent)}: no such window" if absent else "")

    @property
    def far_below(self) -> str | None:
        """The views whose PSNR is `FAR_BELOW` or more below the mean, worst first, as text; None if there is none."""
        mean = self.results["psnr"]
        low = sorted((row for row in self.per_image if row["psnr"] <= mean - FAR_BELOW), key=lambda row: row["psnr"])
        if not low:
            return None
        named = ", ".join(f"{row['name']} {row['psnr']:.2f} dB" for row in low[:MOST_NAMED])
        return f"far below the mean: {named}" + (f", and {len(low) - MOST_NAMED} more" if len(low) > MOST_NAMED else "")

    def line(self) -> str:
        """Return the results as a line of text."""
        r = self.results
        ssim, scales, lpips = (self._mean(name) for name in ("ssim", "ms_ssim", "lpips"))
        scales = "" if r["ms_ssim"] is None and not r["num_ignored_pixels"] else f"  MS-SSIM {scales}"
        before = "" if r["floaters"] is None else f"  floaters {r['floaters']:.1f} %"
        rays = r["num_rays_per_sec"]
        speed = f"{rays / 1e3:.1f}k rays/s  {1 / r['fps']:.2f} s/image" if rays else f"{r['fps']:.1f} images/s"
        sizes = ", ".join(f"{size}: {found['psnr']:.2f}" for size, found in r.get("by_size", {}).items())
        sizes = f" ({sizes})" if sizes else ""
        quality = f"PSNR {r['psnr']:.2f} dB{sizes}  SSIM {ssim}{scales}  LPIPS ({NETWORK}) {lpips}{before}"
        kept, ignored = r["num_pixels"], r["num_ignored_pixels"]
        masks = f", {kept:,} pixels; masks ignore {ignored / (kept + ignored):.0%}" if ignored else ""
        return f"{quality}  {speed}  ({r['num_images']} images{masks})"

    def _mean(self, name: str) -> str:
        """Return a mean as text, with the number of images that it is over if others have no such value."""
        mean, images = self.results[name], self.results[f"{name}_images"]
        over = f" ({images} of {self.results['num_images']} images)" if images < self.results["num_images"] else ""
        return "absent" if mean is None else f"{mean:.4f}{over}"


def evaluate(
    model: Model,
    dataset: Dataset,
    *,
    max_images: int | None = None,
    pictures: Path | None = None,
    max_pictures: int | None = None,
    round_to_uint8: bool = False,
    lpips_weights: Path | None = None,
    title: str = "Evaluating",
) -> Evaluation:
    """Render views and compute their metrics.

    Images that are given to the method (`Dataset.source_images`) are shown to it and not judged. Masked-out pixels do
    not count: PSNR omits them, SSIM omits the windows that have any, at one scale and at five (`ms_ssim`), and LPIPS is
    the mean of its map over the others, for which masked-out pixels are copied from the true image. Images without
    other pixels are skipped. If appearance is fitted to left halves (`eval_appearance`), right halves count. An image
    has no SSIM if no window counts.

    Args:
        model: the trained model.
        dataset: views with images, on the model's device.
        max_images: maximum number of views, evenly spaced; all if None.
        pictures: folder for renders, true images, `view_panels` and normals (x, y, z as RGB); no files if None.
        max_pictures: maximum number of views of which files are written, evenly spaced; all if None. If that is some of
            them, files of the view with the lowest PSNR are written besides, as worst.png and so on.
        round_to_uint8: whether colours are rounded to 8 bits before they are measured.
        lpips_weights: file of LPIPS's weights; that of the model's settings if None.
        title: text of the progress bar.

    Raises:
        ConfigError: if the file of weights cannot be used.
        DataError: if there is no image to evaluate.
    """
    has_appearance = appearance_of(model) is not None
    half = has_appearance and isinstance(model.config, AppearanceConfig) and model.config.eval_appearance == "half"
    views = views_to_judge(dataset, half)
    chosen = [views[rank] for rank in spread(len(views), max_images)]
    if not chosen:
        raise DataError(f"there is no image to evaluate: masks leave nothing of the {len(dataset)} that there are")
    if isinstance(model, RendersFromImages) and dataset.source_images is not None:
        model.show_images(dataset)
    lpips, lpips_note = load_lpips(lpips_weights or model.config.lpips_weights, model.device)
    background = evaluation_background(model)
    rows, seconds, rays = [], 0.0, 0
    pictures_note: str | None = None
    shown = {chosen[rank] for rank in spread(len(chosen), max_pictures)}
    marked = pictures is not None and 0 < len(shown) < len(chosen)
    lowest, worst = math.inf, None
    for index in track(chosen, title, total=len(chosen)):
        row, (rgb, target, picture) = _judge(model, dataset, index, background, half, round_to_uint8, lpips)
        rows.append(row)
        seconds += row["seconds"]
        rays += picture.num_rays
        if marked and row["psnr"] < lowest:
            lowest, worst = row["psnr"], (rgb, target, picture)
        if pictures is not None and index in shown and pictures_note is None:
            stem = f"{index:04d}_{_short_stem(dataset.names[index])}"
            pictures_note = _write_pictures(pictures, stem, rgb, target, picture)
    if pictures is not None and worst is not None and pictures_note is None:
        pictures_note = _write_pictures(pictures, WORST, *worst)
    speed = rays / seconds if rays else None  # None of a method that casts none
    results = {**statistics(rows), "num_rays_per_sec": speed, "fps": len(rows) / seconds}
    protocol: Literal["mean", "half"] | None = ("half" if half else "mean") if has_appearance else None
    return Evaluation(rows, {**results, "num_images": len(rows)}, lpips_note, protocol, pictures_note)


def _judge(
    model: Model,
    dataset: Dataset,
    index: int,
    background: Tensor,
    half: bool,
    round_to_uint8: bool,
    lpips: Lpips | None,
) -> tuple[dict[str, Any], tuple[Tensor, Tensor, Picture]]:
    """Return what is reported of a view, and its rendered image, true image and picture."""
    target = composite(dataset.image(index).float() / 255, background)
    with fitted_appearance(model, dataset, index, background) if half else nullcontext():
        picture, spent = timed_view(model, dataset.view(index), background)
    rgb = picture.rgb.clamp(0, 1)
    if round_to_uint8:
        rgb = (rgb * 255).round() / 255
    pair, kept = _judged(rgb, target, dataset.kept_of(index), half)
    row = _row(dataset, index, measure(*pair, kept), spent)
    smallest = min(pair[0].shape[:2])
    row["ms_ssim"] = None if smallest < SMALLEST_OF_SCALES else ms_ssim(*pair, kept)
    row["lpips"] = None if lpips is None or smallest < SMALLEST_OF_LPIPS else lpips(*pair, kept)
    row["pixels"] = pair[0][..., 0].numel() if kept is None else int(kept.sum())
    row["ignored_pixels"] = pair[0][..., 0].numel() - row["pixels"]
    return row | {"floaters": floaters(picture, dataset, index)}, (rgb, target, picture)


def _write_pictures(folder: Path, stem: str, rgb: Tensor, target: Tensor, picture: Picture) -> str | None:
    """Write a view's rendered image, true image, comparison and normals; return why that failed, None if it did not."""
    panels = view_panels(rgb, target, picture.median_depth, picture.accumulation)
    files = {"": rgb, "_photograph": target, "_comparison": composed(panels)}
    if picture.normals is not None:
        files["_normals"] = (picture.normals + 1) / 2
    try:
        for suffix, image in files.items():
            write_image(folder / f"{stem}{suffix}.png", image)
    except OSError as error:  # metrics do not need the files
        return f"cannot write pictures to {folder}: {error.strerror or error}"
    return None


def _short_stem(name: str) -> str:
    """Return an image's name without its extension, cut to LONGEST_STEM bytes."""
    return os.fsencode(Path(name).stem)[:LONGEST_STEM].decode("utf-8", "ignore")


def _judged(
    rgb: Tensor, target: Tensor, kept: Tensor | None, half: bool
) -> tuple[tuple[Tensor, Tensor], Tensor | None]:
    """Return the rendered and the true image as metrics compare them, and which pixels count (None for all)."""
    if half:
        rgb, target = right_half(rgb), right_half(target)
        kept = None if kept is None else right_half(kept)
    kept = None if kept is None or kept.all() else kept
    return (rgb if kept is None else torch.where(kept[..., None], rgb, target), target), kept


def _has_kept_pixels(dataset: Dataset, index: int, half: bool) -> bool:
    """Return whether masks keep any pixel of an image, or of its right half."""
    kept = dataset.kept_of(index)
    return kept is None or bool((right_half(kept) if half else kept).any())


def spread(total: int, limit: int | None) -> list[int]:
    """Return at most `limit` of the numbers 0 to `total` - 1, evenly spaced; all if `limit` is None."""
    if limit is None or limit >= total:
        return list(range(total))
    return [index * total // limit for index in range(limit)]


def _row(dataset: Dataset, index: int, measured: Measured, seconds: float) -> dict[str, Any]:
    """Return what is reported of an image."""
    row: dict[str, Any] = {
        "name": dataset.names[index],
        "psnr": measured.psnr,
        "ssim": measured.ssim,
        "seconds": seconds,
    }
    return row if dataset.reductions is None else {**row, "reduction": int(dataset.reductions[index])}
