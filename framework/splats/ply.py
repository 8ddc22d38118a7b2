"""Gaussians in PLY files, in the layout of the code of 3D Gaussian Splatting (Kerbl et al. 2023).

A vertex is a Gaussian, and its properties are parameters before their activations: centre x, y, z; normals nx, ny, nz,
which are 0 and ignored by readers; f_dc_0 to f_dc_2, the coefficients of degree 0; f_rest_0 to f_rest_(3K-1), the
coefficients of higher degrees, all of red before all of green before all of blue; opacity (before the sigmoid); scale_0
to scale_2 (logarithms); rot_0 to rot_3 (a quaternion w, x, y, z).

Mip-Splatting's files also have a property `filter_3D`: the standard deviation of a smoothing filter in space, which
is a part of the Gaussian (Yu et al. 2024, section 4.1). With f for it, scales are sqrt(s^2 + f^2), and opacity is that
stored times the root of the ratio of the products of s^2 and of s^2 + f^2. The reader applies the filter, and images
are antialiased with that method's blur, 0.1 pixels^2 (section 4.2, and kernel_size of its code).

The settings of drawing are stored in comments (`nerfloom.splats.look`).

Harmonics have the order and the signs of `kernels.encodings.spherical_harmonics`, and are evaluated at the direction
from the camera to the Gaussian: in utils/sh_utils.py of https://github.com/graphdeco-inria/gaussian-splatting degree 1
is -C1 y, C1 z, -C1 x with C1 = 0.4886025119029199, and degrees 2 and 3 are equal too for unit directions, constant by
constant (Sloan 2008, with the Condon-Shortley phase). So coefficients are stored as they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.data.ply import PlyElement, PlyHeader, header_text, read_columns, read_header, vertices, write_columns
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.splats.compressed_ply import is_compressed, read_compressed
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians, Splats
from nerfloom.splats.look import ELSEWHERE, OURS, Look, comments, discs, look_of
from nerfloom.splats.stored import MIN_DEVIATION
from nerfloom.splats.stream import GaussianStream

MAX_LOGIT = 16.0
"""Finite logit for an opacity of 1; -MAX_LOGIT for 0. Other programs write infinite logits."""
TERMS = {0: 0, 9: 3, 24: 8, 45: 15, 72: 24}
"""Number of coefficients per channel, by the number of properties f_rest."""
FILTER = "filter_3d"
"""Name of the smoothing filter's property in lower case; programs differ in case."""
MIP_SPLATTING = replace(ELSEWHERE, antialiased=True, blur=0.1)
"""Default settings of drawing for Gaussians with a filter."""
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")


def property_names(terms: int) -> list[str]:
    """Return the names of a Gaussian's properties, in their order in the file.

    Args:
        terms: coefficients of degrees 1 and higher for each channel.
    """
    rest = [f"f_rest_{index}" for index in range(3 * terms)]
    return ["x", "y", "z", "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALES, *_ROTATIONS]


def ply_size(count: int, terms: int, look: Look = OURS) -> int:
    """Return the size of a file in bytes.

    Args:
        count: number of Gaussians.
        terms: coefficients of degrees 1 and higher for each channel.
    """
    names = property_names(terms)
    return (
        len(header_text(count, [(name, "float") for name in names], comments=comments(look))) + 4 * len(names) * count
    )


def write_ply(file: Path, gaussians: Gaussians, look: Look = OURS) -> None:
    """Write Gaussians to a binary PLY file, little endian, float32.

    Args:
        file: path of the PLY file.
        gaussians: N Gaussians on the CPU.

    Raises:
        OSError: if the file cannot be written.
    """
    normals = gaussians.means.new_zeros(1, 1).expand(len(gaussians), 3)
    rest = gaussians.harmonics.flatten(1)
    parts = (
        gaussians.means, normals, gaussians.colors, rest, gaussians.logits[:, None], gaussians.log_scales,
        gaussians.rotations,
    )  # fmt: skip
    values = [column for part in parts for column in part.detach().numpy().T]
    columns = list(zip(property_names(gaussians.harmonics.shape[2]), values, strict=True))
    write_columns(file, columns, comments=comments(look))


def read_ply(file: Path) -> Splats:
    """Read Gaussians from a PLY file: ascii, binary or compressed, with properties in any order.

    Gaussians with parameters that are not finite, or with a zero rotation, are removed, with a message on the terminal.
    An infinite opacity, which other programs write for opaque Gaussians, becomes `MAX_LOGIT`. Degree 4 is dropped.
    Centres in double precision stay so.

    Args:
        file: path of the PLY file.

    Raises:
        DataError: if the file cannot be read, is not a PLY file, has no 3D Gaussians or is truncated.
    """
    header = read_header(file)
    if is_compressed(header):
        return Splats(usable(read_compressed(file, header), file), look_of(header.comments, file))
    vertex = vertices(file, header)
    gaussians = _stored(file, vertex)
    look = _described(file, header, vertex)
    return Splats(usable(gaussians, file), look)


def stream_ply(file: Path) -> GaussianStream:
    """Return the Gaussians of a PLY file as `read_ply` does, in parts that are read when they are needed.

    Gaussians that are not finite are not removed. A file that is ascii or compressed is read as a whole.

    Args:
        file: path of the PLY file.

    Raises:
        DataError: as `read_ply`; if the file is truncated, its parts raise it.
    """
    header = read_header(file)
    if is_compressed(header) or vertices(file, header).order == "ascii":
        return GaussianStream.of(read_ply(file))
    vertex = vertices(file, header)
    return GaussianStream(partial(_parts, file, vertex), _described(file, header, vertex))


def _parts(file: Path, vertex: PlyElement, most: int) -> Iterator[Gaussians]:
    """Yield the Gaussians in the vertices of a binary file, at most `most` at a time."""
    row = vertex.row().itemsize
    for first in range(0, vertex.count, most):
        yield _stored(file, replace(vertex, count=min(most, vertex.count - first), start=vertex.start + first * row))


def _described(file: Path, header: PlyHeader, vertex: PlyElement) -> Look:
    """Return the settings of drawing, and report changes made when reading the vertices of a file."""
    if sum(name.startswith("f_rest_") for name in vertex.names) > 3 * DEGREES[MAX_DEGREE]:
        say(f"{file}: harmonics above degree {MAX_DEGREE} are left out")
    if _filters(vertex):
        say(f"{file}: Mip-Splatting's filter becomes a part of sizes and opacities")
    return look_of(header.comments, file, MIP_SPLATTING if _filters(vertex) else ELSEWHERE)


def _filters(vertex: PlyElement) -> list[str]:
    """Return the name of the property with Mip-Splatting's filter, if there is one."""
    return [name for name in vertex.names if name.lower() == FILTER][:1]


def smoothed(gaussians: Gaussians, filters: Tensor) -> Gaussians:
    """Return Gaussians smoothed by a filter in space, with opacity lowered to compensate (Mip-Splatting).

    Args:
        gaussians: N Gaussians.
        filters: (N,) standard deviations of the filters.
    """
    squares = (2 * gaussians.log_scales.double()).exp().clamp(min=1e-300)  # its logarithm is finite
    larger = squares + filters.double().square()[:, None]
    shares = (squares.log() - larger.log()).sum(1).mul(0.5).exp()
    opacity = torch.sigmoid(gaussians.logits.double()) * shares
    return replace(
        gaussians,
        log_scales=(larger.log() / 2).to(gaussians.log_scales),
        logits=torch.logit(opacity).clamp(-MAX_LOGIT, MAX_LOGIT).to(gaussians.logits),
    )


def _stored(file: Path, vertex: PlyElement) -> Gaussians:
    """Return the Gaussians in the vertices of a file, with their filter applied."""
    names = set(vertex.names)
    needed = (*_DC, "opacity", *_SCALES, *_ROTATIONS)
    missing = [name for name in needed if name not in names]
    if missing == [_SCALES[2]]:
        raise discs(file)
    if missing:
        raise DataError(
            f"{file} has points, but no Gaussians: {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing;"
            " name a PLY file of Gaussian splatting"
        )
    count = sum(name.startswith("f_rest_") for name in names)
    rest = [f"f_rest_{index}" for index in range(count)]
    if count not in TERMS or not names.issuperset(rest):
        raise DataError(
            f"{file} has {count} properties f_rest; harmonics of degree 0 to 4 have f_rest_0 to"
            " f_rest_(n-1), n = 0, 9, 24, 45 or 72: export it again"
        )
    terms = TERMS[count]
    wanted = min(terms, DEGREES[MAX_DEGREE])
    kept = [f"f_rest_{channel * terms + term}" for channel in range(3) for term in range(wanted)]
    filters = _filters(vertex)
    named = ["x", "y", "z", *_DC, *kept, "opacity", *_SCALES, *_ROTATIONS, *filters]
    columns = dict(zip(named, read_columns(file, vertex, named), strict=True))

    def together(names: Sequence[str], kind: type = np.float32) -> Tensor:
        return _together([columns[name] for name in names], kind)

    gaussians = Gaussians(
        means=together("xyz", np.float64 if dict(vertex.columns)["x"] == "f8" else np.float32),
        log_scales=_finite_sizes(together(_SCALES)),
        rotations=together(_ROTATIONS),
        logits=_finite_logits(together(["opacity"])[:, 0]),
        colors=together(_DC),
        harmonics=together(kept).reshape(vertex.count, 3, wanted),
    )
    return smoothed(gaussians, together(filters)[:, 0]) if filters else gaussians


def _together(columns: Sequence[np.ndarray], kind: type = np.float32) -> Tensor:
    """Return columns (N,) side by side, (N, C), of a floating-point type."""
    values: np.ndarray = np.empty((len(columns[0]) if columns else 0, len(columns)), kind)
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 are removed later
        for index, column in enumerate(columns):
            values[:, index] = column
    return torch.from_numpy(values)


def _finite_logits(logits: Tensor) -> Tensor:
    return torch.where(logits.isinf(), MAX_LOGIT * logits.sign(), logits)


def _finite_sizes(log_scales: Tensor) -> Tensor:
    """Return log scales with a finite one for the size 0, which other programs write for flat Gaussians."""
    return log_scales.masked_fill(log_scales == -math.inf, math.log(MIN_DEVIATION))


def usable(gaussians: Gaussians, file: Path) -> Gaussians:
    """Return the Gaussians that can be rendered, and report the number of others on the terminal.

    Args:
        gaussians: all Gaussians of a file.
        file: its path, for messages.

    Raises:
        DataError: if none can be rendered.
    """
    good = gaussians.drawable()
    if not bool(good.any()):
        what = f"none of its {len(gaussians):,} Gaussians is finite" if len(gaussians) else "it holds no Gaussians"
        raise DataError(f"{file}: {what}; export it again")
    if bool(good.all()):
        return gaussians
    say(f"{file}: {int((~good).sum()):,} of {len(gaussians):,} Gaussians are not finite and are left out")
    return gaussians[good]
