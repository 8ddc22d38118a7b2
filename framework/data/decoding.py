"""Decoding of image files, each directly to its final position in memory or in the cache file.

So loading needs memory only for the pixels of the data set (none if they go to a file) and for the few images being
decoded.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, chain
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.errors import DataError
from nerfloom.data.image_files import may_be_transparent, read_image, reduce_image
from nerfloom.data.light_spread import light_of
from nerfloom.data.masks import read_mask
from nerfloom.data.pixels.cache import MB, PixelMemory, cache_path, no_room, pack, temporary_store, unpack
from nerfloom.data.pixels.memory_mapped import MappedPixels
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.pixels.store import MemoryStore, PixelStore, drop_fourth, move

WORKERS = min(os.cpu_count() or 1, 8)
"""Number of images decoded at once; each temporarily takes several times the memory of its pixels."""


@dataclass(frozen=True)
class ImageFiles:
    """The M image files of a split.

    Args:
        split: name of the split in messages.
        images: M paths.
    """

    split: str
    images: tuple[Path, ...]
    masks: tuple[Path | None, ...]
    """M paths of masks; None for an image without mask."""
    sizes: tuple[tuple[int, int], ...]
    """M widths and heights after reduction, pixels."""
    factors: tuple[int, ...]
    """M integer reduction factors of the images."""


@dataclass(frozen=True)
class Decoded:
    """The pixels of the readable images of a split."""

    pixels: Tensor
    """(P, 3 or 4) uint8 pixels; four channels if any pixel is not opaque."""
    left: Tensor
    """(M',) int64 indices of the readable images in the split."""
    light: Tensor
    """(M', 3, Q) `light_spread.light_of` each image."""
    kept: PixelSet | None
    """Pixels that are not masked out; None for all."""
    mapped: MappedPixels | None
    """The file of `pixels`; None if they are in memory."""


def decode(files: ImageFiles, memory: PixelMemory) -> Decoded:
    """Decode images into memory or, if they exceed the limit, into a cache file that later runs reuse.

    Unreadable images are skipped and reported.

    Args:
        files: the images.
        memory: memory limit and cache folder.

    Raises:
        DataError: if an image has another size than stated, a mask is invalid, no image is readable, or the disk is
            full.
    """
    with ThreadPoolExecutor(WORKERS) as pool:
        channels = 4 if any(pool.map(may_be_transparent, files.images)) else 3
    size = channels * sum(width * height for width, height in files.sizes)
    if size <= memory.limit:
        store = MemoryStore(size)
        facts = _fill(files, store, channels)
        shape = int(facts["pixels"]), int(facts["channels"])
        return _decoded(files, facts, torch.from_numpy(store.finish(shape[0] * shape[1])).view(shape), None)
    numbers = [*sorted(set(files.factors)), *(side for sides in files.sizes for side in sides)]
    path = cache_path(memory.folder, [*files.images, *files.masks], numbers)
    cached = unpack(path)
    if cached is None:
        say(
            f"split '{files.split}': {size / MB:,.0f} MB of pixels exceed the limit of {memory.limit / MB:,.0f} MB "
            f"(--cache-limit): decoding them once into {path}"
        )
        cached = _write(files, path, size, channels)
    else:
        say(f"split '{files.split}': using decoded pixels of an earlier run in {path}")
    mapped = MappedPixels(path, int(cached["pixels"]), int(cached["channels"]), memory.limit)
    return _decoded(files, cached, mapped.pixels, mapped)


def from_arrays(images: Sequence[np.ndarray], masks: Sequence[np.ndarray] | None = None) -> Decoded:
    """Return images given as arrays in the form of decoded images.

    Args:
        images: M arrays (H, W, 3 or 4) uint8; the fourth channel is straight alpha.
        masks: M arrays (H, W) bool, True for pixels to train on; None for all.

    Raises:
        DataError: if an array has another type or shape, or the masks keep no pixel.
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
            raise DataError("the masks keep no pixel; True marks pixels to train on")
        kept = None if len(kept) == len(pixels) else kept
    optional_masks: Sequence[np.ndarray | None] = [None] * len(images) if masks is None else masks
    light = np.stack([light_of(image, mask) for image, mask in zip(images, optional_masks, strict=True)])
    return Decoded(pixels, torch.arange(len(images)), torch.from_numpy(light), kept, None)


def _channels(image: np.ndarray, count: int) -> np.ndarray:
    """Return an image (H, W, 3 or 4) with `count` channels; a missing alpha channel is opaque."""
    if image.shape[2] >= count:
        return image[..., :count]
    return np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=-1)


def _write(files: ImageFiles, path: Path, size: int, channels: int) -> dict[str, np.ndarray]:
    """Decode into a temporary file and rename it when complete."""
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
    """Properties of a decoded image."""

    opaque: bool
    light: np.ndarray
    kept: PixelSet | None
    """Pixels that its mask keeps, counted within the image."""


def _fill(files: ImageFiles, store: PixelStore, channels: int) -> dict[str, np.ndarray]:
    """Decode all images into a store, readable ones without gaps; return the arrays for `pack`."""
    counts = [width * height for width, height in files.sizes]
    starts = [0, *accumulate(counts)]

    def put(indices: list[int]) -> list[_Image | DataError]:
        return _decode_one(files, indices, store, starts, channels)

    same: dict[Path, list[int]] = {}
    for index, path in enumerate(files.images):
        same.setdefault(path, []).append(index)
    with ThreadPoolExecutor(WORKERS) as pool:
        groups = track(pool.map(put, same.values()), f"Loading {files.split} images", total=len(same))
        found = dict(zip(chain(*same.values()), chain(*groups), strict=True))
    images = [found[index] for index in range(len(counts))]
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
    """Return the runs of pixels that the masks keep in all images; empty if they keep all."""
    if not any(image.kept is not None for image in left.values()):
        return {}
    starts, lengths, first = [], [], 0
    for index, image in left.items():
        count = files.sizes[index][0] * files.sizes[index][1]
        all_pixels = PixelSet.of_runs(torch.tensor([0]), torch.tensor([count]))
        kept = all_pixels if image.kept is None else image.kept
        starts.append(kept.starts + first)
        lengths.append(kept.before.diff())
        first += count
    runs = {"kept_starts": torch.cat(starts).numpy(), "kept_lengths": torch.cat(lengths).numpy()}
    used = runs["kept_lengths"].sum()
    if used == 0:
        raise DataError(f"the masks of split '{files.split}' keep no pixel; white marks pixels to train on")
    return runs if used < total else {}


def _decode_one(
    files: ImageFiles, indices: list[int], store: PixelStore, starts: list[int], channels: int
) -> list[_Image | DataError]:
    """Decode a file to the positions of its images in the store; return its error for each image if unreadable."""
    path = files.images[indices[0]]
    images: list[_Image | DataError] = []
    try:
        whole = read_image(path)
        reduced = [
            whole if files.factors[index] == 1 else reduce_image(whole, files.factors[index]) for index in indices
        ]
    except DataError as error:
        return [error] * len(indices)
    for index, image in zip(indices, reduced, strict=True):
        (width, height), factor, mask_path = files.sizes[index], files.factors[index], files.masks[index]
        if image.shape[:2] != (height, width):
            actual = f"{image.shape[1] * factor}x{image.shape[0] * factor}"
            expected = f"{width * factor}x{height * factor}"
            remedy = "resize it, or remove it from the data"
            raise DataError(f"{path} is {actual} pixels, but its camera is for {expected}: {remedy}")
        mask = None if mask_path is None else read_mask(mask_path, width, height)
        store.write(starts[index] * channels, np.ascontiguousarray(image[..., :channels]).reshape(-1))
        opaque = channels == 3 or bool((image[..., 3] == 255).all())
        kept = None if mask is None else PixelSet.of_mask(torch.from_numpy(mask))
        images.append(_Image(opaque, light_of(image, mask), kept))
    return images


def _decoded(files: ImageFiles, facts: dict[str, np.ndarray], pixels: Tensor, mapped: MappedPixels | None) -> Decoded:
    left, total = torch.from_numpy(facts["left"]), len(files.images)
    if len(left) < total:
        missing = f"{total - len(left)} of {total} images are unreadable and skipped"
        say(f"split '{files.split}': {missing}: {facts['failure']}")
    kept = None
    if "kept_starts" in facts:
        kept = PixelSet.of_runs(torch.from_numpy(facts["kept_starts"]), torch.from_numpy(facts["kept_lengths"]))
    return Decoded(pixels, left, torch.from_numpy(facts["light"]), kept, mapped)
