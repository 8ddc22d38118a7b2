"""Projection of Gaussians in space to an image: elliptical weighted averaging (EWA, Zwicker et al. 2001).

As in 3D Gaussian Splatting (Kerbl et al. 2023). With W and t from scene to camera (x right, y down, z forward), a
Gaussian of mean m, axes R and scales s is on the image

    p = W m + t                         its centre in the camera's frame
    T = J W R diag(s)                   J: the Jacobian of the image position at p
    covariance = T T^T + blur I         pixels^2

`blur` accounts for the size of a pixel: each Gaussian has at least this variance. With antialiasing, its opacity is
multiplied by sqrt(det(T T^T) / det(covariance)) (Mip-Splatting, Yu et al. 2024, section 4.2).

A lens bends the image: J is then of the bent position, and the lens's own Jacobian counts as constant in gradients.
EWA shows points less than 90 degrees from the camera's axis in a fisheye image.

Cameras that show more are `unscented`: seven points of each Gaussian, which the lens projects exactly, then give its
centre and covariance on the image (`unscented.py`). Everything else is the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.lenses import Distortion, distort
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.kernels.splats.unscented import ALL_AROUND, TURN, unscented
from nerfloom.kernels.triton_backend import later


class Record(IntEnum):
    """Columns of a record, a projected Gaussian; kernels/splats/splat.h has the same names.

    Centre X, Y in pixels. U_X, U_Y, V_Y make alpha at an offset (dx, dy) from the centre OPACITY * exp(-u^2 - v^2) with
    u = U_X dx + U_Y dy and v = V_Y dy. CUT is u^2 + v^2 where alpha falls below MIN_ALPHA; 0 or less if the Gaussian is
    not visible. REACH_X and REACH_Y are half the width and height of this ellipse, pixels. DISTANCE is the distance
    from the camera, scene units. The normal is the shortest axis, turned towards the camera.
    """

    X, Y, U_X, U_Y, V_Y, OPACITY, CUT, REACH_X = range(8)
    RED, GREEN, BLUE, DISTANCE, NORMAL_X, NORMAL_Y, NORMAL_Z, REACH_Y = range(8, 16)


RECORD = len(Record)
"""Number of columns of a record."""
MIN_ALPHA = 1 / 255
"""A Gaussian is not drawn where its alpha is below it."""
BLUR = 0.3
"""Variance that 3D Gaussian Splatting adds on the image, pixels^2."""
DC = 0.28209479177387814
"""The harmonic of degree 0."""
MARGIN = 0.15
"""Margin around the image, as a share of its size. Outside of it, J is evaluated at the nearest point within, since J
grows without bound."""
DEGREES = {0: 0, 1: 3, 2: 8, 3: 15}
"""Degree of the harmonics -> their number beyond the first."""


@dataclass(frozen=True)
class SplatCamera:
    """A camera with a pinhole, OpenCV's lens distortion, OpenCV's fisheye lens, or an equirectangular image."""

    pose: Tensor
    """(3, 4) transform from the scene to the camera's frame: x right, y down, z forward. It may require a gradient."""
    intrinsics: tuple[float, float, float, float]
    """Focal lengths and principal point fx, fy, cx, cy, pixels; the first pixel's centre lies at (0.5, 0.5). Focal
    lengths of an equirectangular image are in pixels per radian."""
    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    near: float = 0.01
    """Minimum depth of a centre along the optical axis, or its minimum distance if the camera is `all_around`;
    Gaussians closer than this are not drawn, scene units."""
    blur: float = BLUR
    """Variance added in both directions on the image, pixels^2."""
    antialiased: bool = False
    """Whether opacity is reduced to compensate for the blur."""
    lens: Distortion | None = None
    """Distortion of the models "opencv" and "fisheye"; None for the others."""
    model: str = "pinhole"
    """Projection: "pinhole", "opencv", "fisheye" or "equirectangular", keys of `nerfloom.geometry.lenses.LENSES`."""
    by_depth: bool = False
    """Whether Gaussians are sorted by depth along the optical axis instead of distance. Not if it is `all_around`."""
    unscented: bool = False
    """Whether Gaussians are projected by the unscented transform instead of EWA. Required for "equirectangular"."""

    @property
    def all_around(self) -> bool:
        """True if points beside and behind the camera may be shown."""
        return self.unscented and self.model in ALL_AROUND

    @property
    def turn(self) -> float | None:
        """Width of a whole turn of a panorama, the period of positions, pixels; None for other images."""
        return TURN * self.intrinsics[0] if self.model == "equirectangular" else None

    def plain(self) -> list[float]:
        """Return the camera as 34 numbers for a kernel."""
        pose = self.pose.detach().double().cpu()
        lens = [3.0 if self.model == "equirectangular" else 0.0] + [0.0] * 11
        if self.lens is not None:
            lens = [2.0 if self.model == "fisheye" else 1.0, *self.lens.table.double().flatten().tolist()]
        return [
            *pose[:, :3].flatten().tolist(), *pose[:, 3].tolist(), *self.intrinsics, float(self.width),
            float(self.height), self.near, self.blur, float(self.antialiased), *lens, float(self.unscented),
        ]  # fmt: skip


def project_gaussians(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera, degree: int = 3,
) -> tuple[Tensor, int | Tensor]:  # fmt: skip
    """Project N Gaussians to an image.

    All parameters and the camera's pose get gradients. Normals and the columns CUT, REACH_X and REACH_Y pass none on.

    Args:
        means: (N, 3) centres, scene coordinates.
        log_scales: (N, 3) logarithms of the standard deviations along the axes, of scene units.
        rotations: (N, 4) quaternions w, x, y, z of any length but 0.
        logits: (N,) opacities before the sigmoid.
        colors: (N, 3) coefficients of the harmonic of degree 0; 0 is grey.
        harmonics: (N, 3, K) coefficients of the degrees from 1; K is 0, 3, 8 or 15.
        camera: the camera.
        degree: highest degree of the harmonics that is used, 0 to 3; higher ones than `harmonics` has are left out.

    Returns:
        Records (N, RECORD), all zeros for a Gaussian that the image does not show, and the number of Gaussians that are
        left out because a parameter is not finite or a quaternion is 0, which may still be on the device, () int64.

    Raises:
        ValueError: if there is another number of harmonics.
    """
    if harmonics.shape[2] not in DEGREES.values():
        raise ValueError(f"there are 0, 3, 8 or 15 harmonics beyond the first, not {harmonics.shape[2]}")
    tensors = (means, log_scales, rotations, logits, colors, harmonics, camera.pose)
    return PROJECT(tensors, *tensors[:-1], camera, min(DEGREES[degree], harmonics.shape[2]))


def sort_keys(means: Tensor, camera: SplatCamera) -> Tensor | None:
    """Return the depths (N,) that sort a camera's Gaussians; None if distances sort them.

    Args:
        means: (N, 3) centres, scene coordinates.
        camera: the camera.
    """
    if not camera.by_depth or camera.all_around:
        return None
    pose = camera.pose.detach().to(means)
    return means.detach() @ pose[2, :3] + pose[2, 3]


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions w, x, y, z.

    Args:
        quaternions: (N, 4), of any length but 0.
    """
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def project_reference(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera, basis: int,
) -> tuple[Tensor, int | Tensor]:  # fmt: skip
    """Compute `project_gaussians` in torch, on any device and in any float type.

    Args:
        means, log_scales, rotations, logits, colors, harmonics: parameters of the Gaussians.
        camera: the camera.
        basis: number of harmonics that are used beyond the first: 0, 3, 8 or 15.

    Returns:
        Records (N, RECORD), and the number of Gaussians that are left out.
    """
    harmonics = harmonics[..., :basis]
    gaussians = means, log_scales, rotations, logits, colors, harmonics
    in_front, finite = _in_front(*gaussians, camera)
    kept = in_front.nonzero()[:, 0]
    sound, table = _projected(camera, *(values[kept] for values in gaussians))
    records = means.new_zeros(len(means), RECORD).index_copy_(0, kept, torch.where(sound[:, None], table, 0))
    return records, (~finite).sum()


def _in_front(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return (N,) bool, whether a Gaussian can be projected and lies in front of the camera, and whether its numbers
    allow a projection. If the camera is `all_around`, every Gaussian beyond `near` lies in front of it."""
    pose = camera.pose.to(means)
    with torch.no_grad():  # apart from the projection, since the gradient of the pose would be NaN times 0
        if camera.all_around:
            depth = (means @ pose[:, :3].T + pose[:, 3]).norm(dim=-1)
        else:
            depth = means @ pose[2, :3] + pose[2, 3]
    everything = torch.cat([means, log_scales, rotations, logits[:, None], colors, harmonics.flatten(1)], 1)
    finite = everything.isfinite().all(1) & (rotations.square().sum(1) > 1e-24)
    return finite & (depth > camera.near), finite


def _projected(
    camera: SplatCamera, means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor,
    harmonics: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return which of K Gaussians in front of the camera the image shows, (K,), and their records (K, RECORD)."""
    pose, basis = camera.pose.to(means), harmonics.shape[2]
    at = means @ pose[:, :3].T + pose[:, 3]
    axes = rotation_matrices(rotations)
    if camera.unscented:
        in_camera = pose[:, :3] @ axes * log_scales.exp()[:, None]
        center_x, center_y, rows, within = unscented(
            at, in_camera, camera.model, camera.lens, camera.intrinsics, camera.width
        )
    else:
        center_x, center_y, to_image, within = _onto_image(at, camera)
        rows = to_image @ pose[:, :3] @ axes * log_scales.exp()[:, None]  # (K, 2, 3)
    first, second = rows.unbind(1)
    b = (first * second).sum(-1)
    spread_x, spread_y = first.square().sum(-1), second.square().sum(-1)
    blur = camera.blur
    a, c = spread_x + blur, spread_y + blur
    det_0 = _squared_minors(first, second).sum(-1)
    det = det_0 + blur * (spread_x + spread_y) + blur * blur
    opacity = torch.sigmoid(logits)
    if camera.antialiased:
        opacity = opacity * (det_0 / det).clamp(min=1e-30).sqrt()
    cut = (opacity / MIN_ALPHA).log()
    reach_x, reach_y = ((2 * cut.clamp(min=0) * variance).sqrt() for variance in (a, c))
    u_x = (c / (2 * det)).sqrt()
    center = -pose[:, :3].T @ pose[:, 3]
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    rgb = 0.5 + DC * colors
    if basis:
        values = spherical_harmonics_reference(directions, {3: 2, 8: 3, 15: 4}[basis])[:, 1:]
        rgb = rgb + (harmonics * values[:, None]).sum(-1)
    with torch.no_grad():
        normals = axes[torch.arange(len(means), device=means.device), :, log_scales.argmin(-1)]
        normals = torch.where((normals * directions).sum(-1, keepdim=True) > 0, -normals, normals)
        visible = within & (cut > 0) & (center_x + reach_x > 0) & (center_x - reach_x < camera.width)
        visible &= (center_y + reach_y > 0) & (center_y - reach_y < camera.height)
    columns = [
        center_x, center_y, u_x, -b / c * u_x, (0.5 / c).sqrt(), opacity, cut.detach(), reach_x.detach(),
        *rgb.clamp(min=0).unbind(-1), at.norm(dim=-1), *normals.unbind(-1), reach_y.detach(),
    ]  # fmt: skip
    table = torch.stack(columns, -1)
    return visible & table.isfinite().all(1), table


def _squared_minors(first: Tensor, second: Tensor) -> Tensor:
    """Return the squares of the minors (K, C (C - 1) / 2) of matrices with two rows (K, C), for an odd C. Their sum is
    the determinant of the rows' products (Cauchy-Binet)."""
    columns = first.shape[1]
    minors = [first * second.roll(-k, 1) - first.roll(-k, 1) * second for k in range(1, columns // 2 + 1)]
    return torch.cat(minors, 1).square()


def _onto_image(at: Tensor, camera: SplatCamera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return image positions x, y (K,) of points (K, 3), Jacobians (K, 2, 3), and a mask of points that the lens
    shows."""
    fx, fy, cx, cy = camera.intrinsics
    x, y, over = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2], 1 / at[:, 2]
    low_x, high_x = (-MARGIN * camera.width - cx) / fx, ((1 + MARGIN) * camera.width - cx) / fx
    low_y, high_y = (-MARGIN * camera.height - cy) / fy, ((1 + MARGIN) * camera.height - cy) / fy
    fisheye = camera.model == "fisheye"
    if fisheye:  # its Jacobian is bounded by itself: angles do not grow as tangents do
        low_x, high_x, low_y, high_y = -torch.inf, torch.inf, -torch.inf, torch.inf
    nothing = torch.zeros_like(x)
    to_plane = torch.stack(
        [over, nothing, -x.clamp(low_x, high_x) * over, nothing, over, -y.clamp(low_y, high_y) * over], -1
    ).unflatten(-1, (2, 3))
    within = torch.ones_like(x, dtype=torch.bool)
    if camera.lens is not None:
        if fisheye:
            x, y, to_angle = _angles(x, y)
            to_plane = to_angle.detach() @ to_plane
        within = torch.hypot(x, y) < camera.lens.reach.flatten()[0].to(x)
        inside_x, inside_y = x.masked_fill(~within, 0), y.masked_fill(~within, 0)
        coefficients = camera.lens.coefficients.reshape(1, -1).expand(len(x), -1).to(x)
        x, y, (uu, uv, vv) = distort(inside_x, inside_y, coefficients)
        to_plane = torch.stack([uu, uv, uv, vv], -1).detach().unflatten(-1, (2, 2)) @ to_plane
    to_image = torch.stack([fx * to_plane[:, 0], fy * to_plane[:, 1]], 1)
    return fx * x + cx, fy * y + cy, to_image, within


def _angles(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return points (K,) of the plane at depth 1 with their radius replaced by its arctangent, and the Jacobian (K, 2,
    2)."""
    squared = x * x + y * y
    far = squared > 1e-8
    safe = torch.where(far, squared, 1.0)
    scale = torch.where(far, safe.sqrt().atan() / safe.sqrt(), 1 - squared / 3)
    slope = torch.where(far, (1 / (1 + safe) - scale) / safe, -2 / 3)
    jacobian = torch.stack([scale + slope * x * x, slope * x * y, slope * x * y, scale + slope * y * y], -1)
    return scale * x, scale * y, jacobian.unflatten(-1, (2, 2))


PROJECT: Operation[..., tuple[Tensor, int | Tensor]] = Operation("project_gaussians", project_reference)
_forward = native.Function("splat_project", "ppppppqiippi", "q")
_backward = native.Function("splat_project_backward", "ppppppqiipppppppppp" + "i")


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: SplatCamera, basis: int, dropped: list[int], *tensors: Tensor) -> Tensor:
        *parameters, _ = tensors
        settings = torch.tensor(camera.plain(), dtype=torch.float64)
        records = parameters[0].new_empty(len(parameters[0]), RECORD)
        dropped.append(_forward(*_addresses(parameters), *_sizes(parameters, basis), settings.data_ptr(),
                                records.data_ptr(), native.threads()))  # fmt: skip
        ctx.save_for_backward(*parameters, records, settings)
        ctx.basis = basis
        return records

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *parameters, records, settings = ctx.saved_tensors
        gradient = gradient.contiguous()  # kept until the kernel has read it
        out = [torch.empty_like(parameter) for parameter in parameters]
        pose = torch.empty(3, 4) if ctx.needs_input_grad[-1] else None
        _backward(
            *_addresses(parameters), *_sizes(parameters, ctx.basis), settings.data_ptr(), records.data_ptr(),
            native.pointer(gradient, "the gradient", (len(records), RECORD)),
            *(tensor.data_ptr() for tensor in out), None if pose is None else pose.data_ptr(), native.threads(),
        )  # fmt: skip
        return None, None, None, *out, pose


def _addresses(parameters: list[Tensor]) -> list[int]:
    """Return where the six parameters are, after checking their shapes."""
    count, stride = len(parameters[0]), parameters[5].shape[2]
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, 3, stride))
    names = ("means", "log scales", "rotations", "logits", "colors", "harmonics")
    return [native.pointer(*each) for each in zip(parameters, names, shapes, strict=True)]


def _sizes(parameters: list[Tensor], basis: int) -> tuple[int, int, int]:
    return len(parameters[0]), basis, parameters[5].shape[2]


@PROJECT.implementation(CPP)
def _compiled(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera, basis: int,
) -> tuple[Tensor, int | Tensor]:  # fmt: skip
    parameters = [t.contiguous() for t in (means, log_scales, rotations, logits, colors, harmonics)]
    dropped: list[int] = []
    records = _Project.apply(camera, basis, dropped, *parameters, camera.pose)
    return records, dropped[0]


def _is_pinhole(*given: Any) -> bool:
    camera: SplatCamera = given[6]
    return camera.lens is None and not camera.unscented


@PROJECT.implementation(FEW_OPERATIONS, types=None, order=torch.inf)
def _in_the_place_of_others(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera, basis: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Compute `project_gaussians` without a wait: in the place of Gaussians that are not in front of the camera, others
    are projected, and left out."""
    gaussians = means, log_scales, rotations, logits, colors, harmonics[..., :basis]
    in_front, finite = _in_front(*gaussians, camera)
    pose, others = camera.pose.detach().to(means), ~in_front
    middle = pose[2, :3] - pose[:, :3].T @ pose[:, 3]  # of the image, at depth 1
    ones = [values.masked_fill(others.view(-1, *[1] * (values.ndim - 1)), 1.0) for values in gaussians[1:]]
    sound, table = _projected(camera, torch.where(others[:, None], middle, means), *ones)
    return torch.where((in_front & sound)[:, None], table, 0), (~finite).sum()


PROJECT.implementation(TRITON, fits=_is_pinhole)(later("splats.project_triton", "project_gaussians"))
