"""Cameras: from a pixel to a ray.

Conventions: OpenGL axes (x right, y up, the camera looks down -z); pixel (column, row) = (0, 0) is the top left
one and its centre lies at (0.5, 0.5); `camera_to_worlds` maps camera to scene coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from framework.base.errors import DataError
from framework.geometry.lenses import BENDING, Distortion, Seen, project, unproject
from framework.geometry.lenses import LENSES as LENSES
from framework.geometry.rays import Rays
from framework.kernels import native
from framework.kernels.dispatch import CPP, Operation
from framework.kernels.given import check_indices, is_followed

ROTATION_TOLERANCE = 1e-3
LARGEST_SIDE = 10**9
"""Pixels beyond which no image's width or height is believed, though files may have room for 2^64."""
CENTER = torch.zeros(1, 2)
"""The one place in a pixel that is its centre, as columns and rows from there."""
COMPILED = ("pinhole", *BENDING)
"""The models whose rays are compiled, in the order of the kernel's numbers."""


@dataclass(frozen=True)
class Cameras:
    """M cameras of one model. Intrinsics are in pixels of the images they go with.

    What a focal length is per unit of depends on the model: pixels per tangent (pinhole, opencv), per radian (fisheye,
    equirectangular: `lenses.panorama` gives those of a whole one), per scene unit (orthographic).
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
    """Name of the projection, a key of `LENSES`."""
    lens: Tensor | None = None
    """(M, K) distortion coefficients, in the order of `LENSES[model]`; None for all zero."""

    def __post_init__(self) -> None:
        if self.model not in LENSES:
            raise ValueError(f"there is no camera model '{self.model}'; there are {', '.join(LENSES)}")
        names = LENSES[self.model]
        if self.lens is not None and self.lens.shape[-1] != len(names):
            raise ValueError(f"{self.model} takes {len(names)} distortion coefficients, not {self.lens.shape[-1]}")

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
        x, y, seen = self.look(camera_indices, columns, rows)
        poses = self.camera_to_worlds[camera_indices]
        origins = poses[:, :, 3]
        # Products and sums rather than a matrix product, which autocast would round to bfloat16.
        directions = (poses[:, :, :3] * seen.directions[:, None, :]).sum(-1)
        if self.model == "orthographic":
            origins = origins + poses[:, :, 0] * x[:, None] - poses[:, :, 1] * y[:, None]
        # Mip-NeRF sets the radius to 2 / sqrt(12) pixels. That of parallel rays is the same at all distances.
        pixel_radii = 2 / 12**0.5 / self.fx[camera_indices] * seen.spread
        return Rays(
            origins=origins,
            directions=directions,
            nears=torch.full_like(x, near),
            fars=torch.full_like(x, far),
            pixel_radii=pixel_radii,
            times=None if times is None else times[camera_indices],
            camera_indices=camera_indices,
        )

    def look(self, camera_indices: Tensor, columns: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Seen]:
        """What pixels (R,) show, in their camera's frame, and whether they show anything.

        Returns: normalised image coordinates x and y (R,), and what is seen there.
        """
        x = (columns + 0.5 - self.cx[camera_indices]) / self.fx[camera_indices]
        y = (rows + 0.5 - self.cy[camera_indices]) / self.fy[camera_indices]
        lenses = None if self.distortion is None else self.distortion[camera_indices]
        return x, y, unproject(self.model, x, y, lenses)

    def project(self, points: Tensor, camera: int | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where cameras show points: the inverse of `rays`.

        Args:
            points: (N, 3) scene coordinates.
            camera: index of the camera, or (N,) of one for each point.
        Returns: columns, rows (N,) as `rays` takes them, whole numbers being pixels' centres, also outside the image;
            and (N,) bool whether the point is in front of the camera and within its lens's reach. Elsewhere columns
            and rows are finite, and mean nothing.
        """
        indices = torch.as_tensor(camera, device=points.device).expand(len(points))
        poses = self.camera_to_worlds[indices]
        local = (poses[:, :, :3] * (points - poses[:, :, 3])[:, :, None]).sum(1)
        x, y, in_front = project(self.model, local, None if self.distortion is None else self.distortion[indices])
        columns = x * self.fx[indices] + self.cx[indices] - 0.5
        return columns, y * self.fy[indices] + self.cy[indices] - 0.5, in_front

    @cached_property
    def distortion(self) -> Distortion | None:
        """How the lenses bend, where the model has it."""
        if self.model not in BENDING:
            return None
        lens = self.fx.new_zeros(len(self), len(LENSES[self.model])) if self.lens is None else self.lens
        return Distortion.of(self.model, lens)

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
        Returns: P * K rays, those of a pixel together; with a gradient for poses and intrinsics that ask for one.
        Raises: IndexError where there is no such pixel.
        """
        numbers = self.camera_to_worlds, self.fx, self.fy, self.cx, self.cy, places
        return CAMERA_RAYS(numbers, self, flat, near, far, times, places)

    def pixel_rays_reference(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, places: Tensor = CENTER
    ) -> Rays:
        """As `pixel_rays`, in torch, for any camera and device."""
        check_indices(flat, int(self.offsets[-1]) if flat.device.type == "cpu" else 0, "pixels")
        indices = torch.searchsorted(self.offsets, flat, right=True) - 1
        within, widths = flat - self.offsets[indices], self.widths[indices]
        places = places.to(self.fx)
        columns = ((within % widths)[:, None] + places[:, 0]).reshape(-1)
        rows = ((within // widths)[:, None] + places[:, 1]).reshape(-1)
        return self.rays(indices.repeat_interleave(len(places)), columns, rows, near, far, times)

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


def join_cameras(parts: Sequence[Cameras]) -> Cameras:
    """All cameras of one or more parts, in their order.

    pinhole and opencv become opencv, pinhole being the one without distortion.

    Raises: DataError where the models cannot be one.
    """
    models = {part.model for part in parts}
    if models == {"opencv", "pinhole"}:
        model = "opencv"
    elif len(models) == 1:
        model = parts[0].model
    else:
        raise DataError(
            f"the cameras are of different models ({', '.join(sorted(models))}), which one scene cannot mix; "
            "convert the images to one model, for example with 'colmap image_undistorter'"
        )
    joined: dict[str, Any] = {
        f.name: torch.cat([getattr(part, f.name) for part in parts])
        for f in fields(Cameras)
        if f.name not in ("model", "lens")
    }
    if all(part.lens is None for part in parts):
        return Cameras(**joined, model=model)
    straight = len(LENSES[model])
    lenses = [
        part.fx.new_zeros(len(part), straight) if part.model != model or part.lens is None else part.lens
        for part in parts
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
    if not error <= ROTATION_TOLERANCE or torch.linalg.det(rotation).item() < 0:  # NaN where squares overflow
        raise DataError(
            f"{where}: the pose is not rigid (its rotation is off an orthonormal, right-handed one by {error:.2g}); "
            "remove scale, shear or mirroring from the matrix"
        )
