// Multiresolution hash encoding with its derivative along a direction, forward and backward. See hash_grid_tangent.py
// for the reference.
#include "grids/hash_grid_tangent.h"

#include <memory>

using namespace grid;

namespace {

template <int F>
void forward(const float* points, int64_t count, const float* table, const int64_t* resolutions, const int64_t* offsets,
             int levels, float* out, int threads) {
    const int64_t stride = int64_t(levels) * F * 2;
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        encode_both<F>(points + begin * POINT, end - begin, table, resolutions, offsets, levels, out + begin * stride);
    });
}

// Samples with a gradient, collected from parts: points, and the incoming gradients level by level: first of a level's
// features, then of their derivatives.
template <int F>
struct Gathered {
    std::vector<const float*> from, grads;
    int64_t count;
    std::unique_ptr<float[]> points, by_level;  // std::vector would fill them with zeros first

    Gathered(const float* const* parts_points, const float* const* all, const int64_t* ends, int parts, int levels,
             int threads) {
        const int64_t width = int64_t(levels) * F, stride = width * 2;
        std::vector<int64_t> rows;
        for (int part = 0; part < parts; part++) {
            rows_with_gradient(all[part], ends[part] - (part ? ends[part - 1] : 0), stride, rows);
            for (const int64_t n : rows) {
                from.push_back(parts_points[part] + n * POINT);
                grads.push_back(all[part] + n * stride);
            }
        }
        count = int64_t(from.size());
        points.reset(new float[size_t(count) * POINT]);
        by_level.reset(new float[size_t(count * stride)]);
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; n++) {
                std::memcpy(points.get() + n * POINT, from[size_t(n)], sizeof(float) * POINT);
                for (int l = 0; l < levels; l++) {
                    float* to = by_level.get() + (l * count + n) * F * 2;
                    std::memcpy(to, grads[size_t(n)] + l * F, sizeof(float) * F);
                    std::memcpy(to + F, grads[size_t(n)] + width + l * F, sizeof(float) * F);
                }
            }
        });
    }

    // Adds a level's gradient to `table`, which points to that level's first entry.
    void scatter_to(const Level& level, int l, float* table) const {
        const float* grad = by_level.get() + size_t(l) * count * F * 2;
        level.dense ? scatter<true>(level, grad, table) : scatter<false>(level, grad, table);
    }

    template <bool DENSE>
    void scatter(const Level& level, const float* grad, float* table) const {
        Both both;
        for (int64_t n = 0; n < count; n += LANES) {
            Floats lanes[POINT];
            const int size = block(n, count);
            load_points(points.get(), n, size, lanes);
            find_both<DENSE>(level, lanes, both);
            for (int s = 0; s < size; s++) {
                float g[F * 2];
                std::memcpy(g, grad + (n + s) * F * 2, sizeof g);
                for (int c = 0; c < CORNERS; c++) {
                    float* entry = table + int64_t(both.cell.entry[c][s]) * F;
                    for (int f = 0; f < F; f++)
                        entry[f] += both.cell.weight[c][s] * g[f] + both.slope[c][s] * g[F + f];
                }
            }
        }
    }
};

}  // namespace

EXPORT int hash_grid_tangent_forward(const float* points, int64_t count, const float* table, int features,
                                     const int64_t* resolutions, const int64_t* offsets, int levels, float* out,
                                     int threads) {
    return guarded([&] {
#define CALL(F) forward<F>(points, count, table, resolutions, offsets, levels, out, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adds to `table_grad`.
EXPORT int hash_grid_tangent_backward_table(const float* const* points, const float* const* grads, const int64_t* ends,
                                            int parts, int features, const int64_t* resolutions,
                                            const int64_t* offsets, int levels, float* table_grad, int threads) {
    return guarded([&] {
#define CALL(F)                                                                                               \
    add_by_level<F>(Gathered<F>(points, grads, ends, parts, levels, threads), resolutions, offsets, levels, \
                    table_grad, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adam on the gradient that hash_grid_tangent_backward_table would add. `touched`: number of updated entries.
EXPORT int hash_grid_tangent_adam(const float* const* points, const float* const* grads, const int64_t* ends, int parts,
                                  int features, const int64_t* resolutions, const int64_t* offsets, int levels,
                                  float* values, float* mean, float* square, float* seen, float rate, double beta1,
                                  double beta2, float eps, int threads, int64_t* touched) {
    return guarded([&] {
        const adam::Settings settings(rate, beta1, beta2, eps);
#define CALL(F)                                                                                               \
    *touched = adam_by_level<F>(Gathered<F>(points, grads, ends, parts, levels, threads), resolutions, \
                                offsets, levels, values, mean, square, seen, settings, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}
