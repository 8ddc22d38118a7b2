"""Cameras: the rays of pixels, and the projection of points.

Conventions: OpenGL axes (x right, y up, the camera looks along -z); pixel (column, row) = (0, 0) is the top left one,
and its centre lies at (0.5, 0.5); `camera_to_worlds` maps camera to scene coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.device import runs_ahead
from nerfloom.base.errors import DataError
from nerfloom.geometry.lenses import DISTORTED, LENSES, Distortion, LensRays, iterations_needed, project, unproject
from nerfloom.geometry.rays import Rays
from nerfloom.geometry.records import TensorRows
from nerfloom.kernels import native
from nerfloom.kernels.argument_checks import check_indices, is_followed
from nerfloom.kernels.dispatch import CPP, Operation

ROTATION_TOLERANCE = 1e-3
"""Maximum deviation of a pose's rotation matrix from an orthonormal one."""
MAX_SIDE = 10**9
"""Maximum width or height that a file may state, pixels; file formats allow up to 2^64."""
CENTER = torch.zeros(1, 2)
"""The pixel's centre as the only sample position, in columns and rows from the centre."""
TESTED_POSITIONS = 9
"""Number of positions tested along each side of an image, edges included, to find the iterations that a lens needs."""
COMPILED = ("pinhole", *DISTORTED)
"""Models with compiled rays, in the order of the kernel's enumeration."""


@dataclass(frozen=True)
class Cameras(TensorRows):
    """M cameras of one model. Intrinsics are in pixels of the corresponding images.

    The unit of a focal length depends on the model: pixels per tangent (pinhole, opencv), per radian (fisheye, and
    equirectangular, see `lenses.panorama`), or per scene unit (orthographic).
    """

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
    """Projection, a key of `LENSES`."""
    lens: Tensor | None = None
    """(M, K) distortion coefficients, in the order of `LENSES[model]`; None if all are zero."""

    def __post_init__(self) -> None:
        if self.model not in LENSES:
            raise ValueError(f"unknown camera model '{self.model}'. Known: {', '.join(LENSES)}")
        names = LENSES[self.model]
        if self.lens is not None and self.lens.shape[-1] != len(names):
            raise ValueError(f"{self.model} takes {len(names)} distortion coefficients, not {self.lens.shape[-1]}")

    def __len__(self) -> int:
        return self.camera_to_worlds.shape[0]

    def in_float64(self) -> Cameras:
        """Return the cameras with all floating-point numbers in float64."""
        return self.map(lambda values: values.double() if values.is_floating_point() else values)

    def scaled(self, factor: float | Tensor) -> Cameras:
        """Return the cameras of resized images.

        Sizes are rounded down, as for images reduced by an integer factor.

        Args:
            factor: new size over old size, of all cameras or (M,) of each; 2.0 doubles the width.
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
        """Return the rays of pixels given by camera, column and row.

        Args:
            camera_indices: (R,) camera of each ray.
            columns, rows: (R,) coordinates of the pixels; integers are pixel centres, and fractions are allowed.
            near, far: distances where the rays start and end.
            times: (M,) time of each camera.

        Returns:
            R rays with unit directions, pixel radii, times and camera indices.
        """
        x, y, rays = self.look(camera_indices, columns, rows)
        poses = self.camera_to_worlds[camera_indices]
        origins = poses[:, :, 3]
        # Products and sums, because autocast would round a matrix product to bfloat16.
        directions = (poses[:, :, :3] * rays.directions[:, None, :]).sum(-1)
        if self.model == "orthographic":
            origins = origins + poses[:, :, 0] * x[:, None] - poses[:, :, 1] * y[:, None]
        # Mip-NeRF's radius is 2 / sqrt(12) pixels. For parallel rays, the radius is the same at all distances.
        pixel_radii = 2 / 12**0.5 / self.fx[camera_indices] * rays.spread
        return Rays(
            origins=origins,
            directions=directions,
            nears=torch.full_like(x, near),
            fars=torch.full_like(x, far),
            pixel_radii=pixel_radii,
            times=None if times is None else times[camera_indices],
            camera_indices=camera_indices,
            parallel=self.model == "orthographic",
        )

    def look(self, camera_indices: Tensor, columns: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, LensRays]:
        """Return the image-plane coordinates of pixels, and their directions in the camera's frame.

        Args:
            camera_indices: (R,) camera of each pixel.
            columns, rows: (R,) coordinates of the pixels, as `rays` takes them.

        Returns:
            Normalised image coordinates x and y (R,), and the rays there.
        """
        x = (columns + 0.5 - self.cx[camera_indices]) / self.fx[camera_indices]
        y = (rows + 0.5 - self.cy[camera_indices]) / self.fy[camera_indices]
        lenses = None if self.distortion is None else self.distortion[camera_indices]
        return x, y, unproject(self.model, x, y, lenses)

    def project(self, points: Tensor, camera: int | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points to pixels; the inverse of `rays`.

        Args:
            points: (N, 3) scene coordinates.
            camera: index of one camera, or (N,) of one for each point.

        Returns:
            columns and rows (N,) as `rays` takes them, also outside the image, and (N,) bool, whether the point lies in
            front of the camera and within the lens's reach. Where it does not, columns and rows are finite but
            meaningless.
        """
        indices = torch.as_tensor(camera, device=points.device).expand(len(points))
        poses = self.camera_to_worlds[indices]
        local = (poses[:, :, :3] * (points - poses[:, :, 3])[:, :, None]).sum(1)
        x, y, in_front = project(self.model, local, None if self.distortion is None else self.distortion[indices])
        columns = x * self.fx[indices] + self.cx[indices] - 0.5
        return columns, y * self.fy[indices] + self.cy[indices] - 0.5, in_front

    @cached_property
    def distortion(self) -> Distortion | None:
        """The lenses' distortion, or None for a model without."""
        if self.model not in DISTORTED:
            return None
        lens = self.fx.new_zeros(len(self), len(LENSES[self.model])) if self.lens is None else self.lens
        found = Distortion.of(self.model, lens)
        return replace(found, iterations=self._iterations(found)) if runs_ahead(lens.device) else found

    def _iterations(self, lenses: Distortion) -> int:
        """Return the number of iterations of `undistort` that suffices for all pixels, so that no step has to check."""
        shares = torch.linspace(0, 1, TESTED_POSITIONS, device=self.fx.device)
        x = (self.widths[:, None] * shares - self.cx[:, None]) / self.fx[:, None]
        y = (self.heights[:, None] * shares - self.cy[:, None]) / self.fy[:, None]
        u, v = (part.to(lenses.reach).flatten() for part in torch.broadcast_tensors(x[:, :, None], y[:, None]))
        return iterations_needed(u, v, lenses[torch.arange(len(u), device=u.device) // TESTED_POSITIONS**2])

    @cached_property
    def offsets(self) -> Tensor:
        """(M + 1,) index of each camera's first pixel; pixels of all images are numbered consecutively, row by row."""
        sizes = (self.widths * self.heights).cumsum(0)
        return torch.cat([torch.zeros_like(sizes[:1]), sizes])

    @cached_property
    def ends(self) -> list[int]:
        """`offsets` in Python, read once from the device."""
        return self.offsets.tolist()

    @cached_property
    def sizes(self) -> list[list[int]]:
        """Height and width of each camera's image in Python, read once from the device."""
        return torch.stack([self.heights, self.widths], dim=-1).tolist()

    @cached_property
    def intrinsics(self) -> list[list[float]]:
        """Each camera's fx, fy, cx and cy in Python, read once from the device."""
        return torch.stack([self.fx, self.fy, self.cx, self.cy], dim=-1).tolist()

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        """Return the rays of pixels given by consecutive number.

        Args:
            flat: (P,) int64 numbers of the pixels, consecutive over all images.
            near, far: distances where the rays start and end.
            times: (M,) time of each camera.
            subpixels: (K, 2) positions in a pixel, in columns and rows from its centre.

        Returns:
            P * K rays, with the K rays of a pixel consecutive, and a gradient for poses and intrinsics that require
            one.

        Raises:
            IndexError: if a number exceeds the number of pixels.
        """
        numbers = self.camera_to_worlds, self.fx, self.fy, self.cx, self.cy, subpixels
        return CAMERA_RAYS(numbers, self, flat, near, far, times, subpixels)

    def pixel_rays_reference(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        """Compute `pixel_rays` in PyTorch, for any camera and device.

        `flat`, `near`, `far`, `times` and `subpixels` are as in `pixel_rays`.
        """
        check_indices(flat, self.offsets[-1], "pixels")
        return self.rays(*self._positions(flat, subpixels), near, far, times)

    def places(self, flat: Tensor, subpixels: Tensor = CENTER) -> Tensor:
        """Return the positions (P * K, 2) of the rays of pixels in their images, from left and top edge, 0 to 1.

        Args:
            flat: (P,) int64 numbers of the pixels.
            subpixels: (K, 2) positions in a pixel, as in `pixel_rays`.
        """
        indices, columns, rows = self._positions(flat, subpixels)
        return torch.stack([(columns + 0.5) / self.widths[indices], (rows + 0.5) / self.heights[indices]], dim=-1)

    def _positions(self, flat: Tensor, subpixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return camera, column and row (P * K,) of the rays of pixels."""
        indices = torch.searchsorted(self.offsets, flat, right=True) - 1
        within, widths = flat - self.offsets[indices], self.widths[indices]
        subpixels = subpixels.to(self.fx)
        columns = ((within % widths)[:, None] + subpixels[:, 0]).reshape(-1)
        rows = ((within // widths)[:, None] + subpixels[:, 1]).reshape(-1)
        return indices.repeat_interleave(len(subpixels)), columns, rows

    def image_pixels(self, index: int) -> Tensor:
        """Return the numbers (H * W,) of the pixels of image `index`, row by row, consecutive over all images."""
        start, end = self.ends[index : index + 2]
        return torch.arange(start, end, device=self.fx.device)


@lru_cache(maxsize=16)
def subpixels(count: int, device: torch.device | None = None) -> Tensor:
    """Return the positions in a pixel where colours are averaged: columns and rows (count, 2) from its centre.

    For count = n^2, the positions form a square grid, rotated so that no two share a row or a column. Edges close to
    horizontal or vertical, where aliasing is most visible, then have count + 1 levels instead of n + 1. For n = 2 it is
    the "rotated grid" of graphics hardware.

    Args:
        count: number of positions, a square number.
        device: device of the result; the CPU if None. The result is cached, because a copy to the device waits for it.

    Raises:
        ValueError: if `count` is not a square number.
    """
    side = math.isqrt(count)
    if side * side != count or count < 1:
        raise ValueError(f"{count} rays per pixel; it must be a square number")
    steps = torch.arange(count)
    rows = (steps + 1) * side % (count + 1) - 1
    return ((torch.stack([steps, rows], dim=-1) + 0.5) / count - 0.5).to(device)


def join_cameras(parts: Sequence[Cameras]) -> Cameras:
    """Concatenate cameras. If some are pinhole and some opencv, all become opencv; pinhole gets zero distortion.

    Args:
        parts: one or more sets of cameras.

    Raises:
        DataError: if the models cannot be combined.
    """
    models = {part.model for part in parts}
    if models == {"opencv", "pinhole"}:
        model = "opencv"
    elif len(models) == 1:
        model = parts[0].model
    else:
        raise DataError(
            f"the cameras are of different models ({', '.join(sorted(models))}), but a scene needs a single model; "
            "convert the images to one model, for example with 'colmap image_undistorter'"
        )
    joined: dict[str, Any] = {
        f.name: torch.cat([getattr(part, f.name) for part in parts])
        for f in fields(Cameras)
        if f.name not in ("model", "lens")
    }
    if all(part.lens is None for part in parts):
        return Cameras(**joined, model=model)
    count = len(LENSES[model])
    lenses = [
        part.fx.new_zeros(len(part), count) if part.model != model or part.lens is None else part.lens for part in parts
    ]
    return Cameras(**joined, model=model, lens=torch.cat(lenses))


_camera_rays = native.Function("camera_rays", "i" + "pqpqpqppppppp" + "ppppi")


def _reference_rays(
    cameras: Cameras, flat: Tensor, near: float, far: float, times: Tensor | None, places: Tensor
) -> Rays:
    return cameras.pixel_rays_reference(flat, near, far, times, places)


def _is_compiled(cameras: Cameras, flat: Tensor, near: float, far: float, times: Tensor | None, places: Tensor) -> bool:
    return cameras.model in COMPILED and not is_followed(cameras.lens)


CAMERA_RAYS = Operation("camera_rays", _reference_rays)


@CAMERA_RAYS.implementation(CPP, order=0, fits=_is_compiled)
def _compiled_rays(
    cameras: Cameras, flat: Tensor, near: float, far: float, times: Tensor | None, places: Tensor
) -> Rays:
    images, count = len(cameras), len(flat) * len(places)
    origins, directions, radii = torch.empty(count, 3), torch.empty(count, 3), torch.empty(count)
    indices = torch.empty(count, dtype=torch.int64)
    poses, widths, places = cameras.camera_to_worlds.contiguous(), cameras.widths.contiguous(), places.contiguous()
    flat = flat.contiguous()
    numbers = {name: getattr(cameras, name).contiguous() for name in ("fx", "fy", "cx", "cy")}
    distortion = None if cameras.distortion is None else cameras.distortion.table
    _camera_rays(
        COMPILED.index(cameras.model),
        native.pointer(flat, "pixel indices", (len(flat),), torch.int64), len(flat),
        native.pointer(places, "places in a pixel", (len(places), 2)), len(places),
        native.pointer(cameras.offsets, "offsets", (images + 1,), torch.int64), images,
        native.pointer(widths, "widths", (images,), torch.int64),
        native.pointer(poses, "poses", (images, 3, 4)),
        *(native.pointer(values, name, (images,)) for name, values in numbers.items()),
        None if distortion is None else native.pointer(distortion, "lenses", (images, 11), torch.float64),
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


def check_pose(pose: Tensor, where: str) -> None:
    """Refuse a camera `pose`, (3, 4) or (4, 4), that is not a finite rigid motion, named `where` in the message.

    Raises:
        DataError: with `where` and the fault.
    """
    if pose.shape not in ((4, 4), (3, 4)):
        raise DataError(f"{where}: the pose has shape {tuple(pose.shape)}; a 4x4 matrix is needed")
    if not bool(torch.isfinite(pose).all()):
        raise DataError(f"{where}: the pose holds a value that is not finite (NaN or infinity)")
    rotation = pose[:3, :3].double()
    error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if pose.shape[0] == 4:
        error = max(error, (pose[3] - torch.tensor([0.0, 0.0, 0.0, 1.0])).abs().max().item())
    if not error <= ROTATION_TOLERANCE or torch.linalg.det(rotation).item() < 0:  # NaN if squares overflow
        raise DataError(
            f"{where}: the pose is not rigid (its rotation is off an orthonormal, right-handed one by {error:.2g}); "
            "remove scale, shear or mirroring from the matrix"
        )
