"""The evaluator of every method, used at the end of training and by `ns-eval`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from nerfloom.base.config import HeldOutAppearance
from nerfloom.base.console import say, track
from nerfloom.base.device import runs_ahead, wait_for
from nerfloom.base.errors import DataError
from nerfloom.base.evenly_spaced import strided
from nerfloom.base.meter import time_text
from nerfloom.cameras.view import View, every
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.appearance import held_out_appearance, right_half
from nerfloom.evaluation.lpips import MIN_SIDE_OF_LPIPS, NETWORK, Lpips, load_lpips
from nerfloom.evaluation.metrics import MIN_SIDE_OF_SCALES, ms_ssim, psnr, quick_ssim
from nerfloom.evaluation.statistics import statistics
from nerfloom.evaluation.true_outputs import diffuse_psnr, normal_mae
from nerfloom.evaluation.view_files import Judged, ViewFiles
from nerfloom.kernels.images.ssim import WINDOW
from nerfloom.renderable import Renderable, RendersFromImages
from nerfloom.rendering.rendered import Picture

T = TypeVar("T")

CLEAR_SHARE = 0.9
"""A view that sees a sparse point should show nothing up to this fraction of the point's distance."""
MIN_DROP, MAX_NAMED = 3.0, 3
"""Views this far below the mean PSNR, dB, are named; and the maximum number of views named."""
MASKED = (
    "PSNR is over kept pixels, SSIM and MS-SSIM over windows without ignored pixels, LPIPS is the mean of its map over "
    "kept pixels, with ignored pixels copied from the true image"
)
"""Description of the metrics of images with ignored pixels."""


@dataclass(frozen=True)
class Measured:
    """Metrics of a rendered image."""

    psnr: float
    """Peak signal-to-noise ratio, dB."""
    ssim: float | None
    """Structural similarity; None if no window of SSIM lies within the counted pixels."""


def measure(rgb: Tensor, target: Tensor, kept: Tensor | None) -> Measured:
    """Compute PSNR of pixels, and SSIM of windows, of `rgb` and `target` (H, W, 3) in `kept` (H, W); None for all."""
    judged = (rgb, target) if kept is None else (rgb[kept], target[kept])
    return Measured(psnr(*judged), quick_ssim(rgb, target, kept) if min(rgb.shape[:2]) >= WINDOW else None)


def measure_view(model: Renderable, dataset: Dataset, index: int, background: Tensor, stride: int = 1) -> Measured:
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
    """Return the indices of `dataset` to evaluate: no source images, and with kept pixels, in the right `half`."""
    given = dataset.source_images
    judged = range(len(dataset)) if given is None else (~given).nonzero()[:, 0].tolist()
    return [index for index in judged if _has_kept_pixels(dataset, index, half)]


def timed_view(model: Renderable, view: View, background: Tensor) -> tuple[Picture, float]:
    """Render a `view` over a `background` (3,) by `model`; return the picture and the seconds that it took."""
    start = time.perf_counter()
    picture = model.render_view(view, background)
    wait_for(model.device)
    return picture, time.perf_counter() - start


def floaters(picture: Picture, dataset: Dataset, index: int) -> float | None:
    """Return the percentage of a view's sparse points with matter in front of them.

    These are points that the image sees according to the reconstruction's tracks, but with a median depth of the pixel
    below `CLEAR_SHARE` of their distance. Half of such a pixel's light is stopped in space that should be empty.
    This is defined for every method that renders depth.

    Args:
        picture: the rendered view.
        dataset: the views.
        index: index of the view.

    Returns:
        The percentage; None if the image sees no point with a well-known distance.
    """
    if dataset.sparse_depth is None:
        return None
    start, end = dataset.cameras.ends[index : index + 2]
    pixels = dataset.sparse_depth.pixels
    known = dataset.sparse_depth[(pixels >= start) & (pixels < end)]
    known = known[known.deviations < (1 - CLEAR_SHARE) / 3 * known.distances]
    if not len(known):
        return None
    before = picture.median_depth.reshape(-1)[known.pixels - start] < CLEAR_SHARE * known.distances
    return 100 * before.float().mean().item()


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a set of images."""

    per_image: list[dict[str, Any]]
    """Name, psnr, ssim, ms_ssim, lpips, normal_mae, diffuse_psnr, floaters and rendering seconds of each image; the
    numbers of its counted and masked pixels; the image's reduction if images have several sizes; and the level error of
    levels of detail."""
    results: dict[str, Any]
    """Means, standard deviations and rendering speed, with nerfstudio's keys; the number of images in each mean; the
    numbers of counted and of masked pixels; by_size, the statistics of images of each size; and the largest level error
    of levels of detail."""
    lpips_note: str
    """Network of LPIPS and source of its weights, or the reason for its absence."""
    eval_appearance: HeldOutAppearance | None = None
    """Source of the held-out images' appearance; None if the method has none."""
    pictures_note: str | None = None
    """Reason why rendered images could not be written; None if there was no problem."""

    @property
    def warning(self) -> str | None:
        """A warning about rendered images that are not finite; None if all are finite."""
        bad = [row["name"] for row in self.per_image if not math.isfinite(row["psnr"])]
        if not bad:
            return None
        return (
            f"{len(bad)} of {len(self.per_image)} rendered images are not finite, first {bad[0]}: their metrics and "
            "the means are null; check the poses in the data and the checkpoint, or evaluate an older "
            "checkpoint (ns-eval --load-checkpoint)"
        )

    @property
    def masks_note(self) -> str | None:
        """A description of the metrics of masked images; None if all pixels count."""
        if not self.results["num_ignored_pixels"]:
            return None
        images = self.results["num_images"]
        lacking = {name: images - self.results[f"{name}_images"] for name in ("ssim", "ms_ssim")}
        absent = [f"{number} of {images} images have no {name}" for name, number in lacking.items() if number]
        return MASKED + (f"; {' and '.join(absent)}: no such window" if absent else "")

    @property
    def far_below(self) -> str | None:
        """The views `MIN_DROP` or more below the mean PSNR, worst first, as text; None if there are none."""
        mean = self.results["psnr"]
        low = sorted((row for row in self.per_image if row["psnr"] <= mean - MIN_DROP), key=lambda row: row["psnr"])
        if not low:
            return None
        named = ", ".join(f"{row['name']} {row['psnr']:.2f} dB" for row in low[:MAX_NAMED])
        return f"far below the mean: {named}" + (f", and {len(low) - MAX_NAMED} more" if len(low) > MAX_NAMED else "")

    def line(self) -> str:
        """Return the results as a line of text."""
        r = self.results
        ssim, scales, lpips = (self._mean(name) for name in ("ssim", "ms_ssim", "lpips"))
        scales = "" if r["ms_ssim"] is None and not r["num_ignored_pixels"] else f"  MS-SSIM {scales}"
        before = "" if r["floaters"] is None else f"  floaters {r['floaters']:.1f} %"
        parts = "" if r["normal_mae"] is None else f"  normals off by {r['normal_mae']:.2f}°"
        parts += "" if r["diffuse_psnr"] is None else f"  diffuse PSNR {r['diffuse_psnr']:.2f} dB"
        rays = r["num_rays_per_sec"]
        speed = f"{rays / 1e3:.1f}k rays/s  {1 / r['fps']:.2f} s/image" if rays else f"{r['fps']:.1f} images/s"
        sizes = ", ".join(f"{size}: {found['psnr']:.2f}" for size, found in r.get("by_size", {}).items())
        sizes = f" ({sizes})" if sizes else ""
        quality = f"PSNR {r['psnr']:.2f} dB{sizes}  SSIM {ssim}{scales}  LPIPS ({NETWORK}) {lpips}{before}{parts}"
        count, of = r["num_images"], r["num_images_in_split"]
        kept, ignored = r["num_pixels"], r["num_ignored_pixels"]
        masks = f", {kept:,} pixels; masks ignore {ignored / (kept + ignored):.0%}" if ignored else ""
        return f"{quality}  {speed}  ({count if count == of else f'{count} of {of}'} images{masks})"

    def _mean(self, name: str) -> str:
        """Return a mean as text, with its number of images if some images lack the metric."""
        mean, images = self.results[name], self.results[f"{name}_images"]
        over = f" ({images} of {self.results['num_images']} images)" if images < self.results["num_images"] else ""
        return "absent" if mean is None else f"{mean:.4f}{over}"


def evaluate(
    model: Renderable,
    dataset: Dataset,
    *,
    max_images: int | None = None,
    seconds: float | None = None,
    pictures: Path | None = None,
    max_pictures: int | None = None,
    round_to_uint8: bool = False,
    lpips_weights: Path | None = None,
    title: str = "Evaluating",
) -> Evaluation:
    """Render views and compute their metrics.

    Images that are given to the method (`Dataset.source_images`) are shown to it and not judged. Masked-out pixels do
    not count: PSNR omits them, SSIM omits the windows that have any, at one scale and at five (`ms_ssim`), and LPIPS is
    the mean of its map over the others, with masked-out pixels copied from the true image. Images without
    other pixels are skipped. If appearance is fitted to left halves (`Appearance.held_out`), right halves count. An
    image has no SSIM if no window counts.

    Args:
        model: the trained model.
        dataset: views with images, on the model's device, with cameras in the frame of the model's scene
            (`nerfloom.renderable.with_refined_poses`).
        max_images: maximum number of views, evenly spaced; all if None.
        seconds: time that the views may take by the time of the first, which is always evaluated; no limit if None.
        pictures: folder for renders, true images, `view_panels` and further outputs; no files if None.
        max_pictures: maximum number of views with files, evenly spaced; all if None. If not all views have files, the
            view with the lowest PSNR is also written, as worst.png and so on. Views with files are evaluated before the
            others.
        round_to_uint8: whether colours are rounded to 8 bits before they are measured.
        lpips_weights: file of LPIPS's weights; the weights of the package lpips if None.
        title: text of the progress bar.

    Raises:
        ConfigError: if the file of weights is unusable.
        DataError: if there are no images to evaluate.
    """
    appearance = model.appearance
    half = appearance is not None and appearance.held_out == "half"
    views = views_to_judge(dataset, half)
    asked = [views[rank] for rank in strided(len(views), max_images)]
    if not asked:
        raise DataError(f"there are no images to evaluate: masks cover all {len(dataset)} of them")
    if isinstance(model, RendersFromImages) and dataset.source_images is not None:
        model.show_images(dataset)
    lpips, lpips_note = load_lpips(lpips_weights, model.device)
    background = model.background
    judge = partial(_judge, model, dataset, background, half, round_to_uint8, lpips)
    if seconds is not None and runs_ahead(model.device):
        judge(asked[0])  # compiles kernels, so that the other views need not wait
    first, cost = _timed(partial(judge, asked[0]), f"{title}: the first image")
    chosen = _in_time(asked, cost, seconds)
    shown = {chosen[rank] for rank in strided(len(chosen), max_pictures)}
    files = ViewFiles(pictures, dataset.names, shown, with_worst=0 < len(shown) < len(chosen))
    order = sorted(chosen, key=lambda index: index not in shown)
    others = ((index, judge(index)) for index in track(order[1:], title, len(order), done=1, spent=cost))
    rows, rays = _collected(chain([(order[0], first)], others), files)
    spent = sum(row["seconds"] for row in rows)
    speed = {"num_rays_per_sec": rays / spent if rays else None, "fps": len(rows) / spent}  # None if no rays are cast
    counts = {"num_images": len(rows), "num_images_in_split": len(views)}
    protocol = None if appearance is None else appearance.held_out
    errors = [row["level_error"] for row in rows if "level_error" in row]
    results = {**statistics(rows), **speed, **counts, **({"max_level_error": max(errors)} if errors else {})}
    return Evaluation(rows, results, lpips_note, protocol, files.note)


def _collected(judged: Iterable[tuple[int, tuple[dict[str, Any], Judged]]], files: ViewFiles) -> tuple[list[Any], int]:
    """Write the files of views as they are evaluated; return their rows in the order of the data, and the rays cast."""
    found, rays = {}, 0
    for index, (row, images) in judged:
        found[index] = row
        rays += images.picture.num_rays
        files.take(index, row["psnr"], images)
    files.write_worst()
    return [found[index] for index in sorted(found)], rays


def _timed(work: Callable[[], T], title: str) -> tuple[T, float]:
    """Return the result of a function and its time in seconds, with its title shown meanwhile."""
    start = time.perf_counter()
    (result,) = track((work() for _ in range(1)), title, total=1)
    return result, time.perf_counter() - start


def _in_time(views: list[int], cost: float, seconds: float | None) -> list[int]:
    """Return as many views, evenly spaced, as fit into a time limit at `cost` seconds each; all without a limit."""
    chosen = views if seconds is None else [views[rank] for rank in strided(len(views), max(int(seconds / cost), 1))]
    if len(chosen) < len(views):
        say(f"evaluating {len(chosen)} of {len(views)} images, {time_text(cost)} each (all: --eval all, or ns-eval)")
    return chosen


def _judge(
    model: Renderable,
    dataset: Dataset,
    background: Tensor,
    half: bool,
    round_to_uint8: bool,
    lpips: Lpips | None,
    index: int,
) -> tuple[dict[str, Any], Judged]:
    """Return the report on a view, and its images."""
    target = composite(dataset.image(index).float() / 255, background)
    with held_out_appearance(model, dataset, index, background):
        picture, spent = timed_view(model, view := dataset.view(index), background)
    if view.image is None:
        picture = replace(picture, outputs=tuple(output for output in picture.outputs if not output.of_training))
    rgb = picture.rgb.clamp(0, 1)
    if round_to_uint8:
        rgb = (rgb * 255).round() / 255
    pair, kept = _judged(rgb, target, dataset.kept_of(index), half)
    row = _row(dataset, index, measure(*pair, kept), spent)
    smallest = min(pair[0].shape[:2])
    row["ms_ssim"] = None if smallest < MIN_SIDE_OF_SCALES else ms_ssim(*pair, kept)
    row["lpips"] = None if lpips is None or smallest < MIN_SIDE_OF_LPIPS else lpips(*pair, kept)
    row["pixels"] = pair[0][..., 0].numel() if kept is None else int(kept.sum())
    row["ignored_pixels"] = pair[0][..., 0].numel() - row["pixels"]
    row["normal_mae"] = normal_mae(picture, dataset, index, half)
    row["diffuse_psnr"] = diffuse_psnr(picture, dataset, index, half)
    row["floaters"] = floaters(picture, dataset, index)
    if picture.level_error is not None:
        row["level_error"] = picture.level_error
    return row, Judged(rgb, target, picture)


def _judged(
    rgb: Tensor, target: Tensor, kept: Tensor | None, half: bool
) -> tuple[tuple[Tensor, Tensor], Tensor | None]:
    """Return the rendered and the true image as compared by metrics, and the pixels that count (None for all)."""
    if half:
        rgb, target = right_half(rgb), right_half(target)
        kept = None if kept is None else right_half(kept)
    kept = None if kept is None or kept.all() else kept
    return (rgb if kept is None else torch.where(kept[..., None], rgb, target), target), kept


def _has_kept_pixels(dataset: Dataset, index: int, half: bool) -> bool:
    """Return whether masks keep any pixel of an image, or of its right half."""
    kept = dataset.kept_of(index)
    return kept is None or bool((right_half(kept) if half else kept).any())


def _row(dataset: Dataset, index: int, measured: Measured, seconds: float) -> dict[str, Any]:
    """Return the report on an image."""
    row: dict[str, Any] = {
        "name": dataset.names[index],
        "psnr": measured.psnr,
        "ssim": measured.ssim,
        "seconds": seconds,
    }
    return row if dataset.reductions is None else {**row, "reduction": int(dataset.reductions[index])}
