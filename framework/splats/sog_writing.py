"""Writing of SOG files (`nerfloom.splats.sog`): numbers to bytes, bytes to images, images to a zip file."""

from __future__ import annotations

import io
import json
import math
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look, comments
from nerfloom.splats.palette import codebook, nearest_codes, palette
from nerfloom.splats.smallest_three import split
from nerfloom.splats.sog import COMMENTS, FIRST_PLACE, MAX_ENTRIES, META, PER_ROW

MAX_SIDE = 16383
"""Maximum number of pixels of a side of a WebP image."""
MANY = 1024
"""Scenes of more Gaussians have fewer entries in the palette of harmonics than Gaussians."""


def encoded_sog(gaussians: Gaussians, look: Look = OURS) -> tuple[bytes, list[str]]:
    """Return the content of a SOG file, and sentences about the errors of its harmonics and positions.

    The file has the Gaussians in the order of a Morton curve, since neighbours compress well beside each other. The
    largest errors are: of log(1 + |x|) of a position, its range / 131070; of an opacity, 1/510; of a rotation, 1.2
    degrees; of a logarithm of a scale and of a coefficient of degree 0, its range / 255. Harmonics become the nearest
    of a palette (`nerfloom.splats.palette`), which has up to 65,536 entries.

    Args:
        gaussians: N finite Gaussians on the CPU.

    Raises:
        ConfigError: if the format cannot hold them.
    """
    width = max(4, 4 * math.ceil(math.sqrt(len(gaussians)) / 4))
    height = max(4, 4 * math.ceil(len(gaussians) / width / 4))
    if max(width, height) > MAX_SIDE or not len(gaussians):
        raise ConfigError(f"a SOG file holds 1 to {MAX_SIDE**2:,} Gaussians, not {len(gaussians):,}: write a PLY file")
    given = gaussians[torch.from_numpy(morton_order(gaussians.means.double().numpy()))]
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "Nerfloom"}, "count": len(given)}
    meta["antialias"] = look.antialiased
    if look.antialiased:
        meta["model"] = "antialiased"
    images: dict[str, bytes] = {}

    def image(name: str, channels: np.ndarray, size: tuple[int, int] = (width, height)) -> list[str]:
        images[f"{name}.webp"] = _webp(channels, *size)
        return [f"{name}.webp"]

    logs = given.means.double().numpy()
    logs = np.sign(logs) * np.log1p(np.abs(logs))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint(65535 * (logs - low) / np.where(high > low, high - low, 1)).astype(np.int64)
    files = image("means_l", steps & 255) + image("means_u", steps >> 8)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": files}
    read = low + steps / 65535 * (high - low)
    moved = float(np.abs(np.sign(read) * np.expm1(np.abs(read)) - given.means.double().numpy()).max())
    codes, indices = _coded(given.log_scales)
    meta["scales"] = {"codebook": codes, "files": image("scales", indices)}
    place, others = split(given.rotations.double().numpy())
    turns = np.rint(127.5 * (math.sqrt(2) * others + 1)).clip(0, 255)
    meta["quats"] = {"files": image("quats", np.concatenate([turns, FIRST_PLACE + place[:, None]], -1))}
    codes, indices = _coded(given.colors)
    opacity = np.rint(255 * given.logits.double().sigmoid().numpy())[:, None]
    meta["sh0"] = {"codebook": codes, "files": image("sh0", np.concatenate([indices, opacity], -1))}
    notes: list[str] = []
    if given.degree:
        labels, part, entries, error = _palette(given.harmonics)
        terms, count = given.harmonics.shape[2], part.pop("count")
        files = image("shN_centroids", entries, (PER_ROW * terms, -(-count // PER_ROW)))
        files += image("shN_labels", np.stack([labels & 255, labels >> 8, 0 * labels], -1))
        meta["shN"] = {"count": count, "bands": given.degree, **part, "files": files}
        notes = [f"SOG has {count:,} sets of harmonics for {len(given):,} Gaussians: their RMS error is {error:.2g}"]
    notes.append(f"SOG rounds positions by up to {moved:.2g}; a typical Gaussian has the size {given.typical_size:.2g}")
    meta["extras"] = {COMMENTS: comments(look)}
    return _zipped({**images, META: json.dumps(meta, allow_nan=False).encode()}), notes


def write_sog(file: Path, content: bytes) -> None:
    """Write a SOG file, or a folder with the same content.

    Args:
        file: path of the zip file, or of the meta.json of a folder; images are written beside it first.
        content: the zip file.

    Raises:
        OSError: if a file cannot be written.
    """
    if file.name != META:
        write_atomically(file, partial(_put, content))
        return
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for name in archive.namelist():  # meta.json is the last
            write_atomically(file.parent / name, partial(_put, archive.read(name)))


def _put(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the indices (N,) int64 of points in the order of a Morton curve (Morton 1966) of 2^10 cells a side.

    Args:
        points: (N, 3), finite.
    """
    low, spread = points.min(0), np.ptp(points, axis=0)
    cells = (1023 * (points - low) / np.where(spread > 0, spread, 1)).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            keys |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(keys, kind="stable")


def _coded(values: Tensor) -> tuple[list[float], np.ndarray]:
    """Return a codebook and the indices of the values in it."""
    codes = codebook(values.numpy())
    # Nine digits distinguish all float32 numbers, and are fewer than float64 would print.
    return [float(f"{code:.9g}") for code in codes], nearest_codes(values.numpy(), codes)


def _palette(harmonics: Tensor) -> tuple[np.ndarray, dict[str, Any], np.ndarray, float]:
    """Return labels (N,), number of entries and codebook, the palette's pixels (P, 3), and the harmonics' RMS error."""
    count, _, terms = harmonics.shape
    size = count if count <= MANY else min(MAX_ENTRIES, 2 ** (count.bit_length() - 1))
    entries, labels = palette(harmonics.flatten(1), size)
    codes, indices = _coded(entries)
    read = torch.tensor(codes)[torch.from_numpy(indices).long()][labels]
    error = float((read - harmonics.flatten(1)).double().square().mean().sqrt())
    pixels = indices.reshape(len(entries), 3, terms).transpose(0, 2, 1).reshape(-1, 3)
    return labels.numpy(), {"count": len(entries), "codebook": codes}, pixels, error


def _webp(channels: np.ndarray, width: int, height: int) -> bytes:
    """Return a lossless WebP image with (N, 3 or 4) numbers from 0 to 255 as its first pixels."""
    pixels = np.zeros((width * height, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(channels), : channels.shape[1]] = channels
    stream = io.BytesIO()
    # Without `exact`, colours where alpha is 0 are lost.
    Image.fromarray(pixels.reshape(height, width, 4)).save(stream, format="WEBP", lossless=True, exact=True)
    return stream.getvalue()


def _zipped(files: dict[str, bytes]) -> bytes:
    """Return a zip file of files that are compressed already; the same files give the same bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16  # permissions where it is unpacked
            archive.writestr(entry, content)
    return stream.getvalue()
