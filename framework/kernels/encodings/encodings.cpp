// Encodings without parameters. See spherical_harmonics.py and frequency.py for the references.
#include "runtime/common.h"
#include "encodings/harmonics.h"

#include <cmath>
#include <vector>

namespace {

constexpr float LARGEST_ANGLE = 8192;  // limit for the three-part pi / 2 below

// sin and cos to 2 units in the last place of 1, for |x| <= LARGEST_ANGLE: x minus a whole number of quarter turns,
// then
// polynomials (Cephes' sinf and cosf).
inline void sine_and_cosine(Floats x, Floats& sine, Floats& cosine) {
    const Ints turns = __builtin_convertvector(x * 0.636619772f + (x < 0 ? splat(-0.5f) : splat(0.5f)), Ints);
    const Floats whole = __builtin_convertvector(turns, Floats);
    const Floats r = ((x - whole * 1.5703125f) - whole * 4.837512969970703e-4f) - whole * 7.549789948768648e-8f;
    const Floats square = r * r;
    const Floats s = ((splat(-1.9515295891e-4f) * square + 8.3321608736e-3f) * square - 1.6666654611e-1f) * square * r + r;
    const Floats c = ((splat(2.443315711809948e-5f) * square - 1.388731625493765e-3f) * square +
                      4.166664568298827e-2f) * square * square - 0.5f * square + 1.0f;
    const Floats one = turns & 1 ? c : s, other = turns & 1 ? s : c;
    sine = turns & 2 ? -one : one;
    cosine = (turns + 1) & 2 ? -other : other;
}

// The same for `count` values, a multiple of LANES; the standard library handles the rare large, infinite or NaN
// values.
void sines_and_cosines(const float* angles, int count, float* sines, float* cosines) {
    for (int i = 0; i < count; i += LANES) {
        Floats sine, cosine;
        sine_and_cosine(load(angles + i), sine, cosine);
        store(sines + i, sine);
        store(cosines + i, cosine);
        for (int j = i; j < i + LANES; j++)
            if (!(std::fabs(angles[j]) <= LARGEST_ANGLE)) {
                sines[j] = float(std::sin(double(angles[j])));
                cosines[j] = float(std::cos(double(angles[j])));
            }
    }
}

// Number of harmonics in `levels` bands.
inline int harmonics_of_levels(int levels) {
    if (levels < 1 || levels > 4) throw std::invalid_argument("spherical harmonics have 1 to 4 levels");
    return levels * levels;
}

}  // namespace

// Rows [x, sin(x), cos(x), sin(2 x), ...] of x (N, dims); x itself only if `include_input`.
EXPORT int frequency_encoding(const float* x, int64_t count, int dims, int frequencies, int include_input, float* out,
                              int threads) {
    return guarded([&] {
        const int values = dims * frequencies, padded = (values + LANES - 1) / LANES * LANES;
        const int64_t width = int64_t(values) * 2 + (include_input ? dims : 0);
        const size_t part = sizeof(float) * dims;
        for_ranges(threads, count, 256, [&](int64_t begin, int64_t end) {
            std::vector<float> angles(padded, 0.0f), sines(padded), cosines(padded);
            for (int64_t n = begin; n < end; n++) {
                float* row = out + n * width;
                if (include_input) {
                    std::memcpy(row, x + n * dims, part);
                    row += dims;
                }
                for (int k = 0; k < frequencies; k++)
                    for (int d = 0; d < dims; d++) angles[k * dims + d] = std::ldexp(1.0f, k) * x[n * dims + d];
                sines_and_cosines(angles.data(), padded, sines.data(), cosines.data());
                for (int k = 0; k < frequencies; k++, row += 2 * dims) {
                    std::memcpy(row, sines.data() + k * dims, part);
                    std::memcpy(row + dims, cosines.data() + k * dims, part);
                }
            }
        });
    });
}

// The gradient of x (N, dims), from the encoding's rows and their gradient.
EXPORT int frequency_encoding_backward(const float* rows, const float* grad, int64_t count, int dims, int frequencies,
                                       int include_input, float* x_grad, int threads) {
    return guarded([&] {
        const int first = include_input ? dims : 0;
        const int64_t width = int64_t(dims) * frequencies * 2 + first;
        for_each(threads, count, 512, [&](int64_t n) {
            const float *row = rows + n * width + first, *g = grad + n * width + first;
            for (int d = 0; d < dims; d++) {
                float sum = include_input ? grad[n * width + d] : 0.0f, scale = 1;
                for (int k = 0; k < frequencies; k++, scale *= 2) {
                    const int s = k * 2 * dims + d, c = s + dims;
                    sum += scale * (row[c] * g[s] - row[s] * g[c]);
                }
                x_grad[n * dims + d] = sum;
            }
        });
    });
}

// Real spherical harmonics of directions (N, 3), `levels` bands.
EXPORT int spherical_harmonics(const float* directions, int64_t count, int levels, float* out, int threads) {
    return guarded([&] {
        const int width = harmonics_of_levels(levels);
        for_each(threads, count, 2048, [&](int64_t n) {
            const float* d = directions + n * 3;
            out[n * width] = FIRST_HARMONIC;
            harmonics(d[0], d[1], d[2], width - 1, out + n * width + 1);
        });
    });
}

// The gradient (N, 3) of directions, from `grad` (N, levels^2) of their harmonics.
EXPORT int spherical_harmonics_backward(const float* directions, int64_t count, int levels, const float* grad,
                                        float* out, int threads) {
    return guarded([&] {
        const int width = harmonics_of_levels(levels);
        for_each(threads, count, 2048, [&](int64_t n) {
            const float* d = directions + n * 3;
            harmonics_gradient(d[0], d[1], d[2], width - 1, grad + n * width + 1, out + n * 3);
        });
    });
}
