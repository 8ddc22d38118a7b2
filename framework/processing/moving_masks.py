"""Masks of moving things: a short training with `--robust` finds what other images contradict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image

from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.json_files import read_object, write_json
from nerfloom.base.plain import from_plain
from nerfloom.data.dataset import load_dataset
from nerfloom.data.pixels.device_placement import on_device
from nerfloom.processing.images import save
from nerfloom.processing.output import FINISHED
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.registry import load_dataparser, load_method
from nerfloom.training.progress import ProgressBar
from nerfloom.training.trainer import Trainer

METHOD = "nerfacto"
"""The method that looks for moving things."""
SETTINGS: dict[str, Any] = {
    "max_num_iterations": None,
    "robust": True,
    "gradient_scaling": True,
    "mean_appearance_share": 0.0,
    "vis": "none",
}
"""Its settings. Without scaled gradients, people become fog in front of their camera, which no image contradicts. In a
step with the mean appearance, all of an image in other light would be wrong in one direction."""
LONGER_SIDE = 400
"""Minimum longer side of the images that it learns from, pixels. Larger images are reduced by 2, 4 or 8."""


def mask_moving(output: Path, num_downscales: int, **settings: Any) -> None:
    """Train on a finished data folder for a short time, and add masks that leave out moving things.

    Masks are black where something moves. They have full size, with reduced copies beside them. transforms.json names
    them, so any tool that reads masks can use them.

    Args:
        output: folder with transforms.json and images.
        num_downscales: number of folders of reduced images and masks.
        settings: further settings of the training.
    """
    content = read_object(output / FINISHED)
    frames = {Path(frame["file_path"]).relative_to("images").as_posix(): frame for frame in content["frames"]}
    with Image.open(output / "images" / next(iter(frames))) as image:
        longer = max(image.size)
    factor = max(2**level for level in range(min(num_downscales, 3) + 1) if longer >> level >= LONGER_SIDE or not level)
    parser = load_dataparser("nerfstudio")
    parsed = from_plain(parser(), {"eval_mode": "all", "downscale_factor": factor}, "masks").parse(output, "train")
    method = load_method(METHOD)
    config = from_plain(method.config, {**SETTINGS, **settings}, "masks")
    dataset, _ = on_device(load_dataset(parsed, "train"), choose_device(config.machine))
    trainer = Trainer(method, config, dataset)
    with ProgressBar(f"{METHOD}, to find moving things") as bar:
        for report in trainer.steps():
            bar.show(report)
    tiles, cameras, names, share = trainer.source.contradicted, trainer.train_set.cameras, [], 0.0
    assert tiles is not None
    for index, path in enumerate(parsed.image_paths):
        counting = tiles.counting(cameras.image_pixels(index)).view(cameras.sizes[index][0], -1)
        name = Path(*path.relative_to(output).parts[1:]).as_posix()
        with Image.open(output / "images" / name) as image:
            size = image.size
        grey = Image.fromarray((counting.cpu().numpy() * 255).astype("uint8"))
        target = output / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        save(grey.resize(size, Image.Resampling.NEAREST), target)
        frames[name]["mask_path"] = f"masks/{name}.png"
        names.append(f"{name}.png")
        share += float(1 - counting.mean()) / len(parsed.image_paths)
    write_pyramid(output / "masks", names, num_downscales, masks=True)
    write_json(output / FINISHED, content)
    say(f"masks leave out {share:.1%} of all pixels; look at {output / 'masks'} before you train with them")
