"""Splatting in float64, from its equations: the truth for the kernels. It knows nothing of tiles.

The covariance on the image is J W R S S^T R^T W^T J^T + blur I; J is found by autograd, spherical harmonics are made of
derivatives of Legendre polynomials, and each pixel looks at all Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.geometry.lenses import Distortion
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.kernels.splats.blend import Blended, blend
from nerfloom.kernels.splats.project import SplatCamera, project_gaussians
from nerfloom.kernels.splats.tiles import tile_lists
from nerfloom.splats.density_control import image_gradients
from tests.kernels.compiled import relative_error

NAMES = ("means", "log scales", "rotations", "logits", "colors", "harmonics", "pose")
LENSES = {
    "opencv": (0.1, -0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.005, 0.0),
    "fisheye": (0.05, -0.02, 0.01, -0.003),
}
"""Coefficients of each lens, in the order of its projection."""
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
BOUND = 0.15
"""Beyond the image's edge by this share of its size, the Jacobian stays constant."""


def scene(count: int, harmonics: int = 15, spread: float = 1.0) -> list[Tensor]:
    """Return parameters of Gaussians four units in front of a camera, and its pose, which is a small motion."""
    means = torch.randn(count, 3) * spread
    means[:, 2] = means[:, 2] / 2 + 4
    turn = 0.1 * torch.randn(3, 3)
    pose = torch.cat([torch.linalg.matrix_exp(turn - turn.T), torch.tensor([[0.1], [-0.2], [0.3]])], dim=1)
    return [
        means, torch.randn(count, 3) / 2 - 2.5, torch.randn(count, 4), 2 * torch.randn(count), torch.randn(count, 3),
        torch.randn(count, 3, harmonics) / 5, pose,
    ]  # fmt: skip


def camera(width: int, height: int, lens: str = "", **settings: Any) -> SplatCamera:
    """Return a camera with focal lengths that suit an image's size; its pose is the scene's frame."""
    focal = 0.5 * (width + height) + 0.5
    bent = Distortion.of(lens, torch.tensor([LENSES[lens]], dtype=torch.float64)) if lens else None
    middle = focal, 1.03 * focal, 0.49 * width, 0.51 * height
    return SplatCamera(torch.eye(3, 4), middle, width, height, lens=bent, model=lens or "pinhole", **settings)


# -- projection ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Projection:
    """The Gaussians that are in front of the camera, nearest first."""

    indices: Tensor
    centers: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    distances: Tensor
    normals: Tensor


def turned(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Return q v q* of quaternions (N, 1, 4) and vectors (M, 3): (N, M, 3)."""

    def product(a: Tensor, b: Tensor) -> Tensor:
        real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
        a_vector, b_vector = torch.broadcast_tensors(a[..., 1:], b[..., 1:])
        cross = torch.linalg.cross(a_vector, b_vector)
        return torch.cat([real, a[..., :1] * b_vector + b[..., :1] * a_vector + cross], -1)

    unit = quaternions / quaternions.norm(dim=-1, keepdim=True)
    conjugate = unit * torch.tensor([1.0, -1.0, -1.0, -1.0]).to(unit)
    return product(product(unit, torch.nn.functional.pad(vectors, (1, 0))), conjugate)[..., 1:]


def real_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return all real spherical harmonics up to a degree, with the Condon-Shortley phase, (N, (degree + 1)^2)."""
    x, y, z = directions.unbind(-1)
    values = []
    for n in range(degree + 1):
        for order in range(-n, n + 1):
            m = abs(order)
            slope = np.polynomial.Legendre.basis(n).deriv(m) if m else np.polynomial.Legendre.basis(n)
            powers = slope.convert(kind=np.polynomial.Polynomial).coef
            polar = sum((float(c) * z**k for k, c in enumerate(powers)), torch.zeros_like(z))
            around = [torch.ones_like(x), torch.zeros_like(x)]  # of (x + iy)^m
            for _ in range(m):
                around = [around[0] * x - around[1] * y, around[0] * y + around[1] * x]
            size = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - m) / math.factorial(n + m))
            scale = size * (-1) ** m * (math.sqrt(2) if m else 1)
            values.append(scale * polar * around[1 if order < 0 else 0])
    return torch.stack(values, -1)


def jacobians(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the derivatives (N, 2, K) of a function from (N, K) to (N, 2), row by row, at points (N, K)."""
    follows = at.requires_grad and torch.is_grad_enabled()
    with torch.enable_grad():
        given = at if follows else at.detach().requires_grad_()
        sums = function(given).sum(0)
        slopes = [torch.autograd.grad(each, given, create_graph=follows, retain_graph=True)[0] for each in sums]
    return torch.stack(slopes, 1)


def bent_by_fisheye(at: Tensor) -> Tensor:
    """Return where OpenCV's fisheye lens shows points (N, 2) of the image plane at depth 1."""
    k1, k2, k3, k4 = LENSES["fisheye"]
    radius = at.norm(dim=-1, keepdim=True)
    angle = torch.atan2(radius, torch.ones_like(radius))
    return at / radius * (angle + k1 * angle**3 + k2 * angle**5 + k3 * angle**7 + k4 * angle**9)


def bent(at: Tensor) -> Tensor:
    """Return where OpenCV's lens shows points (N, 2) of the image plane."""
    k1, k2, p1, p2, k3, k4, k5, k6, _ = LENSES["opencv"]
    x, y = at.unbind(-1)
    r2 = x**2 + y**2
    scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    tangential = torch.stack([2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y], -1)
    return at * scale[:, None] + tangential


def projected(given: Sequence[Tensor], view: SplatCamera, degree: int) -> Projection:
    """Project Gaussians, all of `view` but its pose being used. The lens's Jacobian is a constant."""
    means, log_scales, rotations, logits, colors, harmonics, pose = given
    fx, fy, cx, cy = view.intrinsics
    fisheye = view.model == "fisheye"
    focal, middle = torch.tensor([[fx, fy], [cx, cy]], dtype=torch.float64)
    size = torch.tensor([view.width, view.height]).double()
    turn, shift = pose[:, :3], pose[:, 3]
    p = means @ turn.T + shift
    plane = p[:, :2] / p[:, 2:]
    shown = p[:, 2] > view.near
    if view.lens is not None:
        radius = plane.norm(dim=-1)
        shown = shown & ((radius.atan() if fisheye else radius) < view.lens.reach[0])
    distance = p.norm(dim=-1)
    indices = shown.nonzero()[:, 0]
    indices = indices[distance[indices].sort(stable=True).indices]
    p, plane, distance = p[indices], plane[indices], distance[indices]

    low, high = (-BOUND * size - middle) / focal, ((1 + BOUND) * size - middle) / focal
    bounded = p if fisheye else torch.cat([plane.clamp(low, high) * p[:, 2:], p[:, 2:]], -1)
    jacobian = jacobians(lambda at: at[:, :2] / at[:, 2:], bounded)
    if view.lens is not None:
        lens = bent_by_fisheye if fisheye else bent
        jacobian = jacobians(lens, plane).detach() @ jacobian
        plane = lens(plane)
    jacobian = focal[:, None] * jacobian
    axes = turned(rotations[indices, None], torch.eye(3).double()).transpose(1, 2)
    in_space = axes @ torch.diag_embed((2 * log_scales[indices]).exp()) @ axes.transpose(1, 2)
    sharp = jacobian @ turn @ in_space @ turn.T @ jacobian.transpose(1, 2)
    covariance = sharp + view.blur * torch.eye(2).double()
    opacity = torch.sigmoid(logits[indices])
    if view.antialiased:
        opacity = opacity * (torch.linalg.det(sharp) / torch.linalg.det(covariance)).clamp(min=0).sqrt()
    towards = means[indices] + turn.T @ shift  # from the camera's centre, a rotation's inverse being its transpose
    towards = towards / towards.norm(dim=-1, keepdim=True)
    used = min((degree + 1) ** 2 - 1, harmonics.shape[2])
    basis = real_harmonics(towards, math.isqrt(used + 1) - 1)
    table = torch.cat([colors[..., None], harmonics[..., :used]], -1)[indices]
    rgb = (0.5 + (table * basis[:, None]).sum(-1)).clamp(min=0)
    shortest = axes[torch.arange(len(indices)), :, log_scales[indices].argmin(-1)]
    normals = -shortest * (shortest * towards).sum(-1, keepdim=True).sign()
    return Projection(indices, plane * focal + middle, covariance, opacity, rgb, distance, normals)


# -- the image ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Image:
    """A picture, and the certainty of its pixels."""

    image: Tensor
    """(H, W, 7) colours over the background, distance and normals."""
    transmittance: Tensor
    median: Tensor
    certain: Tensor
    """(H, W) bool: no alpha, nor transmittance, is so near a bound that float32 could see it on the other side."""
    offsets: Tensor
    """(H * W, M, 2) from the centres to the pixels; the gradient belongs to each pixel alone."""
    blended: Tensor
    """(H * W, M) bool: the drawn Gaussians of each pixel."""


def seen(of: Projection, view: SplatCamera, background: Tensor) -> Image:
    """Draw projected Gaussians, pixel by pixel."""
    rows, columns = torch.meshgrid(torch.arange(view.height), torch.arange(view.width), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 1, 2).double() + 0.5
    offsets = pixels - of.centers
    inverse = torch.linalg.inv(of.covariances)
    raw = of.opacities * torch.exp(-0.5 * torch.einsum("pni,nij,pnj->pn", offsets, inverse, offsets))
    alpha = torch.where(raw < 1 / 255, 0.0, raw).clamp(max=0.999)
    through = torch.cat([torch.ones(len(pixels), 1).double(), (1 - alpha).cumprod(1)], 1)
    weight = torch.where(through[:, :-1] < 1e-4, 0.0, alpha * through[:, :-1])
    left = 1 - weight.sum(1)
    image = torch.cat([weight @ of.colors + left[:, None] * background, weight @ of.distances[:, None]], 1)
    image = torch.cat([image, weight @ of.normals], 1)
    after = 1 - weight.cumsum(1)
    half = (torch.cat([torch.ones_like(left)[:, None], after[:, :-1]], 1) > 0.5) & (after <= 0.5)
    median = (half * of.distances).sum(1)
    doubtful = ((raw * 255 - 1).abs() < 1e-3) | ((raw - 0.999).abs() < 1e-4)
    doubtful |= ((through[:, 1:] - 1e-4).abs() < 1e-6) | ((after - 0.5).abs() < 1e-4)
    shape = view.height, view.width
    return Image(
        image.view(*shape, 7), left.view(shape), median.view(shape), ~doubtful.any(1).view(shape), offsets, weight > 0
    )


def true_image(
    given: Sequence[Tensor], view: SplatCamera, background: Tensor = BACKGROUND, degree: int = 3
) -> Image:  # fmt: skip
    """Draw Gaussians in float64; `given` are the parameters and the pose."""
    with torch_on_one_thread():
        return seen(projected([tensor.double() for tensor in given], view, degree), view, background.double())


def drawn(
    given: Sequence[Tensor], view: SplatCamera, channels: int = 4, degree: int = 3, median: bool = False,
    background: Tensor = BACKGROUND,
) -> Blended:  # fmt: skip
    """Draw Gaussians by the three operations; `given` are the parameters and the pose."""
    *parameters, pose = given
    records, _ = project_gaussians(*parameters, replace(view, pose=pose), degree)
    return blend(records, tile_lists(records, view.width, view.height), view.width, view.height,
                 background.to(records), channels, median)  # fmt: skip


def leaves(given: Sequence[Tensor], dtype: torch.dtype = torch.float32) -> list[Tensor]:
    return [tensor.detach().to(dtype, copy=True).requires_grad_() for tensor in given]


@dataclass(frozen=True)
class Compared:
    """Largest errors over the largest value of each, on the pixels that are certain."""

    image: float
    transmittance: float
    gradients: dict[str, float]
    share: float
    """Share of the certain pixels."""

    def worst(self) -> float:
        return max(self.image, self.transmittance, *self.gradients.values())


def gradients(image: Tensor, through: Tensor, certain: Tensor, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the gradients of a sum with fixed random weights over the pixels that are `certain`."""
    chance = torch.Generator().manual_seed(5)
    of_image = torch.randn(image.shape, generator=chance).to(image) * certain[..., None]
    of_through = torch.randn(through.shape, generator=chance).to(through) * certain
    loss = (image * of_image).sum() + (through * of_through).sum()
    found = torch.autograd.grad(loss, list(inputs), allow_unused=True)
    return tuple(torch.zeros_like(x) if g is None else g for x, g in zip(inputs, found, strict=True))


@torch_on_one_thread()  # where others work, torch's threads wait for each other at every small operation
def compared(
    given: Sequence[Tensor], view: SplatCamera, channels: int = 4, degree: int = 3, dtype: torch.dtype = torch.float32
) -> Compared:
    """Compare value and gradients of a picture in `dtype` with the truth."""
    ours, exact = leaves(given, dtype), leaves(given, torch.float64)
    truth, found = true_image(exact, view, degree=degree), drawn(ours, view, channels, degree)
    known, image = truth.certain, truth.image[..., :channels]
    assert found.image.dtype == found.transmittance.dtype == dtype
    slopes = gradients(found.image, found.transmittance, known, ours)
    true_slopes = gradients(image, truth.transmittance, known, exact)
    errors = {
        name: relative_error(slope, true)
        for name, slope, true in zip(NAMES, slopes, true_slopes, strict=True)
        if true.numel()
    }
    return Compared(
        relative_error(found.image.detach()[known], image.detach()[known]),
        relative_error(found.transmittance.detach()[known], truth.transmittance.detach()[known]),
        errors,
        float(known.float().mean()),
    )


# -- growth -------------------------------------------------------------------------------------------------------


@torch_on_one_thread()
def growth_error(
    form: Callable[..., Blended], given: Sequence[Tensor], view: SplatCamera, device: torch.device | str = "cpu"
) -> float:
    """Compare the criterion of growth, after a form of `blend`, with the truth: for each Gaussian the sum over the
    pixels of the absolute gradient of its centre through that pixel alone, on an image with a longer side of 2
    units."""
    *parameters, pose = given
    truth = true_image(leaves(given, torch.float64), view)
    records = project_gaussians(*parameters, replace(view, pose=pose))[0].to(device).requires_grad_()
    lists = tile_lists(records, view.width, view.height)
    found = form(records, lists, view.width, view.height, BACKGROUND.to(device), 4, False)
    (slope,) = gradients(found.image, found.transmittance, truth.certain.to(device), [records])
    (of_offsets,) = gradients(truth.image[..., :4], truth.transmittance, truth.certain, [truth.offsets])
    longer = max(view.width, view.height)
    exact = of_offsets.abs().sum(0).norm(dim=-1) * longer / 2
    order = projected([tensor.double() for tensor in given], view, 0).indices
    cancelled = of_offsets.sum(0).norm(dim=-1) * longer / 2
    assert float((cancelled / exact.clamp(min=1e-9)).median()) < 0.5  # it is another thing than the plain gradient
    return relative_error(image_gradients(slope.cpu(), longer)[order], exact)
