// Encodings without parameters. See ../spherical_harmonics.py and ../frequency.py for the references.
#include "common.h"

#include <cmath>

// Real spherical harmonics of directions[owners[n]] (N), `levels` bands; owners may be null for directions[n].
EXPORT void spherical_harmonics(const float* directions, const int64_t* owners, int64_t count, int levels, float* out,
                                int threads) {
    const int width = levels * levels;
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t n = 0; n < count; n++) {
        const float* d = directions + (owners ? owners[n] : n) * 3;
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
        std::memcpy(out + n * width, all, sizeof(float) * width);
    }
}
