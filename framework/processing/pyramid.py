"""Reduced copies of images, in folders images_2, images_4, ... beside the images' folder."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from nerfloom.data.names_on_disk import reduced_folder
from nerfloom.processing.images import in_parallel, save


def write_pyramid(folder: Path, names: list[str], num_downscales: int, masks: bool = False) -> None:
    """Write images reduced by powers of two: means over whole blocks of pixels, with sizes rounded down.

    Args:
        folder: the images' folder, such as OUT/images; OUT/images_2 and so on are written.
        names: paths of the images in it.
        num_downscales: number of folders to write.
        masks: whether the images are masks; a reduced mask pixel is white only if its whole block is.
    """
    factors = [2 ** (level + 1) for level in range(num_downscales)]

    def reduce_one(name: str) -> None:
        with Image.open(folder / name) as image:
            image.load()
            for factor in factors:
                target = reduced_folder(folder, factor) / name
                target.parent.mkdir(parents=True, exist_ok=True)
                small = reduced(image, factor)
                save(small.point(lambda value: 255 if value == 255 else 0) if masks else small, target)

    if factors:
        in_parallel(reduce_one, names, f"Reducing {folder.name}", len(names))


def reduced(image: Image.Image, factor: int) -> Image.Image:
    """Return an `image` reduced by an integer `factor`, colours weighted by alpha, and at least one pixel large."""
    width, height = max(image.width // factor, 1), max(image.height // factor, 1)
    if min(image.size) < factor:
        return image.resize((width, height), Image.Resampling.BOX)
    return image.reduce(factor, box=(0, 0, width * factor, height * factor))
