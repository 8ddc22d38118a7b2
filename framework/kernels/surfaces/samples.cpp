// Samples of a signed distance that is a first shape plus a network's output: opacity or density, and features for the
// colour.
// See samples.py for the reference and the equations.
#include "runtime/common.h"
#include "surfaces/first_shape.h"

#include <vector>

using surfaces::FirstShape;

namespace {

constexpr int64_t CHUNK = 512;
constexpr int PLACED = 6;  // features before the network's: gradient and position

// Distance and gradient at LANES samples, and the derivatives of opacity or density by both.
struct Lanes {
    alignas(64) float distance[LANES], gradient[3][LANES], direction[3][LANES], length[LANES];

    // Rows [0, count) of the inputs, `stride` = outputs + 3 columns of the network's; zeros behind.
    void read(const float* network, int64_t stride, const float* positions, const float* directions,
              const float* lengths, int count, const FirstShape& first) {
        std::memset(this, 0, sizeof *this);
        for (int i = 0; i < count; i++, network += stride, positions += 3) {
            float along[3];
            distance[i] = first.at(positions, network[0], network + stride - 3, along);
            for (int axis = 0; axis < 3; axis++) gradient[axis][i] = along[axis];
            if (!directions) continue;
            for (int axis = 0; axis < 3; axis++) direction[axis][i] = directions[i * 3 + axis];
            length[i] = lengths[i];
        }
    }
    Floats cosine() const {
        Floats sum = splat(0);
        for (int axis = 0; axis < 3; axis++) sum += load(gradient[axis]) * load(direction[axis]);
        return sum;
    }
};

// Opacity or density, and its derivatives.
struct Stopping {
    Floats value, by_distance, by_cosine, by_sharpness;
};

// NeuS, equation 13: S(-a) (1 - exp(-2 s h)) for the logistic function S, half the fall h and a = s (f - h).
inline Stopping opacity(Floats distance, Floats cosine, Floats length, float sharpness, float annealing) {
    const Floats zero = splat(0), wrong = 0.5f - 0.5f * cosine;
    const Floats falling = larger(-cosine, zero) * annealing + larger(wrong, zero) * (1 - annealing);
    const Floats half = falling * length * 0.5f, start = (distance - half) * sharpness;
    const Floats small = exponential(-magnitude(start)), whole = 1 / (1 + small), rest = small * whole;
    const Floats inside = start < 0 ? whole : rest, outside = start < 0 ? rest : whole;  // S(-a) and S(a)
    const Floats fall = half * (2 * sharpness), kept = exponential(-fall);
    const Floats value = inside * opacity_of(fall);
    const Floats by_half = sharpness * (value * outside + 2 * (inside * kept));
    const Floats by_cosine = (cosine < 0 ? splat(-annealing) : zero) + (wrong > 0 ? splat(0.5f * annealing - 0.5f) : zero);
    return {value, -sharpness * (value * outside), by_half * by_cosine * length * 0.5f,
            2 * (half * inside * kept) - value * outside * (distance - half)};
}

// VolSDF, equations 2 and 3.
inline Stopping density(Floats distance, float sharpness) {
    const Floats outside = 0.5f * exponential(-magnitude(distance) * sharpness);
    const Floats share = distance > 0 ? outside : 1 - outside;
    return {sharpness * share, -(sharpness * sharpness) * outside, splat(0), share - sharpness * distance * outside};
}

}  // namespace

// stopping: (count). features: (count, 6 + outputs - 1), gradient, position and the network's. Without directions and
// lengths, the density.
EXPORT int surface_samples(const float* network, int64_t count, int outputs, const float* positions,
                           const float* directions, const float* lengths, const float* sharpness, float annealing,
                           const float* centre, const float* scale, float size, float radius, float rounding,
                           const float* floor, float* stopping, float* features, int threads) {
    return guarded([&] {
        const int64_t stride = outputs + 3, width = PLACED + outputs - 1;
        const FirstShape first{centre, scale, size, radius, rounding, floor};
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            Lanes lanes;
            for (int64_t n = begin; n < end; n += LANES) {
                const int rows = int(std::min<int64_t>(LANES, end - n));
                const float *from = network + n * stride, *places = positions + n * 3;
                lanes.read(from, stride, places, directions ? directions + n * 3 : nullptr,
                           lengths ? lengths + n : nullptr, rows, first);
                const Floats distance = load(lanes.distance);
                const Floats value = directions ? opacity(distance, lanes.cosine(), load(lanes.length), *sharpness, annealing).value
                                                : density(distance, *sharpness).value;
                std::memcpy(stopping + n, &value, sizeof(float) * rows);
                for (int i = 0; i < rows; i++) {
                    float* to = features + (n + i) * width;
                    for (int axis = 0; axis < 3; axis++) {
                        to[axis] = lanes.gradient[axis][i];
                        to[3 + axis] = (places[i * 3 + axis] - centre[axis]) / size;
                    }
                    std::memcpy(to + PLACED, from + i * stride + 1, sizeof(float) * (outputs - 1));
                }
            }
        });
    });
}

// of_stopping: (count) and of_features: (count, 5 + outputs), or null for 0. of_network: (count, outputs + 3).
EXPORT int surface_samples_backward(const float* network, int64_t count, int outputs, const float* positions,
                                    const float* directions, const float* lengths, const float* sharpness,
                                    float annealing, const float* centre, const float* scale, float size, float radius,
                                    float rounding, const float* floor, const float* of_stopping,
                                    const float* of_features, float* of_network, float* of_sharpness, int threads) {
    return guarded([&] {
        const int64_t stride = outputs + 3, width = PLACED + outputs - 1, chunks = (count + CHUNK - 1) / CHUNK;
        const FirstShape first{centre, scale, size, radius, rounding, floor};
        std::vector<double> sums(chunks);  // in order, so that their sum has the same bits on any number of threads
        for_chunks(threads, chunks, [&](int64_t chunk, int) {
            const int64_t end = std::min(count, (chunk + 1) * CHUNK);
            Lanes lanes;
            double sum = 0;
            for (int64_t n = chunk * CHUNK; n < end; n += LANES) {
                const int rows = int(std::min<int64_t>(LANES, end - n));
                alignas(64) float grads[LANES] = {}, by_distance[LANES], by_cosine[LANES], by_sharpness[LANES];
                if (of_stopping) std::memcpy(grads, of_stopping + n, sizeof(float) * rows);
                lanes.read(network + n * stride, stride, positions + n * 3, directions ? directions + n * 3 : nullptr,
                           lengths ? lengths + n : nullptr, rows, first);
                const Floats distance = load(lanes.distance), grad = load(grads);
                const Stopping by = directions
                    ? opacity(distance, lanes.cosine(), load(lanes.length), *sharpness, annealing)
                    : density(distance, *sharpness);
                store(by_distance, grad * by.by_distance);
                store(by_cosine, grad * by.by_cosine);
                store(by_sharpness, grad * by.by_sharpness);
                for (int i = 0; i < rows; i++) {
                    sum += by_sharpness[i];
                    float* to = of_network + (n + i) * stride;
                    const float* from = of_features ? of_features + (n + i) * width : nullptr;
                    to[0] = size * by_distance[i];
                    for (int k = 1; k < outputs; k++) to[k] = from ? from[PLACED - 1 + k] : 0;
                    for (int axis = 0; axis < 3; axis++) {
                        const float grad = (from ? from[axis] : 0) + by_cosine[i] * lanes.direction[axis][i];
                        to[outputs + axis] = size * scale[axis] * grad;
                    }
                }
            }
            sums[chunk] = sum;
        });
        double sum = 0;
        for (const double each : sums) sum += each;
        *of_sharpness = float(sum);
    });
}

// out: rows (count, width) with the first three columns normalised; 0 where they are shorter than `shortest`.
EXPORT int unit_normals(const float* features, int64_t count, int width, float shortest, float* out, int threads) {
    return guarded([&] {
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            std::memcpy(out + begin * width, features + begin * width, sizeof(float) * size_t((end - begin) * width));
            for (int64_t n = begin; n < end; n++) {
                float* row = out + n * width;
                const double length = std::sqrt(double(row[0]) * row[0] + double(row[1]) * row[1] + double(row[2]) * row[2]);
                for (int axis = 0; axis < 3; axis++) row[axis] = length < shortest ? 0 : float(row[axis] / length);
            }
        });
    });
}

// of_features: the gradient by the features, from the gradient by the result.
EXPORT int unit_normals_backward(const float* features, int64_t count, int width, float shortest, const float* grad,
                                 float* of_features, int threads) {
    return guarded([&] {
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            std::memcpy(of_features + begin * width, grad + begin * width, sizeof(float) * size_t((end - begin) * width));
            for (int64_t n = begin; n < end; n++) {
                const float *v = features + n * width, *g = grad + n * width;
                float* to = of_features + n * width;
                const double length = std::sqrt(double(v[0]) * v[0] + double(v[1]) * v[1] + double(v[2]) * v[2]);
                const double along = (double(v[0]) * g[0] + double(v[1]) * g[1] + double(v[2]) * g[2]) / (length * length);
                for (int axis = 0; axis < 3; axis++)
                    to[axis] = length < shortest ? 0 : float((g[axis] - along * v[axis]) / length);
            }
        });
    });
}
