"""Masks of what moves: a short training with the robust loss finds what other images contradict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from nerfloom.base.config import from_plain
from nerfloom.base.console import say, track
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.losses.robust import error_counts, error_quantile, image_inliers, window_side
from nerfloom.model import Model
from nerfloom.processing import transforms
from nerfloom.processing.images import save
from nerfloom.processing.output import FINISHED
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.registry import load_dataparser, load_method
from nerfloom.training.progress import ProgressBar
from nerfloom.training.trainer import Trainer

METHOD = "nerfacto"
"""The method that looks for what moves."""
SETTINGS: dict[str, Any] = {"max_num_iterations": None, "robust": "percentile", "vis": "none"}
"""Its settings."""
LONGER_SIDE = 400
"""Longer side of the images that it learns from, pixels, at least; images are reduced by 2, 4 or 8."""


def moving(errors: Tensor, threshold: Tensor) -> Tensor:
    """Return the regions of an image that show something that moves.

    These are the pixels that `image_inliers` leaves out, without what is thinner or smaller than half of one of its
    windows, and a quarter of a window larger on each side, for shadows and blurred edges.

    Args:
        errors: (H, W) squared errors of a trained model.
        threshold: () error below which a pixel agrees with the other images.

    Returns:
        (H, W) bool.
    """
    contradicted = (~image_inliers(errors, threshold)).float()[None, None]
    window = window_side(max(errors.shape))
    size, border = window // 2 + 1, window // 4
    core = (avg_pool2d(contradicted, size, 1, border, count_include_pad=False) > 0.5) & (contradicted > 0)
    return max_pool2d(core.float(), 2 * border + 1, 1, border)[0, 0] > 0


def found_masks(model: Model[Any], dataset: Dataset, quantile: float) -> list[Tensor]:
    """Return what moves in each training image of a model, M masks (H, W) bool.

    Args:
        model: a model trained with the robust loss.
        dataset: M training images.
        quantile: share of all pixels that agree with the other images for certain.
    """
    errors = []
    for index in track(range(len(dataset)), "Looking for what moves", total=len(dataset)):
        rgb = model.render_rgb(dataset.view(index), model.background)
        errors.append((rgb - dataset.image(index)[..., :3].float() / 255).square().mean(-1))
    threshold = error_quantile(torch.stack([error_counts(each) for each in errors]).sum(0), quantile)
    return [moving(each, threshold) for each in errors]


def mask_moving(output: Path, num_downscales: int, **settings: Any) -> None:
    """Train on a finished data folder for a short time, and add masks that leave out what moves.

    Masks are black where something moves; they are at full size, with reduced copies beside them, and transforms.json
    names them, so that any tool that reads masks can use them.

    Args:
        output: folder with transforms.json and images.
        num_downscales: number of folders of reduced images and masks.
        settings: further settings of the training.
    """
    content = json.loads((output / FINISHED).read_text())
    frames = {Path(frame["file_path"]).relative_to("images").as_posix(): frame for frame in content["frames"]}
    with Image.open(output / "images" / next(iter(frames))) as image:
        longer = max(image.size)
    factor = max(2**level for level in range(min(num_downscales, 3) + 1) if longer >> level >= LONGER_SIDE or not level)
    parser = load_dataparser("nerfstudio")
    parsed = from_plain(parser(), {"eval_mode": "all", "downscale_factor": factor}, "masks").parse(output, "train")
    dataset, method = load_dataset(parsed, "train"), load_method(METHOD)
    config = from_plain(method.config, {**SETTINGS, **settings}, "masks")
    trainer = Trainer(method, config, dataset)
    with ProgressBar(f"{METHOD}, to find what moves") as bar:
        for report in trainer.steps():
            bar.show(report)
    masks, names, share = found_masks(trainer.model, trainer.train_set, config.robust_quantile), [], 0.0
    for mask, path in zip(masks, parsed.image_paths, strict=True):
        name = Path(*path.relative_to(output).parts[1:]).as_posix()
        with Image.open(output / "images" / name) as image:
            size = image.size
        grey = Image.fromarray(((~mask).cpu().numpy() * 255).astype("uint8"))
        target = output / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        save(grey.resize(size, Image.Resampling.NEAREST), target)
        frames[name]["mask_path"] = f"masks/{name}.png"
        names.append(f"{name}.png")
        share += float(mask.float().mean()) / len(masks)
    write_pyramid(output / "masks", names, num_downscales, masks=True)
    transforms.write(output / FINISHED, content)
    say(f"masks leave out {share:.1%} of all pixels; look at {output / 'masks'} before you train with them")
