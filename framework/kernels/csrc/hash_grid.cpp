// Multiresolution hash encoding, forward and backward (Instant-NGP, section 3). See ../hash_grid.py for the reference.
#include "hash_grid.h"

#include <memory>

using namespace grid;

namespace {

constexpr int64_t CHUNK = 1024;  // samples that go through all levels together: their features stay in cache

template <int F>
inline void blend(const Cell& cell, const float* table, int count, float* out, int64_t stride) {
    for (int s = 0; s < count; s++) {
        float sum[F] = {};
        for (int c = 0; c < CORNERS; c++) {
            const float* entry = table + int64_t(cell.entry[c][s]) * F;
            for (int f = 0; f < F; f++) sum[f] += cell.weight[c][s] * entry[f];
        }
        std::memcpy(out + s * stride, sum, sizeof sum);
    }
}

template <int F>
inline void prefetch(const Cell& cell, const float* table) {
    for (int c = 0; c < CORNERS; c++)
        for (int s = 0; s < LANES; s++) __builtin_prefetch(table + int64_t(cell.entry[c][s]) * F);
}

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

// LANES positions, the last block padded with zeros.
inline void load_positions(const float* positions, int64_t first, int count, Floats* xyz) {
    float lanes[3][LANES] = {};
    for (int s = 0; s < count; s++)
        for (int axis = 0; axis < 3; axis++) lanes[axis][s] = positions[(first + s) * 3 + axis];
    for (int axis = 0; axis < 3; axis++) xyz[axis] = load(lanes[axis]);
}

template <int F, bool DENSE>
void forward_level(const Level& level, const Floats (*xyz)[3], const float* table, int64_t begin, int64_t end,
                   float* out, int64_t stride) {
    Cell cells[2];  // this block's and the next one's, whose entries are on their way meanwhile
    const float* entries = table + level.offset * F;
    find_cell<DENSE>(level, (*xyz)[0], (*xyz)[1], (*xyz)[2], cells[0]);
    for (int64_t n = begin, turn = 0; n < end; n += LANES, turn ^= 1) {
        if (n + LANES < end) {
            xyz++;
            find_cell<DENSE>(level, (*xyz)[0], (*xyz)[1], (*xyz)[2], cells[turn ^ 1]);
            prefetch<F>(cells[turn ^ 1], entries);
        }
        blend<F>(cells[turn], entries, block(n, end), out + n * stride, stride);
    }
}

template <int F>
void forward(const float* positions, int64_t count, const float* table, const int64_t* resolutions,
             const int64_t* offsets, int levels, float* out, int threads) {
    const int64_t stride = int64_t(levels) * F;
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        Floats xyz[CHUNK / LANES][3];
        for (int64_t n = begin; n < end; n += LANES)
            load_positions(positions, n, block(n, end), xyz[(n - begin) / LANES]);
        for (int l = 0; l < levels; l++) {
            const Level level = level_of(resolutions, offsets, l);
            const auto run = level.dense ? forward_level<F, true> : forward_level<F, false>;
            run(level, xyz, table, begin, end, out + l * F, stride);
        }
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

// Samples that come in parts, put together: positions, and the incoming gradient level by level.
template <int F>
struct Gathered {
    int64_t count;
    int levels;
    std::unique_ptr<float[]> points, by_level;  // not std::vector, which would fill them with zeros first

    // `ends` holds the number of samples up to the end of each part.
    Gathered(const float* const* positions, const float* const* grads, const int64_t* ends, int parts, int levels,
             int threads)
        : count(parts ? ends[parts - 1] : 0), levels(levels), points(new float[size_t(count) * 3]),
          by_level(new float[size_t(count) * levels * F]) {
        const int64_t stride = int64_t(levels) * F;
        for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
            int part = 0;
            for (int64_t n = begin; n < end; n++) {
                while (n >= ends[part]) part++;
                const int64_t within = part ? n - ends[part - 1] : n;
                std::memcpy(points.get() + n * 3, positions[part] + within * 3, sizeof(float) * 3);
                const float* from = grads[part] + within * stride;
                for (int l = 0; l < levels; l++)
                    std::memcpy(by_level.get() + (l * count + n) * F, from + l * F, sizeof(float) * F);
            }
        });
    }
    // Adds a level's gradient to `table`, where that level's first entry stands.
    void scatter_to(const Level& level, int l, float* table) const {
        const auto run = level.dense ? scatter_level<F, true> : scatter_level<F, false>;
        run(level, points.get(), count, by_level.get() + size_t(l) * count * F, table);
    }
};

template <int F>
void backward_positions(const float* positions, int64_t count, const float* table, const float* grad,
                        const int64_t* resolutions, const int64_t* offsets, int levels, float* out, int threads) {
    const int64_t stride = int64_t(levels) * F, blocks = (count + LANES - 1) / LANES;
    for_each(threads, blocks, 256 / LANES, [&](int64_t b) {
        const int64_t n = b * LANES;
        const int size = block(n, count);
        Floats xyz[3], sum[3] = {splat(0), splat(0), splat(0)};
        load_positions(positions, n, size, xyz);
        for (int l = 0; l < levels; l++) {
            const Level level = level_of(resolutions, offsets, l);
            const auto run = level.dense ? add_position_gradient<F, true> : add_position_gradient<F, false>;
            run(level, table, xyz, size, grad + n * stride + l * F, stride, sum);
        }
        for (int s = 0; s < size; s++)
            for (int axis = 0; axis < 3; axis++) out[(n + s) * 3 + axis] = sum[axis][s];
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

// Adam on what hash_grid_backward_table would add. `touched`: how many entries were updated.
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
