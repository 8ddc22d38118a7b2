// Multiresolution hash encoding, forward and backward (Instant-NGP, section 3). See ../hash_grid.py for the reference.
#include "adam.h"

#include <atomic>
#include <memory>
#include <vector>

namespace {

constexpr uint32_t PRIME_Y = 2654435761u, PRIME_Z = 805459861u;
constexpr int CORNERS = 8;
constexpr int64_t CHUNK = 1024;  // samples that go through all levels together: their features stay in cache

struct Level {
    int64_t offset;
    uint32_t mask;  // entries - 1, of a hashed level
    int32_t resolution;
    bool dense;
};

Level level_of(const int64_t* resolutions, const int64_t* offsets, int level) {
    // In floating point, for the product of large resolutions does not fit 64 bits.
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
    Floats inside[3];  // the resolution where the position is inside the box, 0 where it was moved to the face
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

inline int block(int64_t first, int64_t end) { return int(end - first < LANES ? end - first : LANES); }

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

// Levels are shared out over threads, so that no two write to the same entry and the order of sums never changes.
template <int F>
void backward_table(const float* const* positions, const float* const* grads, const int64_t* ends, int parts,
                    const int64_t* resolutions, const int64_t* offsets, int levels, float* table, int threads) {
    const Gathered<F> samples(positions, grads, ends, parts, levels, threads);
    for_each(threads, levels, 1, [&](int64_t turn) {
        const int l = levels - 1 - int(turn);  // the slowest first
        samples.scatter_to(level_of(resolutions, offsets, l), l, table + offsets[l] * F);
    });
}

// The same, and Adam on each level while its gradient is still in cache. Returns how many entries were updated.
template <int F>
int64_t adam_table(const float* const* positions, const float* const* grads, const int64_t* ends, int parts,
                   const int64_t* resolutions, const int64_t* offsets, int levels, float* values, float* mean,
                   float* square, float* seen, const adam::Settings& settings, int threads) {
    const Gathered<F> samples(positions, grads, ends, parts, levels, threads);
    // Of each thread, and zero between calls: the update clears what it has used.
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

template <int F, bool DENSE>
inline void add_position_gradient(const Level& level, const float* table, const Floats* xyz, int size,
                                  const float* grad, int64_t stride, Floats* out) {
    Cell cell;
    find_cell<DENSE>(level, xyz[0], xyz[1], xyz[2], cell);
    alignas(64) float value[CORNERS][LANES] = {};  // of the incoming gradient times each corner's entry
    for (int c = 0; c < CORNERS; c++)
        for (int s = 0; s < size; s++)
            for (int f = 0; f < F; f++)
                value[c][s] += table[(level.offset + cell.entry[c][s]) * F + f] * grad[s * stride + f];
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

#define FOR_FEATURES(features, call) \
    switch (features) {              \
        case 1: call(1); break;      \
        case 2: call(2); break;      \
        case 4: call(4); break;      \
        case 8: call(8); break;      \
        default: throw std::invalid_argument("hash grid: an entry has 1, 2, 4 or 8 features"); \
    }

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
#define CALL(F) backward_table<F>(positions, grads, ends, parts, resolutions, offsets, levels, table_grad, threads)
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
#define CALL(F)                                                                                                   \
    *touched = adam_table<F>(positions, grads, ends, parts, resolutions, offsets, levels, values, mean, square, seen, \
                             settings, threads)
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
