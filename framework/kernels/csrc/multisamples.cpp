// Points in conical frustums, in the unit cube of a grid (Zip-NeRF). See ../multisamples.py for the reference.
#include "common.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace {

constexpr int POINTS = 6;
constexpr float HALF_ROOT_3 = 0.866025404f, ROOT_HALF = 0.707106781f, SPREAD = 1.133893419f;  // 3 / sqrt(7)
constexpr float COSINES[POINTS] = {1, -0.5f, -0.5f, -1, 0.5f, 0.5f};
constexpr float SINES[POINTS] = {0, HALF_ROOT_3, -HALF_ROOT_3, 0, -HALF_ROOT_3, HALF_ROOT_3};

inline Floats root(Floats x) {
    alignas(64) float lanes[LANES];
    store(lanes, x);
    for (int i = 0; i < LANES; i++) lanes[i] = std::sqrt(lanes[i]);
    return load(lanes);
}

// The cube root of x >= 0: a third of the exponent as a first guess, and two steps of Halley's method.
inline Floats cube_root(Floats x) {
    Ints bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits = bits / 3 + 709958130;
    Floats t;
    std::memcpy(&t, &bits, sizeof t);
    for (int step = 0; step < 2; step++) {
        const Floats cube = t * t * t;
        t = t * (cube + 2.0f * x) / (2.0f * cube + x);
    }
    return x > 0 ? t : x;
}

// A row of (count, 3) for each lane.
inline void load_rows(const float* from, int64_t first, int size, Floats* xyz) {
    alignas(64) float lanes[3][LANES] = {};
    for (int s = 0; s < size; s++)
        for (int axis = 0; axis < 3; axis++) lanes[axis][s] = from[(first + s) * 3 + axis];
    for (int axis = 0; axis < 3; axis++) xyz[axis] = load(lanes[axis]);
}

inline Floats load_some(const float* from, int64_t first, int size) {
    alignas(64) float lanes[LANES] = {};
    std::memcpy(lanes, from + first, sizeof(float) * size_t(size));
    return load(lanes);
}

// From a position in half edges to the unit cube; `shrunk` becomes the cube root of the contraction's determinant.
inline void contract(Floats* x, Floats& shrunk) {
    const Floats limit = splat(std::numeric_limits<float>::max());
    Floats largest = splat(1);
    for (int axis = 0; axis < 3; axis++) {
        x[axis] = x[axis] > limit ? limit : x[axis] < -limit ? -limit : x[axis];  // NaN stays
        largest = larger(magnitude(x[axis]), largest);
    }
    const Floats inverse_largest = 1.0f / largest;
    Floats squared = splat(0);
    for (int axis = 0; axis < 3; axis++) {
        x[axis] *= inverse_largest;
        squared += x[axis] * x[axis];
    }
    const Floats inverse_norm = 1.0f / root(squared < 1 ? splat(1) : squared);
    const Floats inverse = inverse_norm * inverse_largest;  // 1 / max(1, |x|)
    for (int axis = 0; axis < 3; axis++) x[axis] = 0.25f * x[axis] * (2.0f - inverse) * inverse_norm + 0.5f;
    const Floats power = cube_root(inverse * inverse * (2.0f - inverse));
    shrunk = power * power;
}

}  // namespace

// 6 points (x, y, z, deviation) in each of `count` frustums. `cosines` and `sines` are those of the pattern's rotation,
// `mirrors` 1 or -1. A position p becomes (p - centre) * scale and, if `contracted`, is contracted from there; a
// deviation is multiplied by `deviation_scale`, which includes that of the box.
EXPORT int multisamples(const float* origins, const float* directions, const float* t_starts, const float* t_ends,
                        const float* radii, const float* cosines, const float* sines, const float* mirrors,
                        int64_t count, const float* centre, const float* scale, float deviation_scale, int contracted,
                        float* out, int threads) {
    return guarded([&] {
        for_each(threads, (count + LANES - 1) / LANES, 1024 / LANES, [&](int64_t b) {
            const int64_t n = b * LANES;
            const int size = int(std::min<int64_t>(LANES, count - n));
            Floats o[3], d[3], first[3], second[3];
            load_rows(origins, n, size, o);
            load_rows(directions, n, size, d);
            const Floats start = load_some(t_starts, n, size), end = load_some(t_ends, n, size);
            const Floats radius = load_some(radii, n, size), mirror = load_some(mirrors, n, size);
            const Floats cosine = load_some(cosines, n, size), sine = load_some(sines, n, size);
            const Floats sign = d[2] < 0 ? splat(-1) : splat(1), a = -1.0f / (sign + d[2]), xy = d[0] * d[1] * a;
            first[0] = 1.0f + sign * d[0] * d[0] * a, first[1] = sign * xy, first[2] = -sign * d[0];
            second[0] = xy, second[1] = sign + d[1] * d[1] * a, second[2] = -d[1];
            const Floats middle = 0.5f * start + 0.5f * end, half = 0.5f * end - 0.5f * start;
            const Floats share = middle > 0 ? half / middle : splat(0), squared = share * share;
            const Floats base = (1.0f + share) * (1.0f + share) + 2.0f, step = half / (squared + 3.0f);
            const Floats spread = SPREAD * root((squared - 1.0f) * (squared - 1.0f) + 4.0f);
            for (int j = 0; j < POINTS; j++) {
                const float along = float(2 * j - (POINTS - 1)) / (POINTS - 1);
                const Floats t = start + step * (base + along * spread), away = radius * t * ROOT_HALF;
                const Floats u = away * (COSINES[j] * cosine - SINES[j] * sine);
                const Floats v = away * (SINES[j] * cosine + COSINES[j] * sine) * mirror;
                Floats x[3], deviation = away * deviation_scale;
                for (int axis = 0; axis < 3; axis++)
                    x[axis] = (o[axis] + t * d[axis] + u * first[axis] + v * second[axis] - centre[axis]) * scale[axis];
                if (contracted) {
                    Floats shrunk;
                    contract(x, shrunk);
                    deviation *= shrunk;
                }
                alignas(64) float lanes[4][LANES];
                for (int axis = 0; axis < 3; axis++) store(lanes[axis], x[axis]);
                store(lanes[3], deviation);
                for (int s = 0; s < size; s++) {
                    float* to = out + ((n + s) * POINTS + j) * 4;
                    for (int i = 0; i < 4; i++) to[i] = lanes[i][s];
                }
            }
        });
    });
}
