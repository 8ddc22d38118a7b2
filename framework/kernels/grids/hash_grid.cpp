// Multiresolution hash encoding, forward and backward (Instant-NGP, section 3). See hash_grid.py for the reference.
#include "grids/hash_grid.h"

#include <memory>

using namespace grid;

namespace {

template <int F>
inline void scatter(const Cell& cell, float* table, int count, const float* grad) {
    for (int s = 0; s < count; s++) {
        float g[F];
        std::memcpy(g, grad + s * F, sizeof g);
        bool zero = true;
        for (int f = 0; f < F; f++) zero &= g[f] == 0;
        if (zero) continue;
        for (int c = 0; c < CORNERS; c++) {
            float* entry = table + int64_t(cell.entry[c][s]) * F;
            for (int f = 0; f < F; f++) entry[f] += cell.weight[c][s] * g[f];
        }
    }
}

template <int F>
void forward(const float* positions, int64_t count, const float* table, const int64_t* resolutions,
             const int64_t* offsets, int levels, float* out, int threads) {
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        encode<F>(positions, begin, end, table, resolutions, offsets, levels, out);
    });
}

template <int F, bool DENSE>
void scatter_level(const Level& level, const float* positions, int64_t count, const float* grad, float* table) {
    Cell cell;
    for (int64_t n = 0; n < count; n += LANES) {
        Floats xyz[3];
        const int size = block(n, count);
        load_positions(positions, n, size, xyz);
        find_cell<DENSE>(level, xyz[0], xyz[1], xyz[2], cell);
        scatter<F>(cell, table, size, grad + n * F);
    }
}

// Positions of the samples with a gradient, in order.
struct Live {
    std::vector<const float*> points, grads;

    // `ends` holds the number of samples up to the end of each part; its gradients are `stride` wide.
    Live(const float* const* positions, const float* const* all, const int64_t* ends, int parts, int64_t stride) {
        const size_t most = parts ? size_t(ends[parts - 1]) : 0;
        points.reserve(most);
        grads.reserve(most);
        std::vector<int64_t> rows;
        for (int part = 0; part < parts; part++) {
            rows_with_gradient(all[part], ends[part] - (part ? ends[part - 1] : 0), stride, rows);
            for (const int64_t n : rows) {
                points.push_back(positions[part] + n * 3);
                grads.push_back(all[part] + n * stride);
            }
        }
    }
};

// Samples with a gradient, collected from parts: positions, and the incoming gradient level by level.
template <int F>
struct Gathered {
    Live live;
    int64_t count;
    int levels;
    std::unique_ptr<float[]> points, by_level;  // std::vector would fill them with zeros first

    Gathered(const float* const* positions, const float* const* grads, const int64_t* ends, int parts, int levels,
             int threads)
        : live(positions, grads, ends, parts, int64_t(levels) * F), count(int64_t(live.points.size())), levels(levels),
          points(new float[size_t(count) * 3]), by_level(new float[size_t(count) * levels * F]) {
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; n++) {
                std::memcpy(points.get() + n * 3, live.points[size_t(n)], sizeof(float) * 3);
                for (int l = 0; l < levels; l++)
                    std::memcpy(by_level.get() + (l * count + n) * F, live.grads[size_t(n)] + l * F, sizeof(float) * F);
            }
        });
    }
    // Adds a level's gradient to `table`, which points to that level's first entry.
    void scatter_to(const Level& level, int l, float* table) const {
        const auto run = level.dense ? scatter_level<F, true> : scatter_level<F, false>;
        run(level, points.get(), count, by_level.get() + size_t(l) * count * F, table);
    }
};

template <int F>
void backward_positions(const float* positions, int64_t count, const float* table, const float* grad,
                        const int64_t* resolutions, const int64_t* offsets, int levels, float* out, int threads) {
    const int64_t stride = int64_t(levels) * F;
    std::vector<int64_t> live;
    rows_with_gradient(grad, count, stride, live);
    if (int64_t(live.size()) < count) std::memset(out, 0, sizeof(float) * size_t(count) * 3);
    for_ranges(threads, int64_t(live.size()), CHUNK, [&](int64_t begin, int64_t end) {
        const int64_t size = end - begin, *rows = live.data() + begin;
        const std::unique_ptr<float[]> incoming(new float[size_t(size * stride)]);
        float places[CHUNK * 3];
        Floats xyz[CHUNK / LANES][3], sum[CHUNK / LANES][3] = {};
        for (int64_t n = 0; n < size; n++) {
            std::memcpy(places + n * 3, positions + rows[n] * 3, sizeof(float) * 3);
            std::memcpy(incoming.get() + n * stride, grad + rows[n] * stride, sizeof(float) * size_t(stride));
        }
        for (int64_t n = 0; n < size; n += LANES) load_positions(places, n, block(n, size), xyz[n / LANES]);
        for (int l = 0; l < levels; l++) {
            const Level level = level_of(resolutions, offsets, l);
            const auto run = level.dense ? add_position_gradient<F, true> : add_position_gradient<F, false>;
            run(level, xyz, size, table, incoming.get() + l * F, stride, sum);
        }
        for (int64_t n = 0; n < size; n++)
            for (int axis = 0; axis < 3; axis++) out[rows[n] * 3 + axis] = sum[n / LANES][axis][n % LANES];
    });
}

}  // namespace

EXPORT int hash_grid_forward(const float* positions, int64_t count, const float* table, int features,
                             const int64_t* resolutions, const int64_t* offsets, int levels, float* out, int threads) {
    return guarded([&] {
#define CALL(F) forward<F>(positions, count, table, resolutions, offsets, levels, out, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adds to `table_grad`.
EXPORT int hash_grid_backward_table(const float* const* positions, const float* const* grads, const int64_t* ends,
                                    int parts, int features, const int64_t* resolutions, const int64_t* offsets,
                                    int levels, float* table_grad, int threads) {
    return guarded([&] {
#define CALL(F)                                                                      \
    add_by_level<F>(Gathered<F>(positions, grads, ends, parts, levels, threads), resolutions, offsets, levels, \
                    table_grad, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adam on the gradient that hash_grid_backward_table would add. `touched`: number of updated entries.
EXPORT int hash_grid_adam(const float* const* positions, const float* const* grads, const int64_t* ends, int parts,
                          int features, const int64_t* resolutions, const int64_t* offsets, int levels, float* values,
                          float* mean, float* square, float* seen, float rate, double beta1, double beta2, float eps,
                          int threads, int64_t* touched) {
    return guarded([&] {
        const adam::Settings settings(rate, beta1, beta2, eps);
#define CALL(F)                                                                                          \
    *touched = adam_by_level<F>(Gathered<F>(positions, grads, ends, parts, levels, threads), resolutions, \
                                offsets, levels, values, mean, square, seen, settings, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

EXPORT int hash_grid_backward_positions(const float* positions, int64_t count, const float* table, const float* grad,
                                        int features, const int64_t* resolutions, const int64_t* offsets, int levels,
                                        float* positions_grad, int threads) {
    return guarded([&] {
#define CALL(F) \
    backward_positions<F>(positions, count, table, grad, resolutions, offsets, levels, positions_grad, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}
