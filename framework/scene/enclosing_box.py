"""Bounding box of matter of unknown size and position, from silhouettes of images that show all of it.

The bounding rectangle of an image's opaque pixels gives four planes through the camera, with all matter on the inner
side of each. If matter reaches a border of the image, it may continue outside; then only the plane opposite that border
is used. If it reaches two adjacent or opposite borders, no plane of the image is used. The planes of all images bound a
convex polytope, and the result is the bounding box of its vertices. If a camera shows only a part of the matter, all
matter is assumed to be in front of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import nearest_point
from nerfloom.kernels.native import torch_on_one_thread

REACH = 3.0
"""Half the side of the cube that is assumed to hold all matter, around the point that cameras look at, relative to the
largest distance of a camera from that point. A box that reaches the cube's faces counts as unknown."""
ROUNDING = 1e-9
"""Tolerated distance of a vertex outside a plane, from rounding, relative to the distance of the farthest camera."""
TOLERANCE = (2.0, 0.1)
"""Tolerated extent of matter beyond the box in an image, in pixels and as a fraction of the matter's size:
pixels at its edge count as fully opaque, and poses are not exact."""

MIN_SHARE_LARGER = 0.25
"""Matter is larger than the images if at least this fraction of images have matter at opposite borders."""


@torch.no_grad()
def enclosing_box(cameras: Cameras, opaque: Sequence[Tensor], within: Tensor | None = None) -> Tensor | None:
    """Return the smallest box (2, 3) float64 that holds all matter, from the images' rectangles of opaque pixels.

    Args:
        cameras: M central cameras: all rays of a camera start at one point.
        opaque: for each camera, the pixels (H, W) bool that are not fully transparent.
        within: box (2, 3) that holds all matter; None if none is known.

    Returns:
        Minimum and maximum corner. None if the images, without `within`, leave the matter unbounded, or if they
        contradict each other, for example when no image shows all of several objects.
    """
    with torch_on_one_thread():  # the operations are small
        return _enclosing_box(cameras, opaque, within)


def is_larger(opaque: Sequence[Tensor]) -> bool:
    """Return whether matter, `opaque` (H, W) in each image, touches opposite borders of `MIN_SHARE_LARGER`."""
    across = [bool(mask[:, 0].any() & mask[:, -1].any() | mask[0].any() & mask[-1].any()) for mask in opaque]
    return sum(across) >= MIN_SHARE_LARGER * len(across)


def _enclosing_box(cameras: Cameras, opaque: Sequence[Tensor], within: Tensor | None) -> Tensor | None:
    images = [index for index, mask in enumerate(opaque) if bool(mask.any()) and not bool(mask.all())]
    found = [(index, extent) for index in images if (extent := _extent(cameras, index, opaque[index])) is not None]
    if not found:
        return None
    extents = torch.stack([extent for _, extent in found])
    ends = torch.stack([_ends(opaque[index]) for index, _ in found])
    poses = cameras.camera_to_worlds[[index for index, _ in found]].double().cpu()
    origins = poses[:, :, 3]
    middle = nearest_point(origins, -poses[:, :, 2])
    unit = float((origins - middle).norm(dim=-1).max())
    if not 0 < unit < torch.inf:
        return None
    poses = torch.cat([poses[:, :, :3], (origins - middle)[..., None] / unit], -1)  # keeps rounding relative
    limits = poses.new_tensor([[-REACH] * 3, [REACH] * 3]) if within is None else (within.double() - middle) / unit
    vertices = _vertices(*_planes(poses, extents, ends, limits))
    if not len(vertices) or (within is None and bool((vertices.abs() > REACH * (1 - ROUNDING)).any())):
        return None
    box = torch.stack([vertices.amin(0), vertices.amax(0)])
    pixels = 1 / torch.stack([cameras.fx, cameras.fy]).amin(0)[[index for index, _ in found]].double()
    slack = TOLERANCE[0] * pixels[:, None] + TOLERANCE[1] * (extents[:, 1] - extents[:, 0])
    certain = torch.stack([extents[:, 0] + slack, extents[:, 1] - slack], 1)
    return box * unit + middle if _explains(box, poses, certain, ends) else None


def _ends(opaque: Tensor) -> Tensor:
    """Return whether all matter ends within the image: left and below (first row), right and above."""
    left, right, top, bottom = (side.any() for side in (opaque[:, 0], opaque[:, -1], opaque[0], opaque[-1]))
    across, down = ~(top | bottom), ~(left | right)  # matter that continues upwards may be wider there
    return torch.stack([across & ~left, down & ~bottom, across & ~right, down & ~top]).view(2, 2)


def _extent(cameras: Cameras, index: int, opaque: Tensor) -> Tensor | None:
    """Return the smallest and largest x / -z and y / -z (2, 2) of rays through opaque pixels; None without such rays.

    They are computed at the pixels' corners. Along a row, x / -z grows with the column for every lens, so the first and
    the last opaque pixel of each row suffice. The same holds for columns.
    """
    rows, columns = opaque.any(1).nonzero().squeeze(1), opaque.any(0).nonzero().squeeze(1)
    across, down = opaque[rows].to(torch.uint8), opaque[:, columns].to(torch.uint8)
    first, last = across.argmax(1), opaque.shape[1] - 1 - across.flip(1).argmax(1)
    top, bottom = down.argmax(0), opaque.shape[0] - 1 - down.flip(0).argmax(0)
    ends = ((first, rows), (last, rows), (columns, top), (columns, bottom))
    at = torch.cat([torch.stack(pair, -1) for pair in ends]).to(torch.float64)
    corners = torch.tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]], dtype=torch.float64)
    at = (at[:, None] + corners).view(-1, 2)
    _, _, rays = cameras.look(torch.full((len(at),), index), at[:, 0], at[:, 1])
    ahead = -rays.directions[:, 2].double()
    if not bool(rays.valid.all()) or not bool((ahead > 0).all()):
        return None
    tangents = rays.directions[:, :2].double() / ahead[:, None]
    return torch.stack([tangents.amin(0), tangents.amax(0)])


def _planes(poses: Tensor, extents: Tensor, ends: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals (P, 3) and offsets (P,) of planes with all matter at normal . x <= offset, box planes included.

    Args:
        poses: (M, 3, 4) camera-to-world.
        extents: (M, 2, 2) smallest and largest x / -z and y / -z of matter.
        ends: (M, 2, 2) bool, whether matter ends within the image on that side.
        box: (2, 3) minimum and maximum corner of a box around all matter.
    """
    axes = torch.eye(3, dtype=poses.dtype)
    local = torch.stack(
        [sign * (axes[:2] + extents[:, side, :, None] * axes[2]) for side, sign in ((0, -1), (1, 1))], 1
    )
    normals = torch.nn.functional.normalize(local @ poses[:, None, :, :3].transpose(2, 3), dim=-1)
    offsets = (normals * poses[:, None, None, :, 3]).sum(-1)
    return torch.cat([normals[ends], axes, -axes]), torch.cat([offsets[ends], box[1], -box[0]])


def _vertices(normals: Tensor, offsets: Tensor) -> Tensor:
    """Return the vertices (V, 3) of the polytope normal . x <= offset, from the lines where two planes meet.

    The polytope is enlarged by `ROUNDING`, so that rounding excludes nothing.
    """
    offsets = offsets + ROUNDING
    a, b = torch.combinations(torch.arange(len(normals))).unbind(1)
    along = torch.linalg.cross(normals[a], normals[b])
    size = along.norm(dim=-1, keepdim=True)
    crossing = size[:, 0] > ROUNDING  # the others are parallel
    a, b, along, size = a[crossing], b[crossing], along[crossing], size[crossing]
    along = along / size
    first = offsets[a, None] * torch.linalg.cross(normals[b], along) + offsets[b, None] * torch.linalg.cross(
        along, normals[a]
    )
    start = first / size
    slopes, rooms = along @ normals.T, offsets - start @ normals.T
    ends = rooms / slopes
    last = torch.where(slopes > ROUNDING, ends, torch.inf).amin(1)
    begin = torch.where(slopes < -ROUNDING, ends, -torch.inf).amax(1)
    parallel = ((slopes.abs() > ROUNDING) | (rooms >= -ROUNDING)).all(1)
    left = parallel & (begin <= last)
    return torch.cat([start[left] + t[left, None] * along[left] for t in (begin, last)])


def _explains(box: Tensor, poses: Tensor, extents: Tensor, ends: Tensor) -> bool:
    """Return whether a box (2, 3) is consistent with all images: it covers the matter that each of them shows.

    `poses`, `extents` (here without the uncertain margins) and `ends` are as in `_planes`.
    """
    corners = torch.stack(torch.meshgrid(*box.T, indexing="ij"), -1).view(-1, 3)
    local = (corners - poses[:, None, :, 3]) @ poses[:, :, :3]
    ahead = (local[..., 2] < 0).all(1)
    tangents = local[..., :2] / -local[..., 2:].clamp(max=-1e-12)
    covered = ((tangents.amin(1) <= extents[:, 0]) & (tangents.amax(1) >= extents[:, 1])).all(-1)
    whole = ends.flatten(1).all(1)
    return bool((covered & ahead | whole & ~ahead).all())  # from within the box, no constraint
