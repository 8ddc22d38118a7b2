"""Real spherical harmonics and their derivatives, as functions for kernels: Sloan 2008, appendix A2."""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

import triton
import triton.language as tl


@triton.jit
def harmonics(x, y, z, k: tl.constexpr):
    """Return the real spherical harmonic number `k`, 1 to 15, of directions `x`, `y`, `z`."""
    value = x
    if k == 1:
        value = -0.4886025119029199 * y
    if k == 2:
        value = 0.4886025119029199 * z
    if k == 3:
        value = -0.4886025119029199 * x
    if k == 4:
        value = 1.0925484305920792 * x * y
    if k == 5:
        value = -1.0925484305920792 * y * z
    if k == 6:
        value = 0.31539156525252005 * (3 * z * z - 1)
    if k == 7:
        value = -1.0925484305920792 * x * z
    if k == 8:
        value = 0.5462742152960396 * (x * x - y * y)
    if k == 9:
        value = -0.5900435899266435 * y * (3 * x * x - y * y)
    if k == 10:
        value = 2.890611442640554 * x * y * z
    if k == 11:
        value = -0.4570457994644658 * y * (5 * z * z - 1)
    if k == 12:
        value = 0.3731763325901154 * z * (5 * z * z - 3)
    if k == 13:
        value = -0.4570457994644658 * x * (5 * z * z - 1)
    if k == 14:
        value = 1.445305721320277 * z * (x * x - y * y)
    if k == 15:
        value = -0.5900435899266435 * x * (x * x - 3 * y * y)
    return value


@triton.jit
def harmonics_slope(x, y, z, k: tl.constexpr):
    """Return the derivatives by `x`, `y` and `z` of harmonic number `k`, 1 to 15."""
    zero = tl.zeros_like(x)
    by_x, by_y, by_z = zero, zero, zero
    if k == 1:
        by_y = zero - 0.4886025119029199
    if k == 2:
        by_z = zero + 0.4886025119029199
    if k == 3:
        by_x = zero - 0.4886025119029199
    if k == 4:
        by_x, by_y = 1.0925484305920792 * y, 1.0925484305920792 * x
    if k == 5:
        by_y, by_z = -1.0925484305920792 * z, -1.0925484305920792 * y
    if k == 6:
        by_z = 6 * 0.31539156525252005 * z
    if k == 7:
        by_x, by_z = -1.0925484305920792 * z, -1.0925484305920792 * x
    if k == 8:
        by_x, by_y = 1.0925484305920792 * x, -1.0925484305920792 * y
    if k == 9:
        by_x, by_y = -0.5900435899266435 * 6 * x * y, -0.5900435899266435 * 3 * (x * x - y * y)
    if k == 10:
        by_x, by_y, by_z = 2.890611442640554 * y * z, 2.890611442640554 * x * z, 2.890611442640554 * x * y
    if k == 11:
        by_y, by_z = -0.4570457994644658 * (5 * z * z - 1), -0.4570457994644658 * 10 * y * z
    if k == 12:
        by_z = 0.3731763325901154 * (15 * z * z - 3)
    if k == 13:
        by_x, by_z = -0.4570457994644658 * (5 * z * z - 1), -0.4570457994644658 * 10 * x * z
    if k == 14:
        by_x, by_y = 2 * 1.445305721320277 * x * z, -2 * 1.445305721320277 * y * z
        by_z = 1.445305721320277 * (x * x - y * y)
    if k == 15:
        by_x, by_y = -0.5900435899266435 * 3 * (x * x - y * y), 0.5900435899266435 * 6 * x * y
    return by_x, by_y, by_z
