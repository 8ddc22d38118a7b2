"""Projection matrices: their intrinsics and poses, and the size of the images that they were made for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.base.console import say

SINGULAR = 1e-10
"""Minimum determinant of a matrix with an inverse, relative to the product of its rows' lengths."""
FACTORS = (1, 1 / 2, 2, 1 / 3, 3, 1 / 4, 4, 1 / 6, 6, 1 / 8, 8)
"""Sizes that are tried, relative to the images'."""
OFF_CENTRE = 1.1
"""Maximum factor between the median principal point and the centre of the images. Its square is less than the factor
between two neighbours in `FACTORS`, so at most one of them is plausible."""
MOST_SKEW = 0.5
"""Maximum displacement of a pixel by a skew that is left out, pixels."""
REPORTED_SKEW = 0.01
"""Minimum displacement of a skew that is reported, pixels."""


@dataclass(frozen=True)
class Projections:
    """M projections in parts."""

    intrinsics: Tensor
    """(M, 4) float64 fx, fy, cx, cy, pixels, in the matrices' coordinates of pixels."""
    skews: Tensor
    """(M,) float64, pixels to the right per unit of y / z."""
    poses: Tensor
    """(M, 4, 4) float64 camera-to-world, OpenGL axes."""


def factored(matrices: Tensor, labels: Sequence[str]) -> Projections:
    """Return intrinsics K and poses R, t of projections K [R | t].

    K is upper triangular with a positive diagonal, by an RQ decomposition; it is unique (Hartley and Zisserman 2004,
    section 6.2.4). A matrix and its negative are the same projection.

    Args:
        matrices: (M, 3, 4) float64, from homogeneous positions to homogeneous pixels.
        labels: M names for messages.

    Raises:
        DataError: if a matrix is not finite, or singular: a camera at infinity, or none.
    """
    for matrix, label in zip(matrices, labels, strict=True):
        if not bool(matrix.isfinite().all()):
            raise DataError(f"{label} has entries that are not finite; correct the matrix")
    lengths = matrices[:, :, :3].norm(dim=-1, keepdim=True)
    rows = matrices / lengths.clamp(min=torch.finfo(torch.float64).tiny)
    volumes = torch.linalg.det(rows[:, :, :3])
    if bool((~(volumes.abs() > SINGULAR)).any()):
        worst = labels[int(volumes.abs().argmin())]
        raise DataError(f"{worst} is singular, so it is not a camera's projection; correct the matrix")
    matrices = matrices * (volumes.sign()[:, None, None] / lengths[:, 2:])
    # With J, which reverses rows: (J M)^T = Q U, so M = (J U^T J) (J Q^T), upper triangular times orthonormal.
    left, upper = torch.linalg.qr(matrices[:, :, :3].flip(1).mT)
    signs = upper.diagonal(dim1=1, dim2=2).sign()
    intrinsic = (upper.mT * signs[:, None]).flip(1, 2)
    rotations = (signs[:, :, None] * left.mT).flip(1)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(matrices), 1, 1)
    poses[:, :3, :3] = rotations.mT * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    poses[:, :3, 3] = -torch.linalg.solve(matrices[:, :, :3], matrices[:, :, 3])
    (fx, skews, cx), (_, fy, cy) = (row.unbind(-1) for row in intrinsic[:, :2].unbind(1))  # the third row ends in 1
    return Projections(torch.stack([fx, fy, cx, cy], -1), skews, poses)


def size_made_for(
    principal: Tensor, images: Tensor, stated: tuple[float, float] | None, width: int | None, where: str
) -> tuple[Tensor, str]:
    """Return the sizes of the images that intrinsics were made for, and a clause that says where they come from.

    The principal point lies near the centre of an image, which tells a size from its double.

    Args:
        principal: (M, 2) principal points, pixels.
        images: (M, 2) int64 width and height of the image files.
        stated: width and height that the file states; used if the principal points agree.
        width: the width that the user states, which is not questioned; None to find it.
        where: name of the cameras' file.

    Returns:
        Width and height (M, 2) int64, and the reason.

    Raises:
        DataError: if no plausible size is found.
    """
    if width is not None:
        return (images * (width / images[:, :1])).round().long().clamp(min=1), "by --camera-width"
    centre = principal.median(0).values

    def plausible(sizes: Tensor) -> bool:
        ratios = (principal / (sizes / 2)).median(0).values
        return bool((ratios < OFF_CENTRE).all()) and bool((ratios > 1 / OFF_CENTRE).all())

    if stated is not None and plausible(torch.tensor([stated])):
        return torch.tensor([stated]).round().long().expand_as(images), "by its camera_mat"
    for factor in FACTORS:
        if plausible(images * factor):
            return (images * factor).round().long(), "by their principal points"
    column, row, (across, down) = *centre.tolist(), images[0].tolist()
    raise DataError(
        f"{where}: the principal point is ({column:.4g}, {row:.4g}), but images are {across}x{down} pixels: it is not "
        "near the centre of any likely size; if that is right, name the width that cameras were made for: "
        "--camera-width PIXELS"
    )


def check_skew(skews: Tensor, intrinsics: Tensor, sizes: Tensor, labels: Sequence[str], quiet: bool) -> None:
    """Report a skew that displaces pixels by at most half a pixel, as cameras here have none; refuse a larger one.

    Args:
        skews: (M,) pixels to the right per unit of y / z.
        intrinsics: (M, 4) fx, fy, cx, cy, pixels.
        sizes: (M, 2) width and height of the images that these are for.
        labels: M names for messages.
        quiet: whether to report nothing.

    Raises:
        DataError: if pixels at an image's upper or lower edge would be displaced by more than half a pixel.
    """
    _, fy, _, cy = intrinsics.unbind(-1)
    shifts = (skews * torch.maximum(cy, sizes[:, 1] - cy) / fy).abs()
    worst = int(shifts.argmax())
    shift = float(shifts[worst])
    if not shift <= MOST_SKEW:
        raise DataError(
            f"{labels[worst]} has a skew that displaces pixels by {shift:.3g}; resample the images so that their "
            "cameras have none"
        )
    if shift > REPORTED_SKEW and not quiet:
        say(f"{labels[worst]} has a skew, which is left out: it displaces pixels by at most {shift:.2g}")
