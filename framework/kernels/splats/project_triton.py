"""Projection of Gaussians to a pinhole camera's image, forward and backward, in Triton.

`nerfloom.kernels.splats.project` has the reference and the equations. Each thread processes a Gaussian. The backward
pass repeats the forward pass; only the records are saved.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.encodings.harmonics_triton import harmonics, harmonics_slope
from nerfloom.kernels.splats import project
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.kernels.splats.record_triton import (
    BLUE,
    CUT,
    DISTANCE,
    GREEN,
    NORMAL_X,
    OPACITY,
    REACH_X,
    REACH_Y,
    RECORD,
    RED,
    U_X,
    U_Y,
    V_Y,
    X,
    Y,
)
from nerfloom.kernels.splats.shapes_triton import (
    axes,
    column,
    column_back,
    covariance,
    plane,
    pose_back,
    position_back,
    put_three,
    quaternion,
    rotation_back,
    shape_back,
    to_camera,
    towards,
)
from nerfloom.kernels.triton_launch import blocks, launch, load_three, own_rows, store_three

BLOCK = 128
"""Gaussians that are taken together."""
MIN_ALPHA, DC = tl.constexpr(project.MIN_ALPHA), tl.constexpr(project.DC)


@triton.jit
def _color(colors, coefficients, n, here, stride, channel: tl.constexpr, x, y, z, BASIS: tl.constexpr):
    """Return a channel of the colours seen from directions x, y, z, before it is cut off below 0."""
    value = tl.load(colors + n * 3 + channel, mask=here, other=0.0) * DC + 0.5
    row = coefficients + (n * 3 + channel) * stride
    for k in tl.static_range(BASIS):
        value += harmonics(x, y, z, k + 1) * tl.load(row + k, mask=here, other=0.0)
    return value


@triton.jit
def _put_normal(record, here, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2, x, y, z):
    """Write the shortest axis, turned towards the camera."""
    second, third = (s1 < s0) & (s1 <= s2), (s2 < s0) & (s2 < s1)
    n0 = tl.where(third, r02, tl.where(second, r01, r00))
    n1 = tl.where(third, r12, tl.where(second, r11, r10))
    n2 = tl.where(third, r22, tl.where(second, r21, r20))
    sign = tl.where(n0 * x + n1 * y + n2 * z > 0, -1.0, 1.0)
    store_three(record + NORMAL_X, sign * n0, sign * n1, sign * n2, here)


@triton.jit
def _put_record(record, here, u, v, u_x, u_y, v_y, opacity, cut, reach_x, red, green, blue, distance, reach_y):
    tl.store(record + X, u, mask=here)
    tl.store(record + Y, v, mask=here)
    tl.store(record + U_X, u_x, mask=here)
    tl.store(record + U_Y, u_y, mask=here)
    tl.store(record + V_Y, v_y, mask=here)
    tl.store(record + OPACITY, opacity, mask=here)
    tl.store(record + CUT, cut, mask=here)
    tl.store(record + REACH_X, reach_x, mask=here)
    tl.store(record + RED, tl.where(red < 0, 0.0, red), mask=here)
    tl.store(record + GREEN, tl.where(green < 0, 0.0, green), mask=here)
    tl.store(record + BLUE, tl.where(blue < 0, 0.0, blue), mask=here)
    tl.store(record + DISTANCE, distance, mask=here)
    tl.store(record + REACH_Y, reach_y, mask=here)


@triton.jit(do_not_specialize=["count"])
def _forward(
    means, log_scales, rotations, logits, colors, coefficients, pose, records, dropped, count, stride, fx, fy, cx, cy,
    width, height, near, blur, ANTIALIASED: tl.constexpr, BASIS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    x, y, z = load_three(means + n * 3, here)
    p0, p1, p2 = to_camera(pose, x, y, z)
    w, i, j, k, norm, sound = quaternion(rotations, n, here)
    l0, l1, l2 = load_three(log_scales + n * 3, here)
    s0, s1, s2 = tl.exp(l0), tl.exp(l1), tl.exp(l2)
    logit = tl.load(logits + n, mask=here, other=0.0)
    valid = here & sound & (p2 > near)
    over, at_x, at_y, bounded_x, bounded_y = plane(p0, p1, tl.where(valid, p2, 1.0), fx, fy, cx, cy, width, height)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = axes(w, i, j, k)
    _, _, _, a0, b0 = column(pose, r00, r10, r20, s0, over, bounded_x, bounded_y, fx, fy)
    _, _, _, a1, b1 = column(pose, r01, r11, r21, s1, over, bounded_x, bounded_y, fx, fy)
    _, _, _, a2, b2 = column(pose, r02, r12, r22, s2, over, bounded_x, bounded_y, fx, fy)
    a, b, c, det, det_0, _, _, _ = covariance(a0, a1, a2, b0, b1, b2, blur)
    opacity = 1 / (1 + tl.exp(-logit))
    if ANTIALIASED:
        opacity *= tl.sqrt(det_0 / det)
    cut = tl.log(tl.maximum(opacity * (1 / MIN_ALPHA), 1e-30))
    reach_x, reach_y = tl.sqrt(2 * tl.maximum(cut, 0.0) * a), tl.sqrt(2 * tl.maximum(cut, 0.0) * c)
    u, v = fx * at_x + cx, fy * at_y + cy
    u_x, v_y = tl.sqrt(0.5 * c / det), tl.sqrt(0.5 / c)
    u_y = -b / c * u_x
    distance = tl.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    dx, dy, dz, _ = towards(x, y, z, pose)
    red = _color(colors, coefficients, n, here, stride, 0, dx, dy, dz, BASIS)
    green = _color(colors, coefficients, n, here, stride, 1, dx, dy, dz, BASIS)
    blue = _color(colors, coefficients, n, here, stride, 2, dx, dy, dz, BASIS)
    # A number times 0 is 0 only if it is finite. A Gaussian with an overflow on the way is not visible either, but not
    # counted.
    given = (x + y + z) * 0 + (l0 + l1 + l2) * 0 + (w + i + j + k + norm) * 0 + logit * 0 + (red + green + blue) * 0
    computed = (u + v) * 0 + (u_x + u_y + v_y + cut) * 0 + (reach_x + reach_y + distance) * 0
    tl.atomic_add(dropped, tl.sum((here & ((given != 0) | (sound == 0))).to(tl.int64), 0), sem="relaxed")
    visible = valid & (given + computed == 0) & (cut > 0) & (u + reach_x > 0) & (u - reach_x < width)
    visible = visible & (v + reach_y > 0) & (v - reach_y < height)
    record = records + n * RECORD
    _put_record(record, visible, u, v, u_x, u_y, v_y, opacity, cut, reach_x, red, green, blue, distance, reach_y)
    _put_normal(record, visible, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2, dx, dy, dz)


@triton.jit
def _colors_back(
    record, colors_grad, coefficients, of_coefficients, n, here, shown, stride, grad, x, y, z, channel: tl.constexpr,
    BASIS: tl.constexpr,
):  # fmt: skip
    """Write the gradients of a channel's coefficients; return the gradient of the direction."""
    seen = shown & (tl.load(record + RED + channel, mask=shown, other=0.0) > 0)  # else it was cut off below 0
    own = tl.where(seen, tl.load(grad + RED + channel, mask=shown, other=0.0), 0.0)
    tl.store(colors_grad + n * 3 + channel, own * DC, mask=here)
    of_x = tl.zeros_like(own)
    of_y, of_z = of_x, of_x
    row = (n * 3 + channel) * stride
    for k in tl.static_range(BASIS):
        tl.store(of_coefficients + row + k, tl.where(seen, own * harmonics(x, y, z, k + 1), 0.0), mask=here)
        of_value = own * tl.load(coefficients + row + k, mask=seen, other=0.0)
        by_x, by_y, by_z = harmonics_slope(x, y, z, k + 1)
        of_x += of_value * by_x
        of_y += of_value * by_y
        of_z += of_value * by_z
    return of_x, of_y, of_z


@triton.jit
def _directions_back(
    record, of_colors, coefficients, of_coefficients, n, here, shown, stride, grad, x, y, z, length, BASIS: tl.constexpr
):
    """Write the gradients of all colours; return the gradients of the positions through the view directions."""
    x0, y0, z0 = _colors_back(
        record, of_colors, coefficients, of_coefficients, n, here, shown, stride, grad, x, y, z, 0, BASIS
    )
    x1, y1, z1 = _colors_back(
        record, of_colors, coefficients, of_coefficients, n, here, shown, stride, grad, x, y, z, 1, BASIS
    )
    x2, y2, z2 = _colors_back(
        record, of_colors, coefficients, of_coefficients, n, here, shown, stride, grad, x, y, z, 2, BASIS
    )
    of_x, of_y, of_z = x0 + x1 + x2, y0 + y1 + y2, z0 + z1 + z2
    along = of_x * x + of_y * y + of_z * z
    return (of_x - along * x) / length, (of_y - along * y) / length, (of_z - along * z) / length


@triton.jit(do_not_specialize=["count"])
def _backward(
    means, log_scales, rotations, logits, coefficients, pose, records, gradient, of_means, of_log_scales, of_rotations,
    of_logits, of_colors, of_coefficients, of_pose, count, stride, fx, fy, cx, cy, width, height, blur,
    ANTIALIASED: tl.constexpr, BASIS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    record, grad = records + n * RECORD, gradient + n * RECORD
    shown = here & (tl.load(record + CUT, mask=here, other=0.0) > 0)
    x, y, z = load_three(means + n * 3, shown)
    p0, p1, p2 = to_camera(pose, x, y, z)
    w, i, j, k, norm, _ = quaternion(rotations, n, shown)
    s0, s1, s2 = load_three(log_scales + n * 3, shown)
    s0, s1, s2 = tl.exp(s0), tl.exp(s1), tl.exp(s2)
    over, at_x, at_y, bounded_x, bounded_y = plane(p0, p1, tl.where(shown, p2, 1.0), fx, fy, cx, cy, width, height)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = axes(w, i, j, k)
    _, _, _, a0, b0 = column(pose, r00, r10, r20, s0, over, bounded_x, bounded_y, fx, fy)
    _, _, _, a1, b1 = column(pose, r01, r11, r21, s1, over, bounded_x, bounded_y, fx, fy)
    _, _, _, a2, b2 = column(pose, r02, r12, r22, s2, over, bounded_x, bounded_y, fx, fy)
    base = 1 / (1 + tl.exp(-tl.load(logits + n, mask=shown, other=0.0)))
    of_a0, of_a1, of_a2, of_b0, of_b1, of_b2, of_base = shape_back(
        grad, shown, a0, a1, a2, b0, b1, b2, blur, base, ANTIALIASED
    )
    tl.store(of_logits + n, tl.where(shown, of_base * base * (1 - base), 0.0), mask=here)
    g00, g10, g20, of_s0, v00, v10, v20, over_0, x_0, y_0 = column_back(
        pose, of_a0, of_b0, r00, r10, r20, s0, over, bounded_x, bounded_y, fx, fy
    )
    g01, g11, g21, of_s1, v01, v11, v21, over_1, x_1, y_1 = column_back(
        pose, of_a1, of_b1, r01, r11, r21, s1, over, bounded_x, bounded_y, fx, fy
    )
    g02, g12, g22, of_s2, v02, v12, v22, over_2, x_2, y_2 = column_back(
        pose, of_a2, of_b2, r02, r12, r22, s2, over, bounded_x, bounded_y, fx, fy
    )
    put_three(of_log_scales, n, here, shown, of_s0, of_s1, of_s2)
    of_w, of_i, of_j, of_k = rotation_back(w, i, j, k, norm, g00, g01, g02, g10, g11, g12, g20, g21, g22)
    tl.store(of_rotations + n * 4, tl.where(shown, of_w, 0.0), mask=here)
    put_three(of_rotations + n + 1, n, here, shown, of_i, of_j, of_k)
    of_p0, of_p1, of_p2 = position_back(
        grad, shown, p0, p1, p2, over, at_x, at_y, bounded_x, bounded_y, over_0 + over_1 + over_2, x_0 + x_1 + x_2,
        y_0 + y_1 + y_2, fx, fy,
    )  # fmt: skip
    dx, dy, dz, length = towards(x, y, z, pose)
    of_x, of_y, of_z = _directions_back(
        record, of_colors, coefficients, of_coefficients, n, here, shown, stride, grad, dx, dy, dz, length, BASIS
    )
    of_m0 = of_x + tl.load(pose) * of_p0 + tl.load(pose + 4) * of_p1 + tl.load(pose + 8) * of_p2
    of_m1 = of_y + tl.load(pose + 1) * of_p0 + tl.load(pose + 5) * of_p1 + tl.load(pose + 9) * of_p2
    of_m2 = of_z + tl.load(pose + 2) * of_p0 + tl.load(pose + 6) * of_p1 + tl.load(pose + 10) * of_p2
    put_three(of_means, n, here, shown, of_m0, of_m1, of_m2)
    if of_pose is not None:
        pose_back(
            of_pose, shown, pose, of_p0, of_p1, of_p2, x, y, z, of_x, of_y, of_z, v00, v01, v02, v10, v11, v12, v20,
            v21, v22, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2,
        )  # fmt: skip


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: SplatCamera, basis: int, dropped: Tensor, *tensors: Tensor) -> Tensor:
        *parameters, pose = tensors
        count, stride = len(parameters[0]), parameters[5].shape[2]
        records = parameters[0].new_zeros(count, project.RECORD)
        view = *camera.intrinsics, float(camera.width), float(camera.height)
        constants: dict[str, Any] = {"ANTIALIASED": camera.antialiased, "BASIS": basis, "BLOCK": BLOCK}
        launch(
            _forward, (blocks(count, BLOCK),), *parameters, pose, records, dropped, count, stride, *view, camera.near,
            camera.blur, **constants,
        )  # fmt: skip
        ctx.save_for_backward(*parameters, pose, records)
        ctx.settings = (*view, camera.blur), constants
        return records

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, log_scales, rotations, logits, colors, coefficients, pose, records = ctx.saved_tensors
        view, constants = ctx.settings
        count, stride, programs = len(means), coefficients.shape[2], blocks(len(means), BLOCK)
        out = [torch.empty_like(each) for each in (means, log_scales, rotations, logits, colors)]
        unused = constants["BASIS"] < stride
        out.append(torch.zeros_like(coefficients) if unused else torch.empty_like(coefficients))
        sums = means.new_empty(programs, 3, 4) if ctx.needs_input_grad[-1] else None
        launch(
            _backward, (programs,), means, log_scales, rotations, logits, coefficients, pose, records,
            gradient.contiguous(), *out, sums, count, stride, *view, **constants,
        )  # fmt: skip
        return None, None, None, *out, None if sums is None else sums.sum(0, dtype=torch.float64).to(pose.dtype)


def project_gaussians(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    camera: SplatCamera, basis: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Compute `project.project_reference` for a pinhole camera, with first derivatives.

    `means`, `log_scales`, `rotations`, `logits`, `colors`, `harmonics`, `camera` and `basis` are as there. The number
    of Gaussians that are left out stays on the GPU.
    """
    tensors = [t.contiguous() for t in (means, log_scales, rotations, logits, colors, harmonics, camera.pose)]
    dropped = torch.zeros((), dtype=torch.int64, device=means.device)
    return _Project.apply(camera, basis, dropped, *tensors), dropped
