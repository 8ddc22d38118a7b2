"""Gaussians in SOG files (PlayCanvas's Spatially Ordered Gaussians, version 2): images in a zip file or a folder.

The format is specified by https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, and by
https://github.com/playcanvas/splat-transform (src/lib/readers/read-sog.ts, src/lib/writers/write-sog.ts). `meta.json`
has the number of Gaussians, numbers that decode the images, and the images' names. A pixel, row by row, is a Gaussian:

    means_l, means_u    R, G, B: the lower and the upper 8 bits of x, y and z, between meta's mins and maxs of
                        sign(x) log(1 + |x|)
    quats               A: 252 + which of w, x, y, z is largest; R, G, B: the others, 255 (q / sqrt(2) + 1/2)
    scales              R, G, B: indices of logarithms of the scales in a codebook of 256
    sh0                 R, G, B: indices of coefficients of degree 0 in a codebook of 256; A: 255 sigmoid(logit)
    shN_labels          R + 256 G: index of an entry in a palette of harmonics of degrees 1 and higher
    shN_centroids       the palette: 64 entries a row, K pixels each, whose R, G, B are indices of the coefficients of
                        red, green and blue in a codebook of 256

Images are WebP without loss (other formats without loss are allowed: PNG is read too). The axes are the same as in PLY
files. `antialias` of meta.json says whether the Gaussians were trained with antialiasing; newer programs read `model`
instead. The settings of `nerfloom.splats.look` are in `extras`, which the format leaves to applications.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError, printable, shown
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.look import ELSEWHERE, Look, discs, look_of
from nerfloom.splats.palette import CODES
from nerfloom.splats.ply import usable
from nerfloom.splats.smallest_three import joined
from nerfloom.splats.stored import as_float32, logits_of_bytes

META = "meta.json"
"""Name of the file that describes the images."""
COMMENTS = "comments"
"""Entry of `extras` with the settings of drawing: lines as in a PLY file."""
FIRST_PLACE = 252
"""Alpha of a rotation with w as its largest component."""
PER_ROW = 64
"""Entries of the palette in a row of its image."""
MAX_ENTRIES = 1 << 16
"""Maximum number of entries of a palette."""
MAX_PER_BYTE = 64
"""Maximum number of Gaussians for each byte of the images. Photographs' scenes have some 0.1."""
MARGIN = 1 << 20
"""Number of pixels, and of bytes, that are read in any case."""

Read = Callable[[str], bytes]
"""Returns the content of a file by its name beside meta.json."""


def read_sog(file: Path) -> Splats:
    """Read Gaussians from a SOG file.

    Gaussians that are not finite are removed, with a message on the terminal. Opacities of 0 and 1 become 1/1020 and
    1019/1020, the centres of the intervals that round to them.

    Args:
        file: path of the zip file, or of the meta.json of a folder with the same content.

    Raises:
        DataError: if it cannot be read, is of another version, is truncated or damaged.
    """
    zipped = file.name != META
    read = _from_zip(file) if zipped else _from_folder(file.parent)
    meta = _parsed(file, read(META))
    names = [_names(file, meta, key, 2 if key in ("means", "shN") else 1) for key in _keys(meta)]
    contents = [[read(name) for name in part] for part in names]
    count = _count(file, meta, sum(len(content) for part in contents for content in part))
    images = dict(zip(_keys(meta), contents, strict=True))
    lower, upper = (_pixels(file, content, count)[:, :3] for content in images["means"])
    low, high = (_numbers(file, meta["means"], key, 3) for key in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are removed later
        logs = low + (high - low) * ((lower.astype(np.float64) + 256 * upper.astype(np.float64)) / 65535)
        means = np.sign(logs) * np.expm1(np.abs(logs))
    shade = _pixels(file, images["sh0"][0], count)
    gaussians = Gaussians(
        means=as_float32(means),
        log_scales=as_float32(_codes(file, meta, "scales")[_pixels(file, images["scales"][0], count)[:, :3]]),
        rotations=as_float32(_rotations(file, _pixels(file, images["quats"][0], count))),
        logits=logits_of_bytes(shade[:, 3]),
        colors=as_float32(_codes(file, meta, "sh0")[shade[:, :3]]),
        harmonics=_harmonics(file, meta, images["shN"], count) if "shN" in images else torch.zeros(count, 3, 0),
    )
    return Splats(usable(gaussians, file), _look(file, meta))


def _from_zip(file: Path) -> Read:
    """Return how a file in a zip file is read. No more memory is used than its images should need."""

    def read(name: str) -> bytes:
        try:
            most = 16 * file.stat().st_size + MARGIN
            with zipfile.ZipFile(file) as archive, archive.open(name) as entry:
                content = entry.read(most + 1)
        except KeyError as error:
            raise DataError(f"{file} is no SOG file: there is no {printable(name)} in it; export it again") from error
        except OSError as error:
            raise DataError(f"cannot read {file}: {error.strerror or 'it is damaged'}; copy it again") from error
        except Exception as error:  # zipfile raises BadZipFile, zlib.error, EOFError, NotImplementedError and more
            raise DataError(f"{file} is damaged, or not a SOG file: {printable(name)} cannot be unpacked") from error
        if len(content) > most:
            raise DataError(f"{file} is damaged: {printable(name)} unpacks to more than {most:,} bytes")
        return content

    return read


def _from_folder(folder: Path) -> Read:
    """Return how a file of a folder is read."""

    def read(name: str) -> bytes:
        try:
            return (folder / name).read_bytes()
        except OSError as error:
            raise DataError(f"cannot read {folder / name}: {error.strerror}; copy the folder again") from error

    return read


def _parsed(file: Path, content: bytes) -> dict[str, Any]:
    """Return the content of meta.json, if it is of version 2 and has all parts."""
    try:
        meta = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} is damaged: its {META} is not JSON; export it again") from error
    if not isinstance(meta, dict) or meta.get("version") != 2:
        version = shown(meta.get("version", 1)) if isinstance(meta, dict) else "unknown"
        raise DataError(f"{file} is SOG of version {version}; version 2 can be read: convert it with splat-transform")
    for key in _keys(meta):
        if not isinstance(meta.get(key), dict):
            raise DataError(f"{file} is damaged: its {META} has no '{key}'; export it again")
    return meta


def _keys(meta: dict[str, Any]) -> list[str]:
    """Return the names of the parts; the last is only in files with harmonics."""
    return ["means", "scales", "quats", "sh0", *(["shN"] if meta.get("shN") is not None else [])]


def _names(file: Path, meta: dict[str, Any], key: str, number: int) -> list[str]:
    """Return the names of the images of a part, which are files beside meta.json."""
    names = meta[key].get("files")
    if not isinstance(names, list) or len(names) != number or not all(_is_plain(name) for name in names):
        raise DataError(f"{file}: the files of '{key}' are {shown(names)}; they must be {number} names of images")
    return names


def _is_plain(name: object) -> bool:
    """Return whether a name is a file's in the same folder."""
    return isinstance(name, str) and name.isprintable() and name not in ("", ".", "..") and not set(name) & set("/\\:")


def _count(file: Path, meta: dict[str, Any], size: int) -> int:
    """Return the number of Gaussians, if images of `size` bytes can hold them."""
    count = meta.get("count")
    if type(count) is not int or not 0 < count <= MAX_PER_BYTE * size:
        raise DataError(f"{file} is damaged: it states {shown(count)} Gaussians in {size:,} bytes; export it again")
    return count


def _numbers(file: Path, part: dict[str, Any], key: str, number: int) -> np.ndarray:
    """Return finite numbers (number,) float64."""
    values = part.get(key)
    if isinstance(values, list) and len(values) == number and all(type(value) in (int, float) for value in values):
        try:
            found = np.array([float(value) for value in values])
        except OverflowError:
            found = np.full(number, np.inf)
        if np.isfinite(found).all():
            return found
    raise DataError(f"{file}: '{key}' of its {META} is {shown(values)}; it must be {number} numbers")


def _codes(file: Path, meta: dict[str, Any], key: str) -> np.ndarray:
    """Return a codebook (CODES,) float64. Early programs wrote null instead of its first number.

    PlayCanvas's engine (src/scene/gsplat/gsplat-sog-data.js) puts it a step before the second, and so do we.
    """
    values = meta[key].get("codebook")
    if not isinstance(values, list) or values[:1] != [None]:
        return _numbers(file, meta[key], "codebook", CODES)
    others = _numbers(file, {"codebook": values[1:]}, "codebook", CODES - 1)
    with np.errstate(over="ignore"):  # values that are not finite are removed later
        return np.concatenate([others[:1] + (others[0] - others[-1]) / (CODES - 1), others])


def _pixels(file: Path, content: bytes, count: int, width: int | None = None) -> np.ndarray:
    """Return the pixels of an image.

    Args:
        file: path of the SOG file, for messages.
        content: the image file.
        count: number of pixels that are needed.
        width: the width that the image must have; None for any.

    Returns:
        (count, 4) uint8.

    Raises:
        DataError: if the image cannot be read, or has another size.
    """
    wide, high = _stated_size(content)
    if not wide:
        raise DataError(f"{file}: one of its images is neither WebP without loss nor PNG; export it again")
    if not count <= wide * high <= 4 * count + MARGIN or width not in (None, wide):
        raise DataError(
            f"{file} is damaged: an image of {wide}x{high} pixels cannot hold {count:,}, or is far too large;"
            " export it again"
        )
    try:
        with Image.open(io.BytesIO(content), formats=("WEBP", "PNG")) as image:
            pixels = np.asarray(image.convert("RGBA")).reshape(-1, 4)
        if len(pixels) != wide * high:
            raise ValueError("another size than its header states")
    except Exception as error:  # Pillow raises OSError, SyntaxError, EOFError, DecompressionBombError and more
        raise DataError(f"{file} is damaged: one of its images cannot be read; copy or export it again") from error
    return pixels[:count]


def _stated_size(content: bytes) -> tuple[int, int]:
    """Return width and height in the header of a WebP (RFC 9649) or PNG image; 0 and 0 if it is neither.

    Pillow allocates memory for a WebP image before anybody can ask for its size.
    """
    if content[:4] == b"RIFF" and content[8:16] == b"WEBPVP8L":
        bits = int.from_bytes(content[21:25], "little")
        return (bits & 16383) + 1, (bits >> 14 & 16383) + 1
    if content[:4] == b"RIFF" and content[8:16] == b"WEBPVP8X":
        return int.from_bytes(content[24:27], "little") + 1, int.from_bytes(content[27:30], "little") + 1
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    return 0, 0


def _rotations(file: Path, pixels: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) w, x, y, z."""
    if not (pixels[:, 3] >= FIRST_PLACE).all():
        raise DataError(
            f"{file} is damaged: rotations have an alpha below {FIRST_PLACE}, as images compressed with loss have;"
            " export it again"
        )
    return joined(pixels[:, 3] - FIRST_PLACE, (pixels[:, :3].astype(np.float64) / 127.5 - 1) / math.sqrt(2))


def _harmonics(file: Path, meta: dict[str, Any], contents: list[bytes], count: int) -> Tensor:
    """Return harmonics (N, 3, K) from the palette and the labels."""
    part = meta["shN"]
    entries, bands = part.get("count"), part.get("bands")
    if type(entries) is not int or not 0 < entries <= MAX_ENTRIES or type(bands) is not int or not 0 < bands <= 3:
        raise DataError(
            f"{file} is damaged: it states {shown(entries)} harmonics of degree {shown(bands)}; there must be up to"
            f" {MAX_ENTRIES:,}, and the degree 1, 2 or 3: export it again"
        )
    terms = DEGREES[bands]
    rows = -(-entries // PER_ROW)
    palette = _pixels(file, contents[0], PER_ROW * terms * rows, PER_ROW * terms)[:, :3]
    labels = _pixels(file, contents[1], count).astype(np.int64) @ np.array([1, 256, 0, 0])
    if int(labels.max()) >= entries:
        raise DataError(f"{file} is damaged: a Gaussian has harmonics {int(labels.max()):,} of {entries:,}")
    values = _codes(file, meta, "shN")[palette.reshape(-1, terms, 3)].astype(np.float32)
    return as_float32(values.transpose(0, 2, 1)[labels])


def _look(file: Path, meta: dict[str, Any]) -> Look:
    """Return the settings of drawing."""
    extras = meta.get("extras")
    lines = extras.get(COMMENTS) if isinstance(extras, dict) else None
    texts = [line for line in lines if isinstance(line, str)] if isinstance(lines, list) else []
    look, model = look_of(texts, file, ELSEWHERE), meta.get("model", "default")
    if model == "2dgs":
        raise discs(file)
    if model not in ("default", "antialiased"):
        say(f"warning: {file} is of the model {shown(model)}, which is not known: drawn as 'default'")
    return replace(look, antialiased=model == "antialiased" or meta.get("antialias") is True)
