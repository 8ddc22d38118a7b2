// Real spherical harmonics of a direction. See ../spherical_harmonics.py for the reference.
#pragma once

#include <cstring>

// The first `width` of 16.
inline void harmonics_of(const float* d, int width, float* out) {
    const float x = d[0], y = d[1], z = d[2];
    const float all[16] = {
        0.28209479177387814f,
        -0.4886025119029199f * y,
        0.4886025119029199f * z,
        -0.4886025119029199f * x,
        1.0925484305920792f * x * y,
        -1.0925484305920792f * y * z,
        0.31539156525252005f * (3 * z * z - 1),
        -1.0925484305920792f * x * z,
        0.5462742152960396f * (x * x - y * y),
        -0.5900435899266435f * y * (3 * x * x - y * y),
        2.890611442640554f * x * y * z,
        -0.4570457994644658f * y * (5 * z * z - 1),
        0.3731763325901154f * z * (5 * z * z - 3),
        -0.4570457994644658f * x * (5 * z * z - 1),
        1.445305721320277f * z * (x * x - y * y),
        -0.5900435899266435f * x * (x * x - 3 * y * y),
    };
    std::memcpy(out, all, sizeof(float) * width);
}
