// Points in conical frustums, in the unit cube of a grid (Zip-NeRF): several per frustum, or one ball of its volume.
// See multisamples.py for the references.
#include "runtime/common.h"

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

// The cube root of x >= 0: a third of the exponent as initial guess, and two steps of Halley's method.
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

// A row of (count, 3) per lane.
inline void load_rows(const float* from, int64_t first, int size, Floats* xyz) {
    alignas(64) float lanes[3][LANES] = {};
    for (int s = 0; s < size; s++)
        for (int axis = 0; axis < 3; axis++) lanes[axis][s] = from[(first + s) * 3 + axis];
    for (int axis = 0; axis < 3; axis++) xyz[axis] = load(lanes[axis]);
}

inline void store_rows(const Floats* xyz, int64_t first, int size, float* to) {
    alignas(64) float lanes[3][LANES];
    for (int axis = 0; axis < 3; axis++) store(lanes[axis], xyz[axis]);
    for (int s = 0; s < size; s++)
        for (int axis = 0; axis < 3; axis++) to[(first + s) * 3 + axis] = lanes[axis][s];
}

inline Floats load_some(const float* from, int64_t first, int size) {
    alignas(64) float lanes[LANES] = {};
    std::memcpy(lanes, from + first, sizeof(float) * size_t(size));
    return load(lanes);
}

// Divides a position in half edges by its largest coordinate if that exceeds 1, so that squares do not overflow.
// Returns 1 / max(1, |x|); `inverse_norm` is the remaining divisor.
inline Floats shrink(Floats* x, Floats& inverse_norm) {
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
    inverse_norm = 1.0f / root(squared < 1 ? splat(1) : squared);
    return inverse_norm * inverse_largest;
}

// Maps a position in half edges to the unit cube; `shrunk` becomes the cube root of the contraction's determinant.
inline void contract(Floats* x, Floats& shrunk) {
    Floats inverse_norm;
    const Floats inverse = shrink(x, inverse_norm);
    for (int axis = 0; axis < 3; axis++) x[axis] = 0.25f * x[axis] * (2.0f - inverse) * inverse_norm + 0.5f;
    const Floats power = cube_root(inverse * inverse * (2.0f - inverse));
    shrunk = power * power;
}

// The gradient by a position in half edges, from the gradient by its image in the unit cube.
inline void contract_backward(Floats* x, Floats* grad) {
    Floats inverse_norm, along = splat(0);
    const Floats inverse = shrink(x, inverse_norm);
    for (int axis = 0; axis < 3; axis++) {
        x[axis] *= inverse_norm;
        along += x[axis] * grad[axis];
    }
    along *= 2.0f * inverse * (1.0f - inverse);
    for (int axis = 0; axis < 3; axis++)
        grad[axis] = 0.25f * (inverse * (2.0f - inverse) * grad[axis] - along * x[axis]);
}

// Ray and interval of LANES frustums: middle and half length along the ray, their ratio and its square.
struct Frustums {
    Floats origin[3], direction[3], start, radius, middle, half, share, squared;

    // The mean distance of the volume.
    Floats mean_t() const {
        const Floats total = 3.0f + squared, part = squared / total;
        return middle * (1.0f + 2.0f * part);
    }
};

inline Frustums load_frustums(const float* origins, const float* directions, const float* t_starts, const float* t_ends,
                              const float* radii, int64_t first, int size) {
    Frustums out;
    load_rows(origins, first, size, out.origin);
    load_rows(directions, first, size, out.direction);
    out.start = load_some(t_starts, first, size), out.radius = load_some(radii, first, size);
    const Floats end = load_some(t_ends, first, size);
    out.middle = 0.5f * out.start + 0.5f * end, out.half = 0.5f * end - 0.5f * out.start;
    out.share = out.middle > 0 ? out.half / out.middle : splat(0), out.squared = out.share * out.share;
    return out;
}

// Two axes perpendicular to LANES directions, as in framework.geometry.points.frames.
struct Across {
    Floats first[3], second[3], sign, a;

    explicit Across(const Floats* d) {
        sign = d[2] < 0 ? splat(-1) : splat(1), a = -1.0f / (sign + d[2]);
        const Floats xy = d[0] * d[1] * a;
        first[0] = 1.0f + sign * d[0] * d[0] * a, first[1] = sign * xy, first[2] = -sign * d[0];
        second[0] = xy, second[1] = sign + d[1] * d[1] * a, second[2] = -d[1];
    }

    // Adds the gradient by the directions to `out`; `u` and `v`: the gradients by the two axes.
    void backward(const Floats* d, const Floats* u, const Floats* v, Floats* out) const {
        const Floats x = d[0] * a, y = d[1] * a;
        out[0] += sign * (2.0f * x * u[0] + y * u[1] - u[2]) + y * v[0];
        out[1] += sign * x * u[1] + x * v[0] + 2.0f * y * v[1] - v[2];
        out[2] += sign * x * (x * u[0] + y * u[1]) + y * (x * v[0] + y * v[1]);
    }
};

// Positions of the points of LANES frustums along the axis and across it.
struct Helix {
    Floats start, radius, step, base, spread, cosine, sine, mirror;

    Helix(const Frustums& cones, const float* cosines, const float* sines, const float* mirrors, int64_t first,
          int size)
        : start(cones.start), radius(cones.radius), step(cones.half / (cones.squared + 3.0f)),
          base((1.0f + cones.share) * (1.0f + cones.share) + 2.0f),
          spread(SPREAD * root((cones.squared - 1.0f) * (cones.squared - 1.0f) + 4.0f)),
          cosine(load_some(cosines, first, size)), sine(load_some(sines, first, size)),
          mirror(load_some(mirrors, first, size)) {}

    // The distance t of the j-th point, its distance `away` from the axis over the square root of 2, and (u, v) across.
    void point(int j, Floats& t, Floats& away, Floats& u, Floats& v) const {
        const float along = float(2 * j - (POINTS - 1)) / (POINTS - 1);
        t = start + step * (base + along * spread), away = radius * t * ROOT_HALF;
        u = away * (COSINES[j] * cosine - SINES[j] * sine);
        v = away * (SINES[j] * cosine + COSINES[j] * sine) * mirror;
    }
};

// The map from the scene to the unit cube.
struct Map {
    const float *centre, *scale;
    float deviation_scale;
    bool contracted;

    // Writes (x, y, z, deviation) of one point of each of `size` frustums, `stride` floats apart.
    void write(Floats* x, Floats deviation, int size, float* out, int stride) const {
        for (int axis = 0; axis < 3; axis++) x[axis] = (x[axis] - centre[axis]) * scale[axis];
        deviation *= deviation_scale;
        if (contracted) {
            Floats shrunk;
            contract(x, shrunk);
            deviation *= shrunk;
        }
        alignas(64) float lanes[4][LANES];
        for (int axis = 0; axis < 3; axis++) store(lanes[axis], x[axis]);
        store(lanes[3], deviation);
        for (int s = 0; s < size; s++)
            for (int i = 0; i < 4; i++) out[s * stride + i] = lanes[i][s];
    }

    // The gradient by positions x in the scene, from the gradient by the values of `write`, `stride` floats apart.
    void read_gradient(Floats* x, int size, const float* from, int stride, Floats* grad) const {
        alignas(64) float lanes[3][LANES] = {};
        for (int s = 0; s < size; s++)
            for (int axis = 0; axis < 3; axis++) lanes[axis][s] = from[s * stride + axis];
        for (int axis = 0; axis < 3; axis++) {
            grad[axis] = load(lanes[axis]);
            x[axis] = (x[axis] - centre[axis]) * scale[axis];
        }
        if (contracted) contract_backward(x, grad);
        for (int axis = 0; axis < 3; axis++) grad[axis] *= scale[axis];
    }
};

// body(first, size) for blocks of LANES frustums.
template <typename Body>
inline void for_blocks(int64_t count, int threads, const Body& body) {
    for_each(threads, (count + LANES - 1) / LANES, 1024 / LANES,
             [&](int64_t b) { body(b * LANES, int(std::min<int64_t>(LANES, count - b * LANES))); });
}

}  // namespace

// 6 points (x, y, z, deviation) in each of `count` frustums. `cosines` and `sines` describe the pattern's rotation,
// `mirrors` are 1 or -1. A position p becomes (p - centre) * scale and is then contracted if `contracted`. A deviation
// is multiplied by `deviation_scale`, which includes the box's scale.
EXPORT int multisamples(const float* origins, const float* directions, const float* t_starts, const float* t_ends,
                        const float* radii, const float* cosines, const float* sines, const float* mirrors,
                        int64_t count, const float* centre, const float* scale, float deviation_scale, int contracted,
                        float* out, int threads) {
    return guarded([&] {
        const Map map{centre, scale, deviation_scale, contracted != 0};
        for_blocks(count, threads, [&](int64_t n, int size) {
            const Frustums cones = load_frustums(origins, directions, t_starts, t_ends, radii, n, size);
            const Floats *o = cones.origin, *d = cones.direction;
            const Helix helix(cones, cosines, sines, mirrors, n, size);
            const Across across(d);
            for (int j = 0; j < POINTS; j++) {
                Floats t, away, u, v, x[3];
                helix.point(j, t, away, u, v);
                for (int axis = 0; axis < 3; axis++)
                    x[axis] = o[axis] + t * d[axis] + u * across.first[axis] + v * across.second[axis];
                map.write(x, away, size, out + (n * POINTS + j) * 4, POINTS * 4);
            }
        });
    });
}

// The gradients (count, 3) by origins and directions, from `grad` (count, 6, 4) by the points; deviations have none.
// The other arguments are as in multisamples.
EXPORT int multisamples_backward(const float* origins, const float* directions, const float* t_starts,
                                 const float* t_ends, const float* radii, const float* cosines, const float* sines,
                                 const float* mirrors, int64_t count, const float* centre, const float* scale,
                                 int contracted, const float* grad, float* by_origins, float* by_directions,
                                 int threads) {
    return guarded([&] {
        const Map map{centre, scale, 1, contracted != 0};
        for_blocks(count, threads, [&](int64_t n, int size) {
            const Frustums cones = load_frustums(origins, directions, t_starts, t_ends, radii, n, size);
            const Floats *o = cones.origin, *d = cones.direction;
            const Helix helix(cones, cosines, sines, mirrors, n, size);
            const Across across(d);
            Floats by_origin[3] = {}, by_direction[3] = {}, by_first[3] = {}, by_second[3] = {};
            for (int j = 0; j < POINTS; j++) {
                Floats t, away, u, v, x[3], own[3];
                helix.point(j, t, away, u, v);
                for (int axis = 0; axis < 3; axis++)
                    x[axis] = o[axis] + t * d[axis] + u * across.first[axis] + v * across.second[axis];
                map.read_gradient(x, size, grad + (n * POINTS + j) * 4, POINTS * 4, own);
                for (int axis = 0; axis < 3; axis++) {
                    by_origin[axis] += own[axis], by_direction[axis] += t * own[axis];
                    by_first[axis] += u * own[axis], by_second[axis] += v * own[axis];
                }
            }
            across.backward(d, by_first, by_second, by_direction);
            store_rows(by_origin, n, size, by_origins), store_rows(by_direction, n, size, by_directions);
        });
    });
}

// (x, y, z, deviation) of the equivalent ball of each of `count` frustums; the map is as in multisamples.
EXPORT int frustum_balls(const float* origins, const float* directions, const float* t_starts, const float* t_ends,
                         const float* radii, int64_t count, const float* centre, const float* scale,
                         float deviation_scale, int contracted, float* out, int threads) {
    return guarded([&] {
        const Map map{centre, scale, deviation_scale, contracted != 0};
        for_blocks(count, threads, [&](int64_t n, int size) {
            const Frustums cones = load_frustums(origins, directions, t_starts, t_ends, radii, n, size);
            const Floats middle = cones.middle, squared = cones.squared;
            const Floats total = 3.0f + squared, part = squared / total;
            const Floats t = cones.mean_t();
            // Roots of the variances, because half^2 and middle^2 would overflow.
            const Floats along = cones.half * root(1.0f / 3 - (4.0f / 15) * part * (12.0f - squared) / total);
            const Floats across =
                cones.radius * middle * root(0.25f + (5.0f / 12) * squared - (4.0f / 15) * squared * part);
            const Floats deviation = cube_root(along) * cube_root(across) * cube_root(across);
            Floats x[3];
            for (int axis = 0; axis < 3; axis++) x[axis] = cones.origin[axis] + t * cones.direction[axis];
            map.write(x, deviation, size, out + n * 4, 4);
        });
    });
}

// The gradients (count, 3) by origins and directions, from `grad` (count, 4) by the balls; deviations have none.
EXPORT int frustum_balls_backward(const float* origins, const float* directions, const float* t_starts,
                                  const float* t_ends, const float* radii, int64_t count, const float* centre,
                                  const float* scale, int contracted, const float* grad, float* by_origins,
                                  float* by_directions, int threads) {
    return guarded([&] {
        const Map map{centre, scale, 1, contracted != 0};
        for_blocks(count, threads, [&](int64_t n, int size) {
            const Frustums cones = load_frustums(origins, directions, t_starts, t_ends, radii, n, size);
            const Floats t = cones.mean_t();
            Floats x[3], own[3], by_direction[3];
            for (int axis = 0; axis < 3; axis++) x[axis] = cones.origin[axis] + t * cones.direction[axis];
            map.read_gradient(x, size, grad + n * 4, 4, own);
            for (int axis = 0; axis < 3; axis++) by_direction[axis] = t * own[axis];
            store_rows(own, n, size, by_origins), store_rows(by_direction, n, size, by_directions);
        });
    });
}
