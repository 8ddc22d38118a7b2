"""Functions for kernels, from Gaussians to ellipses on a pinhole camera's image and back.

`nerfloom.kernels.splats.project` has the equations. T has the rows a and b, the covariance of an ellipse the entries a,
b and c. A name that starts with `of_` is a gradient, of the variable named after it. All values are vectors, of a
Gaussian in each lane, but for the camera's; `pose` and the like are pointers.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

import triton
import triton.language as tl

from nerfloom.kernels.splats.record_triton import DISTANCE, OPACITY, U_X, U_Y, V_Y, X, Y
from nerfloom.kernels.triton_launch import store_three


@triton.jit
def put_three(values, n, here, shown, x, y, z):
    """Write `x`, `y` and `z` to the rows `n` of `values` that are `here`, and zeros unless they are `shown`."""
    store_three(values + n * 3, tl.where(shown, x, 0.0), tl.where(shown, y, 0.0), tl.where(shown, z, 0.0), here)


@triton.jit
def to_camera(pose, x, y, z):
    """Return positions `x`, `y`, `z` in the frame of the camera of a `pose`."""
    p0 = tl.load(pose) * x + tl.load(pose + 1) * y + tl.load(pose + 2) * z + tl.load(pose + 3)
    p1 = tl.load(pose + 4) * x + tl.load(pose + 5) * y + tl.load(pose + 6) * z + tl.load(pose + 7)
    p2 = tl.load(pose + 8) * x + tl.load(pose + 9) * y + tl.load(pose + 10) * z + tl.load(pose + 11)
    return p0, p1, p2


@triton.jit
def _centre(pose):
    """Return the camera's centre, scene coordinates."""
    t0, t1, t2 = tl.load(pose + 3), tl.load(pose + 7), tl.load(pose + 11)
    x = -(tl.load(pose) * t0 + tl.load(pose + 4) * t1 + tl.load(pose + 8) * t2)
    y = -(tl.load(pose + 1) * t0 + tl.load(pose + 5) * t1 + tl.load(pose + 9) * t2)
    z = -(tl.load(pose + 2) * t0 + tl.load(pose + 6) * t1 + tl.load(pose + 10) * t2)
    return x, y, z


@triton.jit
def quaternion(rotations, n, here):
    """Return rows `n` of `rotations` that are `here`, as unit quaternions, their lengths, and whether these suffice.

    Where a length does not suffice, 1 is returned for it.
    """
    row = rotations + n * 4
    w, x = tl.load(row, mask=here, other=1.0), tl.load(row + 1, mask=here, other=0.0)
    y, z = tl.load(row + 2, mask=here, other=0.0), tl.load(row + 3, mask=here, other=0.0)
    squared = w * w + x * x + y * y + z * z
    sound = squared > 1e-24
    norm = tl.sqrt(tl.where(sound, squared, 1.0))
    return w / norm, x / norm, y / norm, z / norm, norm, sound


@triton.jit
def axes(w, x, y, z):
    """Return the rotation matrices of unit quaternions `w`, `x`, `y`, `z`, row by row."""
    r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r10, r11, r12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r00, r01, r02, r10, r11, r12, r20, r21, r22


@triton.jit
def plane(p0, p1, depth, fx, fy, cx, cy, width, height):
    """Return 1 / z, x / z and y / z, and both again as the Jacobian takes them, bounded.

    Its arguments are `p0, p1, depth, fx, fy, cx, cy, width, height`.
    """
    over = 1 / depth
    x, y = p0 * over, p1 * over
    margin_x, margin_y = 0.15 * width, 0.15 * height
    bounded_x = tl.minimum(tl.maximum(x, (-margin_x - cx) / fx), (width + margin_x - cx) / fx)
    bounded_y = tl.minimum(tl.maximum(y, (-margin_y - cy) / fy), (height + margin_y - cy) / fy)
    return over, x, y, bounded_x, bounded_y


@triton.jit
def column(pose, r0, r1, r2, s, over, bounded_x, bounded_y, fx, fy):
    """Return an axis times its scale in the camera's frame, and its image under the Jacobian.

    Its arguments are `pose, r0, r1, r2, s, over, bounded_x, bounded_y, fx, fy`.
    """
    v0 = (tl.load(pose) * r0 + tl.load(pose + 1) * r1 + tl.load(pose + 2) * r2) * s
    v1 = (tl.load(pose + 4) * r0 + tl.load(pose + 5) * r1 + tl.load(pose + 6) * r2) * s
    v2 = (tl.load(pose + 8) * r0 + tl.load(pose + 9) * r1 + tl.load(pose + 10) * r2) * s
    return v0, v1, v2, fx * over * (v0 - bounded_x * v2), fy * over * (v1 - bounded_y * v2)


@triton.jit
def covariance(a0, a1, a2, b0, b1, b2, blur):
    """Return the covariance a, b, c, its determinant, that without the `blur`, and the product of the rows of T.

    The rows are `a0, a1, a2` and `b0, b1, b2`.
    """
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    first, second = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
    det_0 = c0 * c0 + c1 * c1 + c2 * c2
    det = det_0 + blur * (first + second) + blur * blur  # no difference, so nothing cancels
    return first + blur, a0 * b0 + a1 * b1 + a2 * b2, second + blur, det, det_0, c0, c1, c2


@triton.jit
def towards(x, y, z, pose):
    """Return the unit vectors from the camera of a `pose` to positions `x`, `y`, `z`, and the distances."""
    center_x, center_y, center_z = _centre(pose)
    x, y, z = x - center_x, y - center_y, z - center_z
    length = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-20)
    return x / length, y / length, z / length, length


@triton.jit
def shape_back(grad, shown, a0, a1, a2, b0, b1, b2, blur, base, ANTIALIASED: tl.constexpr):
    """Return the gradients of the rows of T, and of the logistic, from the gradients of u_x, u_y, v_y and the opacity.

    u_x = sqrt(c / (2 det)), u_y = -b / sqrt(2 c det), v_y = 1 / sqrt(2 c).

    Its arguments are `grad, shown, a0, a1, a2, b0, b1, b2, blur, base, ANTIALIASED`.
    """
    _, b, c, det, det_0, c0, c1, c2 = covariance(a0, a1, a2, b0, b1, b2, blur)
    of_u_x = tl.load(grad + U_X, mask=shown, other=0.0)
    of_u_y = tl.load(grad + U_Y, mask=shown, other=0.0)
    of_v_y = tl.load(grad + V_Y, mask=shown, other=0.0)
    of_opacity = tl.load(grad + OPACITY, mask=shown, other=0.0)
    u_x, v_y = tl.sqrt(0.5 * c / det), tl.sqrt(0.5 / c)
    u_y = -b / c * u_x
    of_det = -0.5 / det * (of_u_x * u_x + of_u_y * u_y)
    of_b = -of_u_y / c * u_x
    of_c = 0.5 / c * (of_u_x * u_x - of_u_y * u_y - of_v_y * v_y)
    of_det_0, of_base = tl.zeros_like(det), of_opacity
    if ANTIALIASED:  # factor = sqrt(det_0 / det)
        factor = tl.sqrt(det_0 / det)
        of_factor, of_base = of_opacity * base, of_opacity * factor
        of_det -= 0.5 * of_factor * factor / det
        of_det_0 = 0.5 * of_factor / tl.maximum(factor * det, 1e-30)
    # det = det_0 + blur (|a|^2 + |b|^2) + blur^2, det_0 = |a x b|^2; through the covariance it would cancel.
    of_det_0 += of_det
    over, more = 2 * of_det_0, 2 * blur * of_det
    of_a0 = of_b * b0 + more * a0 + over * (b1 * c2 - b2 * c1)
    of_a1 = of_b * b1 + more * a1 + over * (b2 * c0 - b0 * c2)
    of_a2 = of_b * b2 + more * a2 + over * (b0 * c1 - b1 * c0)
    of_b0 = of_b * a0 + (2 * of_c + more) * b0 + over * (c1 * a2 - c2 * a1)
    of_b1 = of_b * a1 + (2 * of_c + more) * b1 + over * (c2 * a0 - c0 * a2)
    of_b2 = of_b * a2 + (2 * of_c + more) * b2 + over * (c0 * a1 - c1 * a0)
    return of_a0, of_a1, of_a2, of_b0, of_b1, of_b2, of_base


@triton.jit
def column_back(pose, of_a, of_b, r0, r1, r2, s, over, bounded_x, bounded_y, fx, fy):
    """Return the gradients of an axis, of its scale, of their product in the camera's frame, and of J's rows.

    Its arguments are `pose, of_a, of_b, r0, r1, r2, s, over, bounded_x, bounded_y, fx, fy`.
    """
    v0, v1, v2, _, _ = column(pose, r0, r1, r2, s, over, bounded_x, bounded_y, fx, fy)
    of_v0, of_v1 = fx * over * of_a, fy * over * of_b
    of_v2 = -bounded_x * of_v0 - bounded_y * of_v1
    of_0 = tl.load(pose) * of_v0 + tl.load(pose + 4) * of_v1 + tl.load(pose + 8) * of_v2
    of_1 = tl.load(pose + 1) * of_v0 + tl.load(pose + 5) * of_v1 + tl.load(pose + 9) * of_v2
    of_2 = tl.load(pose + 2) * of_v0 + tl.load(pose + 6) * of_v1 + tl.load(pose + 10) * of_v2
    of_s = of_0 * r0 + of_1 * r1 + of_2 * r2
    # The Jacobian's entries that are not 0 are 1 / z twice, and -x / z^2 and -y / z^2.
    of_over = fx * of_a * v0 + fy * of_b * v1
    return of_0 * s, of_1 * s, of_2 * s, of_s * s, of_v0, of_v1, of_v2, of_over, fx * of_a * v2, fy * of_b * v2


@triton.jit
def rotation_back(w, x, y, z, norm, g00, g01, g02, g10, g11, g12, g20, g21, g22):
    """Return the gradients of quaternions from the gradients of the matrices (`_axes`).

    Its arguments are `w, x, y, z, norm, g00, g01, g02, g10, g11, g12, g20, g21, g22`.
    """
    of_w = 2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    of_x = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2 * x * (g11 + g22))
    of_y = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2 * y * (g00 + g22))
    of_z = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2 * z * (g00 + g11))
    radial = of_w * w + of_x * x + of_y * y + of_z * z
    return (
        (of_w - radial * w) / norm,
        (of_x - radial * x) / norm,
        (of_y - radial * y) / norm,
        (of_z - radial * z) / norm,
    )


@triton.jit
def position_back(grad, shown, p0, p1, p2, over, at_x, at_y, bounded_x, bounded_y, of_over, of_jx, of_jy, fx, fy):
    """Return the gradients of the centre in the camera's frame: of the image position, the Jacobian, the distance.

    Its arguments are `grad, shown, p0, p1, p2, over, at_x, at_y, bounded_x, bounded_y, of_over, of_jx, of_jy, fx,
    fy`.
    """
    of_over = of_over - bounded_x * of_jx - bounded_y * of_jy
    of_x = fx * tl.load(grad + X, mask=shown, other=0.0) - tl.where(bounded_x == at_x, over * of_jx, 0.0)
    of_y = fy * tl.load(grad + Y, mask=shown, other=0.0) - tl.where(bounded_y == at_y, over * of_jy, 0.0)
    by_distance = tl.load(grad + DISTANCE, mask=shown, other=0.0)
    by_distance /= tl.maximum(tl.sqrt(p0 * p0 + p1 * p1 + p2 * p2), 1e-20)
    of_p2 = -over * over * (of_over + of_x * p0 + of_y * p1)
    return of_x * over + by_distance * p0, of_y * over + by_distance * p1, of_p2 + by_distance * p2


@triton.jit
def _pose_row(
    sums, shown, pose, i: tl.constexpr, of_p, x, y, z, of_x, of_y, of_z, g0, g1, g2, r00, r01, r02, r10, r11, r12, r20,
    r21, r22,
):  # fmt: skip
    """Write a program's sums for row i of the pose; its entries count as independent.

    They are of the centre, of the axes (g: gradients of their rows times the scales), and of the camera's centre.
    """
    t = tl.load(pose + i * 4 + 3)
    by_0 = of_p * x + t * of_x + g0 * r00 + g1 * r01 + g2 * r02
    by_1 = of_p * y + t * of_y + g0 * r10 + g1 * r11 + g2 * r12
    by_2 = of_p * z + t * of_z + g0 * r20 + g1 * r21 + g2 * r22
    by_t = of_p + tl.load(pose + i * 4) * of_x + tl.load(pose + i * 4 + 1) * of_y + tl.load(pose + i * 4 + 2) * of_z
    row = sums + tl.program_id(0) * 12 + i * 4
    tl.store(row, tl.sum(tl.where(shown, by_0, 0.0), 0))
    tl.store(row + 1, tl.sum(tl.where(shown, by_1, 0.0), 0))
    tl.store(row + 2, tl.sum(tl.where(shown, by_2, 0.0), 0))
    tl.store(row + 3, tl.sum(tl.where(shown, by_t, 0.0), 0))


@triton.jit
def pose_back(
    sums, shown, pose, of_p0, of_p1, of_p2, x, y, z, of_x, of_y, of_z, v00, v01, v02, v10, v11, v12, v20, v21, v22,
    r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2,
):  # fmt: skip
    """Write a program's sums for the pose: of the centre, of the axes, and of the camera's centre.

    Its arguments are `sums, shown, pose, of_p0, of_p1, of_p2, x, y, z, of_x, of_y, of_z, v00, v01, v02, v10, v11,
    v12, v20, v21, v22, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2`.
    """
    _pose_row(
        sums, shown, pose, 0, of_p0, x, y, z, of_x, of_y, of_z, v00 * s0, v01 * s1, v02 * s2, r00, r01, r02, r10, r11,
        r12, r20, r21, r22,
    )  # fmt: skip
    _pose_row(
        sums, shown, pose, 1, of_p1, x, y, z, of_x, of_y, of_z, v10 * s0, v11 * s1, v12 * s2, r00, r01, r02, r10, r11,
        r12, r20, r21, r22,
    )  # fmt: skip
    _pose_row(
        sums, shown, pose, 2, of_p2, x, y, z, of_x, of_y, of_z, v20 * s0, v21 * s1, v22 * s2, r00, r01, r02, r10, r11,
        r12, r20, r21, r22,
    )  # fmt: skip
