// Features of a hash grid and their derivatives along a direction. See hash_grid_tangent.py for the reference.
#pragma once

#include "grids/hash_grid.h"

namespace grid {

constexpr int POINT = 6;  // a position and a direction

// Derivatives of the weights of a cell's corners along the directions `v`.
inline void slopes_of_weights(const Cell& cell, const Floats* v, float (*out)[LANES]) {
    const Floats* t = cell.fraction;
    const Floats along[3] = {v[0] * cell.inside[0], v[1] * cell.inside[1], v[2] * cell.inside[2]};
    for (int c = 0; c < CORNERS; c++) {
        Floats weight[3], slope[3];
        for (int axis = 0; axis < 3; axis++) {
            const bool upper = c >> (2 - axis) & 1;
            weight[axis] = upper ? t[axis] : 1 - t[axis];
            slope[axis] = upper ? along[axis] : -along[axis];
        }
        store(out[c], slope[0] * weight[1] * weight[2] + weight[0] * slope[1] * weight[2] +
                          weight[0] * weight[1] * slope[2]);
    }
}

struct Both {
    Cell cell;
    alignas(64) float slope[CORNERS][LANES];
};

template <bool DENSE>
inline void find_both(const Level& level, const Floats* point, Both& both) {
    find_cell<DENSE>(level, point[0], point[1], point[2], both.cell);
    slopes_of_weights(both.cell, point + 3, both.slope);
}

// LANES points, the last block padded with zeros.
inline void load_points(const float* points, int64_t first, int count, Floats* lanes) {
    float values[POINT][LANES] = {};
    for (int s = 0; s < count; s++)
        for (int d = 0; d < POINT; d++) values[d][s] = points[(first + s) * POINT + d];
    for (int d = 0; d < POINT; d++) lanes[d] = load(values[d]);
}

// Features of one level to `out`, and their derivatives to `out + apart`.
template <int F>
inline void blend_both(const Both& both, const float* table, int count, float* out, int64_t stride, int64_t apart) {
    for (int s = 0; s < count; s++) {
        float value[F] = {}, slope[F] = {};
        for (int c = 0; c < CORNERS; c++) {
            const float* entry = table + int64_t(both.cell.entry[c][s]) * F;
            for (int f = 0; f < F; f++) {
                value[f] += both.cell.weight[c][s] * entry[f];
                slope[f] += both.slope[c][s] * entry[f];
            }
        }
        std::memcpy(out + s * stride, value, sizeof value);
        std::memcpy(out + s * stride + apart, slope, sizeof slope);
    }
}

template <int F, bool DENSE>
void both_of_level(const Level& level, const Floats (*points)[POINT], const float* table, int64_t count, float* out,
                   int64_t stride) {
    Both both[2];  // this block's and the next one's, which is prefetched
    const float* entries = table + level.offset * F;
    find_both<DENSE>(level, *points, both[0]);
    for (int64_t n = 0, turn = 0; n < count; n += LANES, turn ^= 1) {
        if (n + LANES < count) {
            points++;
            find_both<DENSE>(level, *points, both[turn ^ 1]);
            prefetch<F>(both[turn ^ 1].cell, entries);
        }
        blend_both<F>(both[turn], entries, block(n, count), out + n * stride, stride, stride / 2);
    }
}

// Features of up to CHUNK points, all levels side by side, followed by their derivatives.
template <int F>
void encode_both(const float* points, int64_t count, const float* table, const int64_t* resolutions,
                 const int64_t* offsets, int levels, float* out) {
    const int64_t stride = int64_t(levels) * F * 2;
    Floats lanes[CHUNK / LANES][POINT];
    for (int64_t n = 0; n < count; n += LANES) load_points(points, n, block(n, count), lanes[n / LANES]);
    for (int l = 0; l < levels; l++) {
        const Level level = level_of(resolutions, offsets, l);
        const auto run = level.dense ? both_of_level<F, true> : both_of_level<F, false>;
        run(level, lanes, table, count, out + l * F, stride);
    }
}

}  // namespace grid
