// Shared by look-ups in a multiresolution hash grid: levels, and the corners around positions (Instant-NGP, section 3).
// See hash_grid.py for the reference.
#pragma once

#include "adam/adam.h"

#include <atomic>
#include <vector>

namespace grid {

constexpr uint32_t PRIME_Y = 2654435761u, PRIME_Z = 805459861u;
constexpr int CORNERS = 8;

struct Level {
    int64_t offset;
    uint32_t mask;  // entries - 1, for a hashed level
    int32_t resolution;
    bool dense;
};

inline Level level_of(const int64_t* resolutions, const int64_t* offsets, int level) {
    // In floating point, because the product of large resolutions does not fit 64 bits.
    const double vertices = double(resolutions[level]) + 1;
    const int64_t entries = offsets[level + 1] - offsets[level];
    return {offsets[level], uint32_t(entries - 1), int32_t(resolutions[level]),
            vertices * vertices * vertices <= double(entries)};
}

typedef uint32_t Words __attribute__((vector_size(LANES * 4)));

// The 8 corners around LANES positions: corner c is at (c >> 2 & 1, c >> 1 & 1, c & 1) along x, y, z.
struct Cell {
    alignas(64) uint32_t entry[CORNERS][LANES];
    alignas(64) float weight[CORNERS][LANES];
    Floats fraction[3];
    Floats inside[3];  // the resolution if the position is inside the box, 0 if it was clamped
};

template <bool DENSE>
inline void find_cell(const Level& level, Floats x, Floats y, Floats z, Cell& cell) {
    const Floats resolution = splat(float(level.resolution));
    const Floats position[3] = {x, y, z};
    Words low[3];
    for (int axis = 0; axis < 3; axis++) {
        const Floats p = position[axis];
        const Floats clamped = p < 0 ? splat(0) : p > 1 ? splat(1) : p;  // NaN stays
        const Floats scaled = clamped * resolution;
        const Floats safe = scaled == scaled ? scaled : splat(0);
        const Ints corner = __builtin_convertvector(safe, Ints);
        const Ints last = Ints{} + (level.resolution - 1);
        const Ints kept = corner > last ? last : corner;
        cell.fraction[axis] = scaled - __builtin_convertvector(kept, Floats);
        cell.inside[axis] = (p < 0) | (p > 1) ? splat(0) : resolution;
        low[axis] = (Words)kept;
    }
    Words ends[3][2];
    if (DENSE) {
        const uint32_t side = level.resolution + 1;
        const Words ix = low[0] * (side * side), iy = low[1] * side;
        ends[0][0] = ix, ends[0][1] = ix + side * side;
        ends[1][0] = iy, ends[1][1] = iy + side;
        ends[2][0] = low[2], ends[2][1] = low[2] + 1;
    } else {
        const Words iy = low[1] * PRIME_Y, iz = low[2] * PRIME_Z;
        ends[0][0] = low[0], ends[0][1] = low[0] + 1;
        ends[1][0] = iy, ends[1][1] = iy + PRIME_Y;
        ends[2][0] = iz, ends[2][1] = iz + PRIME_Z;
    }
    const Floats* f = cell.fraction;
    const Floats g[3] = {1 - f[0], 1 - f[1], 1 - f[2]};
    for (int c = 0; c < CORNERS; c++) {
        const Words a = ends[0][c >> 2 & 1], b = ends[1][c >> 1 & 1], d = ends[2][c & 1];
        const Words entry = DENSE ? a + b + d : (a ^ b ^ d) & level.mask;
        std::memcpy(cell.entry[c], &entry, sizeof entry);
        store(cell.weight[c], (c >> 2 & 1 ? f[0] : g[0]) * (c >> 1 & 1 ? f[1] : g[1]) * (c & 1 ? f[2] : g[2]));
    }
}

inline int block(int64_t first, int64_t end) { return int(end - first < LANES ? end - first : LANES); }

constexpr int64_t CHUNK = 1024;  // samples processed together: their features stay in cache

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
    Cell cells[2];  // this block's and the next one's, which is prefetched
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

// Features of the samples [begin, end), CHUNK at most, all levels side by side.
template <int F>
void encode(const float* positions, int64_t begin, int64_t end, const float* table, const int64_t* resolutions,
            const int64_t* offsets, int levels, float* out) {
    const int64_t stride = int64_t(levels) * F;
    Floats xyz[CHUNK / LANES][3];
    for (int64_t n = begin; n < end; n += LANES)
        load_positions(positions, n, block(n, end), xyz[(n - begin) / LANES]);
    for (int l = 0; l < levels; l++) {
        const Level level = level_of(resolutions, offsets, l);
        const auto run = level.dense ? forward_level<F, true> : forward_level<F, false>;
        run(level, xyz, table, begin, end, out + l * F, stride);
    }
}

// Products of the entries at the corners of a lane's cell with the incoming gradient `grad`, to value[c][s].
template <int F>
inline void weigh_corners(const Cell& cell, int s, const float* entries, const float* grad, float (*value)[LANES]) {
    for (int c = 0; c < CORNERS; c++) {
        const float* entry = entries + int64_t(cell.entry[c][s]) * F;
        float sum = 0;
        for (int f = 0; f < F; f++) sum += entry[f] * grad[f];
        value[c][s] = sum;
    }
}

// Adds the gradient by the position to `out`, from these products.
inline void add_slopes(const Cell& cell, const float (*value)[LANES], Floats* out) {
    const Floats* t = cell.fraction;
    for (int axis = 0; axis < 3; axis++) {
        const int one = 4 >> axis, p = axis == 0 ? 1 : 0, q = axis == 2 ? 1 : 2;  // p, q: the other two axes
        const int bit_p = 4 >> p, bit_q = 4 >> q;
        Floats sum = splat(0);
        for (int side = 0; side < 4; side++) {
            const int c = (side & 1 ? bit_p : 0) | (side & 2 ? bit_q : 0);
            const Floats weight = (side & 1 ? t[p] : 1 - t[p]) * (side & 2 ? t[q] : 1 - t[q]);
            sum += weight * (load(value[c | one]) - load(value[c]));
        }
        out[axis] += sum * cell.inside[axis];
    }
}

// Adds the gradient of one level by positions to `out`; `grad`: the level's incoming gradient, rows `stride` wide.
template <int F, bool DENSE>
void add_position_gradient(const Level& level, const Floats (*xyz)[3], int64_t count, const float* table,
                           const float* grad, int64_t stride, Floats (*out)[3]) {
    Cell cells[2];  // this block's and the next one's, which is prefetched
    alignas(64) float value[CORNERS][LANES] = {};
    const float* entries = table + level.offset * F;
    find_cell<DENSE>(level, (*xyz)[0], (*xyz)[1], (*xyz)[2], cells[0]);
    for (int64_t n = 0, turn = 0; n < count; n += LANES, turn ^= 1) {
        if (n + LANES < count) {
            xyz++;
            find_cell<DENSE>(level, (*xyz)[0], (*xyz)[1], (*xyz)[2], cells[turn ^ 1]);
            prefetch<F>(cells[turn ^ 1], entries);
        }
        for (int s = 0; s < block(n, count); s++)
            weigh_corners<F>(cells[turn], s, entries, grad + (n + s) * stride, value);
        add_slopes(cells[turn], value, *out++);
    }
}

// Fills `out` with the indices of rows with a gradient that is not zero (or is NaN), among `count` rows, `stride` wide.
inline void rows_with_gradient(const float* grads, int64_t count, int64_t stride, std::vector<int64_t>& out) {
    out.clear();
    for (int64_t n = 0; n < count; n++) {
        const float* grad = grads + n * stride;
        int64_t f = 0;
        while (f < stride && grad[f] == 0) f++;
        if (f < stride) out.push_back(n);
    }
}

// Adds the gradient of each level to `table`. Levels are distributed over threads, so that no two write to the same
// entry and the order of sums never changes. samples.scatter_to(level, l, first) adds the gradient of level l, starting
// at its first entry.
template <int F, typename Samples>
void add_by_level(const Samples& samples, const int64_t* resolutions, const int64_t* offsets, int levels, float* table,
                  int threads) {
    for_each(threads, levels, 1, [&](int64_t turn) {
        const int l = levels - 1 - int(turn);  // slowest first
        samples.scatter_to(level_of(resolutions, offsets, l), l, table + offsets[l] * F);
    });
}

// The same, followed by Adam on each level while its gradient is in cache. Returns the number of updated entries.
template <int F, typename Samples>
int64_t adam_by_level(const Samples& samples, const int64_t* resolutions, const int64_t* offsets, int levels,
                      float* values, float* mean, float* square, float* seen, const adam::Settings& settings,
                      int threads) {
    // Per thread, and zero between calls, because the update clears what it has used.
    static thread_local std::vector<std::vector<float>> kept;
    std::vector<std::vector<float>>& grads_of = kept;
    if (grads_of.size() < size_t(threads)) grads_of.resize(size_t(threads));
    std::atomic<int64_t> touched{0};
    for_chunks(threads, levels, [&](int64_t turn, int slot) {
        const int l = levels - 1 - int(turn);
        const int64_t first = offsets[l], entries = offsets[l + 1] - first, i = first * F;
        std::vector<float>& grad = grads_of[size_t(slot)];
        if (grad.size() < size_t(entries) * F) grad.resize(size_t(entries) * F, 0.0f);
        samples.scatter_to(level_of(resolutions, offsets, l), l, grad.data());
        touched += adam::update_range<F>(values + i, mean + i, square + i, grad.data(), seen + first, 0, entries, F,
                                         settings);
    });
    return touched;
}

}  // namespace grid

#define FOR_FEATURES(features, call) \
    switch (features) {              \
        case 1: call(1); break;      \
        case 2: call(2); break;      \
        case 4: call(4); break;      \
        case 8: call(8); break;      \
        default: throw std::invalid_argument("hash grid: an entry has 1, 2, 4 or 8 features"); \
    }
