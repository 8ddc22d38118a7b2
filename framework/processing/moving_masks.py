"""Masks of moving things: a scout finds tiles that other images contradict, as for `--robust scout`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.json_files import read_object, write_json
from nerfloom.base.plain import from_plain
from nerfloom.data.dataset import load_dataset
from nerfloom.data.image_files import image_size
from nerfloom.data.pixels.device_placement import on_device
from nerfloom.data.pixels.left_out import LeftOutTiles
from nerfloom.data.sources import SCOUTED_ALONG
from nerfloom.processing.images import save
from nerfloom.processing.output import FINISHED
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.registry import load_dataparser
from nerfloom.training.scout import scout
from nerfloom.training.trainer import Trainer

LONGER_SIDE = 400
"""Minimum longer side of the images that it learns from, pixels. Larger images are reduced by 2, 4 or 8."""


def mask_moving(output: Path, num_downscales: int, **settings: Any) -> None:
    """Train a scout on a finished data folder, and add masks that leave out moving things.

    Masks are black where something moves. They have full size, with reduced copies beside them. transforms.json names
    them, so any tool that reads masks can use them. An image that cannot be read has none.

    Args:
        output: folder with transforms.json and images.
        num_downscales: number of folders of reduced images and masks.
        settings: settings of the scout, with its budget.
    """
    content = read_object(output / FINISHED)
    frames = {Path(frame["file_path"]).relative_to("images").as_posix(): frame for frame in content["frames"]}
    longer = max(image_size([output / "images" / name for name in frames]))
    factor = max(2**level for level in range(min(num_downscales, 3) + 1) if longer >> level >= LONGER_SIDE or not level)
    parser = load_dataparser("nerfstudio")
    parsed = from_plain(parser(), {"eval_mode": "all", "downscale_factor": factor}, "masks").parse(output, "train")
    config = TrainConfig()
    dataset, _ = on_device(load_dataset(parsed, "train"), choose_device(config.machine))
    found = LeftOutTiles(dataset, SCOUTED_ALONG)
    scout(Trainer, dataset, found, config, **{"max_num_iterations": None, **settings})
    names, share = [], 0.0
    for index, path in enumerate(dataset.paths):
        counting = 1 - found.tiles.over_image(found.left_out, index)
        name = Path(*path.relative_to(output).parts[1:]).as_posix()
        grey = Image.fromarray((counting.cpu().numpy() * 255).astype("uint8"))
        target = output / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        save(grey.resize(image_size([output / "images" / name]), Image.Resampling.NEAREST), target)
        frames[name]["mask_path"] = f"masks/{name}.png"
        names.append(f"{name}.png")
        share += float(1 - counting.mean()) / len(dataset)
    write_pyramid(output / "masks", names, num_downscales, masks=True)
    write_json(output / FINISHED, content)
    say(f"masks leave out {share:.1%} of all pixels; look at {output / 'masks'} before you train with them")
