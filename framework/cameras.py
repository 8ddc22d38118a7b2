"""Cameras: from a pixel to a ray.

Conventions: OpenGL axes (x right, y up, the camera looks down -z); pixel (column, row) = (0, 0) is the top left
one and its centre lies at (0.5, 0.5); `camera_to_worlds` maps camera to scene coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from framework.errors import DataError
from framework.kernels import native
from framework.rays import Rays

ROTATION_TOLERANCE = 1e-3
LENSES: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "k7"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "equirectangular": (),
    "orthographic": (),
}
"""Projection -> its distortion coefficients. opencv is OpenCV's rational model, k4 to k6 being the denominator's, and
k7 the numerator's r^8, which transforms.json calls k4; fisheye is Kannala and Brandt's, as OpenCV has it."""
CENTER = torch.zeros(1, 2)
"""The one place in a pixel that is its centre, as columns and rows from there."""


@dataclass(frozen=True)
class Cameras:
    """M cameras. Intrinsics are in pixels of the images they go with."""

    camera_to_worlds: Tensor
    """(M, 3, 4) rigid transform from camera to scene."""
    fx: Tensor
    """(M,) horizontal focal length, pixels."""
    fy: Tensor
    """(M,) vertical focal length, pixels."""
    cx: Tensor
    """(M,) principal point's column, pixels."""
    cy: Tensor
    """(M,) principal point's row, pixels."""
    widths: Tensor
    """(M,) int64 image widths."""
    heights: Tensor
    """(M,) int64 image heights."""
    model: str = "pinhole"
    """Name of the projection, a key of `LENSES`."""
    lens: Tensor | None = None
    """(M, K) distortion coefficients, in the order of `LENSES[model]`; None for all zero."""

    def __len__(self) -> int:
        return self.camera_to_worlds.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Cameras:
        """The cameras chosen by a slice, a mask or an index tensor."""
        return self._map(lambda values: values[index])

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on `device`."""
        return self._map(lambda values: values.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        """The same cameras with every tensor changed."""
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {name: change(value) for name, value in known.items() if isinstance(value, Tensor)}
        return replace(self, **changed)

    def scaled(self, factor: float) -> Cameras:
        """The cameras of images resized by `factor` (2.0 = twice as wide).

        Sizes are rounded down as images are when reduced by a whole number.
        """
        intrinsics = {name: getattr(self, name) * factor for name in ("fx", "fy", "cx", "cy")}
        sizes = {name: (getattr(self, name) * factor + 1e-6).long() for name in ("widths", "heights")}
        return replace(self, **intrinsics, **sizes)

    def rays(
        self,
        camera_indices: Tensor,
        columns: Tensor,
        rows: Tensor,
        near: float,
        far: float,
        times: Tensor | None = None,
    ) -> Rays:
        """Rays through pixel centres.

        Args:
            camera_indices: (R,) camera of each ray.
            columns, rows: (R,) pixel indices; may be fractional.
            near, far: the distances between which the scene lies.
            times: (M,) time of each camera.
        Returns: R rays with unit directions, pixel radii, times and camera indices.
        """
        project = PROJECTIONS[self.model]
        x = (columns + 0.5 - self.cx[camera_indices]) / self.fx[camera_indices]
        y = (rows + 0.5 - self.cy[camera_indices]) / self.fy[camera_indices]
        local = project(x, y)
        length = local.norm(dim=-1)
        poses = self.camera_to_worlds[camera_indices]
        # Products and sums rather than a matrix product, which autocast would round to bfloat16.
        directions = (poses[:, :, :3] * (local / length[:, None])[:, None, :]).sum(-1)
        # Mip-NeRF sets the radius to 2 / sqrt(12) pixels, at distance `length` along the unit direction.
        pixel_radii = 2 / 12**0.5 / (self.fx[camera_indices] * length)
        return Rays(
            origins=poses[:, :, 3],
            directions=directions,
            nears=torch.full_like(x, near),
            fars=torch.full_like(x, far),
            pixel_radii=pixel_radii,
            times=None if times is None else times[camera_indices],
            camera_indices=camera_indices,
        )

    @cached_property
    def offsets(self) -> Tensor:
        """(M + 1,) where each camera's pixels start when those of all are counted through, row by row."""
        sizes = (self.widths * self.heights).cumsum(0)
        return torch.cat([torch.zeros_like(sizes[:1]), sizes])

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, places: Tensor = CENTER
    ) -> Rays:
        """Rays through pixels.

        Args:
            flat: (P,) int64 which pixels, counted through all images.
            near, far: the distances between which the scene lies.
            times: (M,) time of each camera.
            places: (K, 2) where in a pixel, columns and rows from its centre.
        Returns: P * K rays, those of a pixel together.
        """
        if self.model == "pinhole" and native.usable(self.camera_to_worlds, self.fx, places):
            return self._pixel_rays_compiled(flat, near, far, times, places)
        return self.pixel_rays_reference(flat, near, far, times, places)

    def pixel_rays_reference(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, places: Tensor = CENTER
    ) -> Rays:
        """As `pixel_rays`, in torch, for any camera and device."""
        indices = torch.searchsorted(self.offsets, flat, right=True) - 1
        within, widths = flat - self.offsets[indices], self.widths[indices]
        places = places.to(self.fx)
        columns = ((within % widths)[:, None] + places[:, 0]).reshape(-1)
        rows = ((within // widths)[:, None] + places[:, 1]).reshape(-1)
        return self.rays(indices.repeat_interleave(len(places)), columns, rows, near, far, times)

    def _pixel_rays_compiled(self, flat: Tensor, near: float, far: float, times: Tensor | None, places: Tensor) -> Rays:
        images, count = len(self), len(flat) * len(places)
        origins, directions, radii = torch.empty(count, 3), torch.empty(count, 3), torch.empty(count)
        indices = torch.empty(count, dtype=torch.int64)
        poses, widths, places = self.camera_to_worlds.contiguous(), self.widths.contiguous(), places.contiguous()
        numbers = {name: getattr(self, name).contiguous() for name in ("fx", "fy", "cx", "cy")}
        _pinhole_rays(
            native.pointer(flat, "pixel indices", (len(flat),), torch.int64), len(flat),
            native.pointer(places, "places in a pixel", (len(places), 2)), len(places),
            native.pointer(self.offsets, "offsets", (images + 1,), torch.int64), images,
            native.pointer(widths, "widths", (images,), torch.int64),
            native.pointer(poses, "poses", (images, 3, 4)),
            *(native.pointer(values, name, (images,)) for name, values in numbers.items()),
            origins.data_ptr(), directions.data_ptr(), radii.data_ptr(), indices.data_ptr(), native.threads(),
        )  # fmt: skip
        return Rays(
            origins,
            directions,
            torch.full((count,), near),
            torch.full((count,), far),
            radii,
            None if times is None else times[indices],
            indices,
        )

    def image_pixels(self, index: int) -> Tensor:
        """(H * W,) the pixels of one image, row by row, counted through all images."""
        start, end = self.offsets[index : index + 2].tolist()
        return torch.arange(start, end, device=self.fx.device)


def subpixels(count: int) -> Tensor:
    """(count, 2) places in a pixel whose mean colour stands for the pixel's: columns and rows from its centre.

    For count = n^2 a square grid, turned so that no two share a row or a column: edges near the axes, where steps show
    most, take count + 1 levels instead of n + 1. The "rotated grid" of graphics hardware is that of n = 2.

    Raises: ValueError where the count is not a square.
    """
    side = math.isqrt(count)
    if side * side != count or count < 1:
        raise ValueError(f"{count} rays a pixel: it must be the square of a whole number")
    steps = torch.arange(count)
    rows = (steps + 1) * side % (count + 1) - 1
    return (torch.stack([steps, rows], dim=-1) + 0.5) / count - 0.5


_pinhole_rays = native.function("pinhole_rays", "pqpqpqpppppp" + "ppppi")


def pinhole(x: Tensor, y: Tensor) -> Tensor:
    """Direction (R, 3) in the camera's frame of normalised image coordinates; image y points down."""
    return torch.stack([x, -y, -torch.ones_like(x)], dim=-1)


PROJECTIONS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"pinhole": pinhole}
"""Projection name -> function from normalised image coordinates to a direction. Lens models are added here."""


def check_pose(pose: Tensor, where: str) -> None:
    """Refuse a camera pose that is not a finite rigid motion.

    Args:
        pose: (4, 4) or (3, 4) camera-to-world matrix.
        where: what to call it in the message.
    Raises: DataError that names `where` and what is wrong.
    """
    if pose.shape not in ((4, 4), (3, 4)):
        raise DataError(f"{where}: the pose has shape {tuple(pose.shape)}; a 4x4 matrix is needed")
    if not bool(torch.isfinite(pose).all()):
        raise DataError(f"{where}: the pose holds a value that is not finite (NaN or infinity)")
    rotation = pose[:3, :3].double()
    error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if pose.shape[0] == 4:
        error = max(error, (pose[3] - torch.tensor([0.0, 0.0, 0.0, 1.0])).abs().max().item())
    if error > ROTATION_TOLERANCE or torch.linalg.det(rotation).item() < 0:
        raise DataError(
            f"{where}: the pose is not rigid (its rotation is off an orthonormal, right-handed one by {error:.2g}); "
            "remove scale, shear or mirroring from the matrix"
        )
