"""Gaussians in PLY files, in the layout of the code of 3D Gaussian Splatting (Kerbl et al. 2023).

A vertex is a Gaussian, and its properties are parameters before their activations: centre x, y, z; normals nx, ny, nz,
which are 0 and which readers ignore; f_dc_0 to f_dc_2, the coefficients of degree 0; f_rest_0 to f_rest_(3K-1), those
of higher degrees, all of red before all of green before all of blue; opacity (before the sigmoid); scale_0 to scale_2
(logarithms); rot_0 to rot_3 (a quaternion w, x, y, z).

Harmonics have the order and the signs of `framework.kernels.spherical_harmonics`, and are evaluated at the direction
from the camera to the Gaussian: in utils/sh_utils.py of https://github.com/graphdeco-inria/gaussian-splatting degree 1
is -C1 y, C1 z, -C1 x with C1 = 0.4886025119029199, and degrees 2 and 3 are equal too for unit directions, constant by
constant (Sloan 2008, with the Condon-Shortley phase). So coefficients are stored as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from framework.base.console import say
from framework.base.errors import DataError
from framework.data.ply import header_text, read_columns, read_header, write_columns
from framework.splats.gaussians import MAX_DEGREE, Gaussians

SURE = 16.0
"""Logit that stands for an opacity of 1, whose logit is infinite; other programs write it so. -SURE stands for 0."""
TERMS = {0: 0, 9: 3, 24: 8, 45: 15, 72: 24}
"""Number of properties f_rest to coefficients a channel."""
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


def ply_size(count: int, terms: int) -> int:
    """Return the size of a file in bytes.

    Args:
        count: number of Gaussians.
        terms: coefficients of degrees 1 and higher for each channel.
    """
    names = property_names(terms)
    return len(header_text(count, [(name, "float") for name in names])) + 4 * len(names) * count


def write_ply(file: Path, gaussians: Gaussians) -> None:
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
    write_columns(file, list(zip(property_names(gaussians.harmonics.shape[2]), values, strict=True)))


def read_ply(file: Path) -> Gaussians:
    """Read Gaussians from a PLY file, in any order of properties, with others besides, ascii or binary.

    Gaussians with parameters that are not finite, or without a rotation, are left out, which is said on the terminal.
    An infinite opacity, as other programs write it for an opaque Gaussian, becomes `SURE`. Degree 4 is left out.
    Centres that the file holds in double precision, as of a survey, stay in it.

    Args:
        file: path of the PLY file.

    Raises:
        DataError: if the file cannot be read, is not a PLY file, has no Gaussians or is truncated.
    """
    header = read_header(file)
    names = set(header.names)
    needed = (*_DC, "opacity", *_SCALES, *_ROTATIONS)
    if missing := [name for name in needed if name not in names]:
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
    wanted = min(terms, (MAX_DEGREE + 1) ** 2 - 1)
    if wanted < terms:
        say(f"{file}: harmonics above degree {MAX_DEGREE} are left out")
    kept = [f"f_rest_{channel * terms + term}" for channel in range(3) for term in range(wanted)]
    named = ["x", "y", "z", *_DC, *kept, "opacity", *_SCALES, *_ROTATIONS]
    columns = dict(zip(named, read_columns(file, header, named), strict=True))

    def together(names: Sequence[str], kind: str = "f4") -> Tensor:
        values = np.empty((header.count, len(names)), kind)
        with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is left out below
            for index, name in enumerate(names):
                values[:, index] = columns[name]
        return torch.from_numpy(values)

    gaussians = Gaussians(
        means=together("xyz", "f8" if dict(header.columns)["x"] == "f8" else "f4"),
        log_scales=together(_SCALES),
        rotations=together(_ROTATIONS),
        logits=_finite_logits(together(["opacity"])[:, 0]),
        colors=together(_DC),
        harmonics=together(kept).reshape(header.count, 3, wanted),
    )
    return usable(gaussians, file)


def _finite_logits(logits: Tensor) -> Tensor:
    return torch.where(logits.isinf(), SURE * logits.sign(), logits)


def usable(gaussians: Gaussians, file: Path) -> Gaussians:
    """Return those Gaussians that can be rendered; how many cannot is said on the terminal.

    Args:
        gaussians: those that a file holds.
        file: its path, for messages.

    Raises:
        DataError: if there is none.
    """
    lengths = gaussians.rotations.norm(dim=-1)
    good = gaussians.finite() & gaussians.log_scales.exp().isfinite().all(-1) & lengths.isfinite() & (lengths > 0)
    if not bool(good.any()):
        what = f"none of its {len(gaussians):,} Gaussians is finite" if len(gaussians) else "it holds no Gaussians"
        raise DataError(f"{file}: {what}; export it again")
    if bool(good.all()):
        return gaussians
    say(f"{file}: {int((~good).sum()):,} of {len(gaussians):,} Gaussians are not finite and are left out")
    return gaussians[good]
