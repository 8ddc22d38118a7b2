"""From image files to pixels: each image is decoded straight into its place, in memory or in the cache's file.

So loading takes the memory of the set, or of nothing where it goes to a file, and of the few images being decoded.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from framework.base.console import say, track
from framework.base.errors import DataError
from framework.data.image_files import may_be_transparent, read_image
from framework.data.light import light_of
from framework.data.mapped_pixels import MappedPixels
from framework.data.masks import read_mask
from framework.data.pixel_cache import MB, PixelMemory, cache_path, no_room, pack, temporary_store, unpack
from framework.data.pixel_set import PixelSet
from framework.data.pixel_store import MemoryStore, PixelStore, drop_fourth, move

WORKERS = min(os.cpu_count() or 1, 8)
"""Images that are decoded at once: each holds several times its pixels meanwhile."""


@dataclass(frozen=True)
class ImageFiles:
    """The M images of a split, to be decoded."""

    split: str
    images: tuple[Path, ...]
    masks: tuple[Path | None, ...]
    """M masks; None where a photograph has none."""
    sizes: tuple[tuple[int, int], ...]
    """M widths and heights after reduction."""
    factor: int
    """Images are reduced by this whole number."""


@dataclass(frozen=True)
class Decoded:
    """The images that could be read."""

    pixels: Tensor
    """(P, 3 or 4) uint8; four where a pixel is not opaque."""
    left: Tensor
    """(M',) int64 which images of the split they are."""
    light: Tensor
    """(M', 3, Q) `light_of` each."""
    kept: PixelSet | None
    """What masks do not ignore; None where they ignore nothing."""
    mapped: MappedPixels | None
    """The file that `pixels` lie in; None where they are in memory."""


def decode(files: ImageFiles, memory: PixelMemory) -> Decoded:
    """Decode images into memory, or into a file where they take more than `memory` allows and none has them already.

    Unreadable images are skipped and reported.

    Raises: DataError for an image whose size is not as stated, a mask that cannot be used, no image left, a full disk.
    """
    with ThreadPoolExecutor(WORKERS) as pool:
        channels = 4 if any(pool.map(may_be_transparent, files.images)) else 3
    size = channels * sum(width * height for width, height in files.sizes)
    if size <= memory.limit:
        store = MemoryStore(size)
        facts = _fill(files, store, channels)
        shape = int(facts["pixels"]), int(facts["channels"])
        return _decoded(files, facts, torch.from_numpy(store.finish(shape[0] * shape[1])).view(shape), None)
    numbers = [files.factor, *(side for sides in files.sizes for side in sides)]
    path = cache_path(memory.folder, [*files.images, *files.masks], numbers)
    found = unpack(path)
    if found is None:
        say(
            f"split '{files.split}': {size / MB:,.0f} MB of pixels are more than the {memory.limit / MB:,.0f} MB that "
            f"may be in memory (--cache-limit): decoding them once into {path}"
        )
        found = _write(files, path, size, channels)
    else:
        say(f"split '{files.split}': pixels decoded by an earlier run are read from {path}")
    mapped = MappedPixels(path, int(found["pixels"]), int(found["channels"]), memory.limit)
    return _decoded(files, found, mapped.pixels, mapped)


def from_arrays(images: Sequence[np.ndarray], masks: Sequence[np.ndarray] | None = None) -> Decoded:
    """Images that are in memory already, as if they had been decoded.

    Args:
        images: M arrays (H, W, 3 or 4) uint8, the fourth channel being straight alpha.
        masks: M arrays (H, W) bool, true where to learn from; None where that is everywhere.
    Raises: DataError for an array of another kind, or where the masks leave no pixel.
    """
    for index, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
            raise DataError(f"image {index} is {image.dtype} {image.shape}; it must be uint8 (height, width, 3 or 4)")
    channels = 4 if any(image.shape[2] == 4 and (image[..., 3] < 255).any() for image in images) else 3
    pixels = torch.from_numpy(np.concatenate([_channels(image, channels).reshape(-1, channels) for image in images]))
    kept = None
    if masks is not None:
        kept = PixelSet.of_mask(torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in masks])))
        if not len(kept):
            raise DataError("the masks leave no pixel; they must be true where to learn from")
        kept = None if len(kept) == len(pixels) else kept
    used: Sequence[np.ndarray | None] = [None] * len(images) if masks is None else masks
    light = np.stack([light_of(image, mask) for image, mask in zip(images, used, strict=True)])
    return Decoded(pixels, torch.arange(len(images)), torch.from_numpy(light), kept, None)


def _channels(image: np.ndarray, count: int) -> np.ndarray:
    """An image (H, W, 3 or 4) with three or four channels; it is opaque where it does not say."""
    if image.shape[2] >= count:
        return image[..., :count]
    return np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=-1)


def _write(files: ImageFiles, path: Path, size: int, channels: int) -> dict[str, np.ndarray]:
    """Decode into a file, which gets its name only when it is whole."""
    store = temporary_store(path, size)
    try:
        facts = _fill(files, store, channels)
        store.finish(int(facts["pixels"]) * int(facts["channels"]), pack(facts), path)
    except OSError as error:
        store.discard()
        raise no_room(path.parent, size, error) from error
    except BaseException:
        store.discard()
        raise
    return facts


@dataclass(frozen=True)
class _Image:
    """What is remembered of an image besides its pixels."""

    opaque: bool
    light: np.ndarray
    kept: PixelSet | None
    """Counted from its own first pixel."""


def _fill(files: ImageFiles, store: PixelStore, channels: int) -> dict[str, np.ndarray]:
    """Decode all images into a store, those that can be read one after the other; returns what was found."""
    counts = [width * height for width, height in files.sizes]
    starts = [0, *accumulate(counts)]

    def put(index: int) -> _Image | DataError:
        return _decode_one(files, index, store, starts[index], channels)

    with ThreadPoolExecutor(WORKERS) as pool:
        images = list(track(pool.map(put, range(len(counts))), f"Loading {files.split} images", total=len(counts)))
    failures = [image for image in images if isinstance(image, DataError)]
    if len(failures) == len(images):
        reason = f"has no readable image: {failures[0]}" if failures else "is empty"
        raise DataError(f"split '{files.split}' {reason}")
    left = {index: image for index, image in enumerate(images) if not isinstance(image, DataError)}
    total = 0
    for index in left:
        move(store, starts[index] * channels, total * channels, counts[index] * channels)
        total += counts[index]
    if channels == 4 and all(image.opaque for image in left.values()):
        drop_fourth(store, total)
        channels = 3
    facts = {
        "pixels": np.array(total),
        "channels": np.array(channels),
        "left": np.array(list(left)),
        "light": np.stack([image.light for image in left.values()]),
        "failure": np.array(str(failures[0]) if failures else ""),
    }
    return facts | _kept_runs(files, left, total)


def _kept_runs(files: ImageFiles, left: dict[int, _Image], total: int) -> dict[str, np.ndarray]:
    """What the masks leave of all images, as runs; nothing where they leave everything."""
    if not any(image.kept is not None for image in left.values()):
        return {}
    starts, lengths, first = [], [], 0
    for index, image in left.items():
        count = files.sizes[index][0] * files.sizes[index][1]
        whole = PixelSet.of_runs(torch.tensor([0]), torch.tensor([count]))
        kept = whole if image.kept is None else image.kept
        starts.append(kept.starts + first)
        lengths.append(kept.before.diff())
        first += count
    runs = {"kept_starts": torch.cat(starts).numpy(), "kept_lengths": torch.cat(lengths).numpy()}
    used = runs["kept_lengths"].sum()
    if used == 0:
        raise DataError(f"the masks of split '{files.split}' leave no pixel; they must be white where to learn from")
    return runs if used < total else {}


def _decode_one(files: ImageFiles, index: int, store: PixelStore, start: int, channels: int) -> _Image | DataError:
    """Put an image into its place; the error where it cannot be read."""
    path, mask_path, (width, height) = files.images[index], files.masks[index], files.sizes[index]
    try:
        image = read_image(path, files.factor)
    except DataError as error:
        return error
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1] * files.factor}x{image.shape[0] * files.factor}"
        expected = f"{width * files.factor}x{height * files.factor}"
        remedy = "resize it, or take it out of the data"
        raise DataError(f"{path} is {found} pixels, but its camera is for {expected}, as others' are: {remedy}")
    mask = None if mask_path is None else read_mask(mask_path, width, height)
    store.write(start * channels, np.ascontiguousarray(image[..., :channels]).reshape(-1))
    opaque = channels == 3 or bool((image[..., 3] == 255).all())
    return _Image(opaque, light_of(image, mask), None if mask is None else PixelSet.of_mask(torch.from_numpy(mask)))


def _decoded(files: ImageFiles, facts: dict[str, np.ndarray], pixels: Tensor, mapped: MappedPixels | None) -> Decoded:
    left, total = torch.from_numpy(facts["left"]), len(files.images)
    if len(left) < total:
        missing = f"{total - len(left)} of {total} images are unreadable and skipped"
        say(f"split '{files.split}': {missing}: {facts['failure']}")
    kept = None
    if "kept_starts" in facts:
        kept = PixelSet.of_runs(torch.from_numpy(facts["kept_starts"]), torch.from_numpy(facts["kept_lengths"]))
    return Decoded(pixels, left, torch.from_numpy(facts["light"]), kept, mapped)
