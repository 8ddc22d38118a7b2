"""Reduced copies of images: images_2, images_4, ... beside images."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from framework.tools.processing.photographs import in_parallel, save


def write_pyramid(folder: Path, names: list[str], num_downscales: int, masks: bool = False) -> None:
    """Halve images again and again, as means over whole blocks of pixels; sizes are rounded down.

    Args:
        folder: the images' folder, such as OUT/images; OUT/images_2 and so on are written.
        names: their paths in it.
        num_downscales: how many folders.
        masks: a reduced pixel is white only where all it covers is.
    """
    factors = [2 ** (level + 1) for level in range(num_downscales)]

    def reduce_one(name: str) -> None:
        with Image.open(folder / name) as image:
            image.load()
            for factor in factors:
                target = folder.with_name(f"{folder.name}_{factor}") / name
                target.parent.mkdir(parents=True, exist_ok=True)
                small = reduced(image, factor)
                save(small.point(lambda value: 255 if value == 255 else 0) if masks else small, target)

    if factors:
        in_parallel(reduce_one, names, f"Reducing {folder.name}", len(names))


def reduced(image: Image.Image, factor: int) -> Image.Image:
    """An image reduced by a whole number; colours are weighted by alpha. At least one pixel is left."""
    width, height = max(image.width // factor, 1), max(image.height // factor, 1)
    if min(image.size) < factor:
        return image.resize((width, height), Image.Resampling.BOX)
    return image.reduce(factor, box=(0, 0, width * factor, height * factor))
