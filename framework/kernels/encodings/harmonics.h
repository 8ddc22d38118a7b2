// Real spherical harmonics of directions (Sloan 2008), for a single one or a vector. See spherical_harmonics.py for
// the reference.
#pragma once

constexpr float FIRST_HARMONIC = 0.28209479177387814f;  // constant over directions

// The first `basis` harmonics of degrees 1 to 3: 3, 8 or 15.
template <typename T>
inline void harmonics(T x, T y, T z, int basis, T* b) {
    if (basis >= 3) b[0] = -0.4886025119029199f * y, b[1] = 0.4886025119029199f * z, b[2] = -0.4886025119029199f * x;
    if (basis >= 8) {
        b[3] = 1.0925484305920792f * x * y;
        b[4] = -1.0925484305920792f * y * z;
        b[5] = 0.31539156525252005f * (3 * z * z - 1);
        b[6] = -1.0925484305920792f * x * z;
        b[7] = 0.5462742152960396f * (x * x - y * y);
    }
    if (basis >= 15) {
        b[8] = -0.5900435899266435f * y * (3 * x * x - y * y);
        b[9] = 2.890611442640554f * x * y * z;
        b[10] = -0.4570457994644658f * y * (5 * z * z - 1);
        b[11] = 0.3731763325901154f * z * (5 * z * z - 3);
        b[12] = -0.4570457994644658f * x * (5 * z * z - 1);
        b[13] = 1.445305721320277f * z * (x * x - y * y);
        b[14] = -0.5900435899266435f * x * (x * x - 3 * y * y);
    }
}

// The gradient of the sum of g[k] times each harmonic.
template <typename T>
inline void harmonics_gradient(T x, T y, T z, int basis, const T* g, T* out) {
    T gx{}, gy{}, gz{};
    if (basis >= 3) gy -= 0.4886025119029199f * g[0], gz += 0.4886025119029199f * g[1], gx -= 0.4886025119029199f * g[2];
    if (basis >= 8) {
        gx += 1.0925484305920792f * (y * g[3] - z * g[6] + x * g[7]);
        gy += 1.0925484305920792f * (x * g[3] - z * g[4] - y * g[7]);
        gz += -1.0925484305920792f * (y * g[4] + x * g[6]) + 6 * 0.31539156525252005f * z * g[5];
    }
    if (basis >= 15) {
        gx += -0.5900435899266435f * 6 * x * y * g[8] + 2.890611442640554f * y * z * g[9] -
              0.4570457994644658f * (5 * z * z - 1) * g[12] + 2 * 1.445305721320277f * x * z * g[13] -
              0.5900435899266435f * 3 * (x * x - y * y) * g[14];
        gy += -0.5900435899266435f * 3 * (x * x - y * y) * g[8] + 2.890611442640554f * x * z * g[9] -
              0.4570457994644658f * (5 * z * z - 1) * g[10] - 2 * 1.445305721320277f * y * z * g[13] +
              0.5900435899266435f * 6 * x * y * g[14];
        gz += 2.890611442640554f * x * y * g[9] - 0.4570457994644658f * 10 * z * (y * g[10] + x * g[12]) +
              0.3731763325901154f * (15 * z * z - 3) * g[11] + 1.445305721320277f * (x * x - y * y) * g[13];
    }
    out[0] = gx, out[1] = gy, out[2] = gz;
}
