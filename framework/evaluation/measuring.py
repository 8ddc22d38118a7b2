"""Measuring in a scene: the point of a surface at a pixel, and the length between two points with its error.

A pixel's point lies on the zero level set of a signed distance, if the method has one; otherwise at the median depth,
where the transmittance falls to one half.

The error is a standard deviation and has three parts: the error of triangulation from all photographs that see a point
(`cameras/triangulation.py`), half a pixel of the sharpest photograph for the choice of the point, and the error of the
scale. It does not contain errors that photographs share, such as errors of poses and lenses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.scale import Scale, checked
from nerfloom.cameras.triangulation import length_error, point_covariance, projection_jacobians, reading_error
from nerfloom.cameras.view import View
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import HasSignedDistance, Renderable, RendersRays

OPAQUE = 0.5
"""Minimum opacity of a pixel that shows a surface."""
PIXEL_ERROR = 0.5
"""Standard deviation of a point's column and row in a photograph, pixels."""
IN_FRONT = 0.02
"""A camera sees a point unless its ray meets a surface nearer by more than this fraction of the distance."""
NEWTON_STEPS = 5
"""Number of steps from the median depth to the zero level set."""
LONGEST_STEP = 0.01
"""Maximum distance of the zero level set from the median depth, as a fraction of the depth."""
MAX_CAMERAS = 200
"""Maximum number of photographs, evenly spaced, that an error is computed from."""


@dataclass(frozen=True)
class Length:
    """A length, with its error."""

    value: float
    """The length, in `unit`."""
    error: float | None
    """Standard deviation, in `unit`; None if fewer than two photographs see one of the points, of this length or of the
    one that has set the scale."""
    unit: str
    """Name of the unit; empty for the unit of the input."""

    def __str__(self) -> str:
        name = f" {self.unit}" if self.unit else ""
        if self.error is None:
            reason = "fewer than two photographs see an end, of it or of the length that set the scale"
            return f"{self.value:.4g}{name} (error unknown: {reason})"
        digits = max(1 - math.floor(math.log10(self.error)), 0) if self.error > 0 else 6
        return f"{self.value:.{digits}f}{name} ± {self.error:.{digits}f}{name}"


@torch.no_grad()
def surface_point(model: Renderable, view: View, column: float, row: float) -> Tensor:
    """Return the position (3,) float64 of the surface at a pixel, scene coordinates.

    Args:
        model: the model in evaluation mode.
        view: the camera, on the model's device, and the time.
        column, row: the pixel; (0, 0) is the centre of the top left one, and fractions are allowed.

    Raises:
        ConfigError: if the pixel is outside of the image, has no ray through the lens, or shows no surface.
    """
    camera, place = view.camera, f"column {column:.1f}, row {row:.1f}"
    height, width = camera.sizes[0]
    if not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5):
        raise ConfigError(f"{place} is outside of the image, which has {width} x {height} pixels")
    here = torch.tensor([[column, row]], dtype=torch.float64).to(camera.fx)
    if not bool(camera.look(torch.zeros_like(camera.widths), here[:, 0], here[:, 1])[2].valid[0]):
        raise ConfigError(f"the {camera.model} lens has no ray at {place}")
    rays, depth, opacity = _first_surfaces(model, camera, here, view.time)
    if not bool(opacity[0] >= OPAQUE) or not bool(depth[0] < rays.fars[0]):
        raise ConfigError(f"there is no surface at {place}: opacity {float(opacity[0]):.2f}")
    if isinstance(model, HasSignedDistance):
        depth = _onto_level(model, rays, depth)
    return _along(rays, depth)[0].double().cpu()


@torch.no_grad()
def seeing_cameras(model: Renderable, cameras: Cameras, point: Tensor, time: float | None = None) -> Tensor:
    """Return the indices (K,) of the cameras that see a point: it is inside their image, and nothing is in front of it.

    At most `MAX_CAMERAS` cameras with the point inside their image are tried.

    Args:
        model: the model in evaluation mode.
        cameras: M cameras on the CPU.
        point: (3,) scene coordinates.
        time: time in [0, 1] of a moving scene.
    """
    positions = point.float().expand(len(cameras), 3)
    columns, rows, ahead = cameras.project(positions, torch.arange(len(cameras)))
    places = torch.stack([columns, rows], dim=-1)
    sizes = torch.stack([cameras.widths, cameras.heights], dim=-1)
    inside = (ahead & (places >= -0.5).all(-1) & (places < sizes - 0.5).all(-1)).nonzero()[:, 0]
    if not len(inside):
        return inside
    asked = inside[evenly_spaced(len(inside), MAX_CAMERAS)]
    rays, depth, _ = _first_surfaces(model, cameras[asked].to(model.device), places[asked].to(model.device), time)
    distance = ((point.to(rays.origins) - rays.origins) * rays.directions).sum(-1)
    return asked[(depth >= (1 - IN_FRONT) * distance).cpu()]


def located(model: Renderable, cameras: Cameras, point: Tensor, time: float | None = None) -> Tensor:
    """Return the covariance (3, 3) of a `point` found in a picture; infinite if fewer than two cameras see it.

    `cameras` belong to M photographs of `model`, on the CPU; `time` in [0, 1] is the moment of a moving scene.
    """
    seeing = seeing_cameras(model, cameras, point, time)
    jacobians = projection_jacobians(cameras[seeing], point)
    reading = torch.full((3,), reading_error(jacobians, PIXEL_ERROR) ** 2, dtype=torch.float64)
    return point_covariance(jacobians, PIXEL_ERROR) + reading.diag()


def measured(
    model: Renderable,
    cameras: Cameras | None,
    ends: tuple[Tensor, Tensor],
    unit: float,
    scale: Scale,
    time: float | None = None,
) -> Length:
    """Return the distance between two points, with its error.

    Args:
        model: the model in evaluation mode.
        cameras: cameras of its photographs, on the CPU; None if they are not known.
        ends: both points (3,), scene coordinates.
        unit: length of a scene unit, in the unit of `scale`.
        scale: the scale.
        time: time in [0, 1] of a moving scene.

    Raises:
        ConfigError: if the two points are the same.
    """
    start, end = (point.double().cpu() for point in ends)
    length = float((end - start).norm())
    if not length > 0:
        raise ConfigError("the two points are the same: choose two different ones")
    error = math.inf
    if cameras is not None and scale.relative_error is not None:
        places = located(model, cameras, start, time), located(model, cameras, end, time)
        error = unit * math.hypot(length_error(start, end, places), length * scale.relative_error)
    return Length(unit * length, error if math.isfinite(error) else None, scale.unit)


def scale_of(found: Length, scale: Scale, distance: float, unit: str) -> Scale:
    """Return the scale that makes a measured length equal to its true length.

    Args:
        found: the measured length in the present scale, without the error of the scale itself; the new scale has the
            error of the length.
        scale: the present scale.
        distance: the true length.
        unit: name of its unit.

    Raises:
        FlagError: if the length or the name cannot be used.
    """
    error = None if found.error is None else found.error / found.value
    return checked(Scale(scale.factor * distance / found.value, unit, error), f"a length of {distance:g}")


def _first_surfaces(
    model: Renderable, cameras: Cameras, places: Tensor, time: float | None
) -> tuple[Rays, Tensor, Tensor]:
    """Return the rays of M cameras at a column and row (M, 2) each, their median depths and opacities (M,)."""
    count, scene = len(cameras), model.scene
    ones = torch.ones_like(cameras.widths)
    single = replace(
        cameras, cx=cameras.cx - places[:, 0], cy=cameras.cy - places[:, 1], widths=ones, heights=ones
    )  # images of one pixel
    moment = 0.0 if time is None and scene.moving else time
    times = None if moment is None else torch.full((count,), moment, device=cameras.fx.device)
    rays = single.pixel_rays(torch.arange(count, device=cameras.fx.device), scene.near, scene.far, times)
    rays = replace(rays, camera_indices=None)  # their numbers must not stand for training cameras
    if isinstance(model, RendersRays):
        with model.rendering():
            shown = model.render(rays, model.background)
        return rays, shown.median_depth.float(), shown.accumulation.float()
    pictures = [model.render_view(View.of(single, index, times), model.background) for index in range(count)]
    depths, opacities = (torch.cat([picture.of(name).flatten() for picture in pictures])
                         for name in ("median_depth", "accumulation"))  # fmt: skip
    return rays, depths.float(), opacities.float()


def _onto_level(model: HasSignedDistance, rays: Rays, depth: Tensor) -> Tensor:
    """Return the depth (R,) of the zero level set by Newton steps along rays; `depth` where it is not near."""
    found = depth.clone()
    for _ in range(NEWTON_STEPS):
        distances, gradients = model.signed_distance(Points(_along(rays, found)))
        slopes = (gradients * rays.directions).sum(-1)
        found = found - distances / torch.where(slopes < 0, slopes, -torch.inf)
    return torch.where((found - depth).abs() <= LONGEST_STEP * depth, found, depth)


def _along(rays: Rays, depth: Tensor) -> Tensor:
    return rays.origins + depth[:, None] * rays.directions
