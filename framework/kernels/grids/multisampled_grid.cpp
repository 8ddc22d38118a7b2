// A hash grid at the multisamples of conical frustums: means of features, weighted by scale (Zip-NeRF). See
// multisampled_grid.py for the reference.
//
// The points of a sample lie close together, and at most levels some or all of them have the same corners. The weights
// of such a run are added up before an entry is accessed: if all 6 points share a cell, 8 entries are read or written
// instead of 48. Lanes are samples, so that vectors add up the weights of runs.
#include "grids/hash_grid.h"

#include <memory>

using namespace grid;

namespace {

constexpr int64_t CHUNK = 256;      // samples processed together: their points stay in cache
constexpr float SMALLEST = 0.05f;   // deviations in cells below this have a weight of 1 in float32
constexpr size_t NEAR = 1 << 15;    // floats of a level that stay in a near cache, where prefetching does not pay

// One point of each of LANES samples.
struct Point {
    Floats xyz[3], deviation;
};

// Fills `out` with the points of `size` samples; `points` is (count, per_sample, 4), and `row(s)` the row of sample s.
template <typename Row>
inline void load_points(const float* points, int per_sample, int size, Point* out, const Row& row) {
    for (int j = 0; j < per_sample; j++) {
        alignas(64) float lanes[4][LANES] = {};
        for (int s = 0; s < size; s++) {
            const float* from = points + (row(s) * per_sample + j) * 4;
            for (int i = 0; i < 4; i++) lanes[i][s] = from[i];
        }
        for (int axis = 0; axis < 3; axis++) out[j].xyz[axis] = load(lanes[axis]);
        out[j].deviation = load(lanes[3]);
    }
}

inline void load_points(const float* points, int per_sample, int64_t first, int size, Point* out) {
    load_points(points, per_sample, size, out, [&](int s) { return first + s; });
}

// erf of x >= 0: Abramowitz and Stegun 1964, 7.1.26 (error at most 1.5e-7), and the series for small x.
inline Floats error_function(Floats x) {
    const Floats squared = x * x, t = 1.0f / (1.0f + 0.3275911f * x);
    const Floats sum = (((1.061405429f * t - 1.453152027f) * t + 1.421413741f) * t - 0.284496736f) * t + 0.254829592f;
    const Floats series = 1.128379167f * x * (1.0f - squared * (1.0f / 3 - squared * 0.1f));
    return x < 0.1f ? series : 1.0f - sum * t * exponential(-squared);
}

// One bit for each lane that is true.
inline uint32_t bits_of(Ints lanes) {
    alignas(64) int32_t each[LANES];
    std::memcpy(each, &lanes, sizeof lanes);
    int32_t bits = 0;
    for (int s = 0; s < LANES; s++) bits |= each[s] & 1 << s;
    return uint32_t(bits);
}

// A point's weight in the mean over its sample: the weight of the level over the number of points.
inline Floats share_of(const Level& level, Floats deviation, int per_sample) {
    const Floats cells = deviation * float(level.resolution);
    const Floats equal = splat(1.0f / float(per_sample));
    const Ints sized = ~(cells < SMALLEST);  // NaN is included and stays NaN
    return bits_of(sized) ? error_function(0.353553391f / (sized ? cells : splat(SMALLEST))) * equal : equal;
}

inline Words entries_of(const Cell& cell, int corner) {
    Words out;
    std::memcpy(&out, cell.entry[corner], sizeof out);
    return out;
}

// Which lanes have other corners than before.
inline Ints have_moved(const Cell& here, const Cell& before) {
    Ints moved = {};
    for (int c = 0; c < CORNERS; c++) moved |= entries_of(here, c) != entries_of(before, c);
    return moved;
}

// For the lanes with a bit set.
template <int F>
inline void prefetch(const Cell& cell, uint32_t lanes, const float* entries) {
    for (; lanes; lanes &= lanes - 1)
        for (int c = 0; c < CORNERS; c++)
            __builtin_prefetch(entries + int64_t(cell.entry[c][__builtin_ctz(lanes)]) * F);
}

// Whether a level, with F features, is too large for a near cache.
template <int F>
inline bool is_far(const Level& level) {
    return (size_t(level.mask) + 1) * F > NEAR;
}

inline uint32_t first_lanes(int size) { return uint32_t((uint64_t(1) << size) - 1); }

// Calls visit(cell, s) for each run of consecutive points of sample s with the same corners; the weights in `cell` are
// the run's.
template <int F, bool DENSE, typename Visit>
inline void for_runs(const Level& level, const Point* points, int per_sample, int size, const float* entries,
                     const Visit& visit) {
    const bool far = is_far<F>(level);
    const uint32_t all = first_lanes(size);
    Cell cells[2];
    for (int j = 0; j < per_sample; j++) {
        Cell &before = cells[~j & 1], &here = cells[j & 1];
        const Floats* xyz = points[j].xyz;
        find_cell<DENSE>(level, xyz[0], xyz[1], xyz[2], here);
        const Floats share = share_of(level, points[j].deviation, per_sample);
        const Ints moved = j ? have_moved(here, before) : Ints{};
        const uint32_t fresh = j ? bits_of(moved) & all : all;
        if (far) prefetch<F>(here, fresh, entries);
        if (j == 0) {
            for (int c = 0; c < CORNERS; c++) store(here.weight[c], load(here.weight[c]) * share);
            continue;
        }
        for (uint32_t left = fresh; left; left &= left - 1) visit(before, __builtin_ctz(left));
        for (int c = 0; c < CORNERS; c++) {
            const Floats weight = load(here.weight[c]) * share;
            store(here.weight[c], moved ? weight : weight + load(before.weight[c]));
        }
    }
    for (int s = 0; s < size; s++) visit(cells[(per_sample - 1) & 1], s);
}

// One point per sample: while a block is looked up, the next block's entries are prefetched.
template <int F, bool DENSE>
void forward_level_of_points(const Level& level, const Point* points, const float* table, int64_t begin, int64_t end,
                            float* out, int64_t stride) {
    Cell cells[2];
    const float* entries = table + level.offset * F;
    const auto find = [&](const Point& point, Cell& cell) {
        find_cell<DENSE>(level, point.xyz[0], point.xyz[1], point.xyz[2], cell);
        const Floats share = share_of(level, point.deviation, 1);
        for (int c = 0; c < CORNERS; c++) store(cell.weight[c], load(cell.weight[c]) * share);
    };
    find(*points, cells[0]);
    for (int64_t n = begin, turn = 0; n < end; n += LANES, turn ^= 1) {
        if (n + LANES < end) {
            find(*++points, cells[turn ^ 1]);
            grid::prefetch<F>(cells[turn ^ 1], entries);
        }
        blend<F>(cells[turn], entries, block(n, end), out + n * stride, stride);
    }
}

template <int F, bool DENSE>
void forward_level(const Level& level, const Point* points, int per_sample, const float* table, int64_t begin,
                   int64_t end, float* out, int64_t stride) {
    if (per_sample == 1) return forward_level_of_points<F, DENSE>(level, points, table, begin, end, out, stride);
    const float* entries = table + level.offset * F;
    for (int64_t n = begin; n < end; n += LANES, points += per_sample) {
        const int size = block(n, end);
        float sum[LANES][F] = {};
        for_runs<F, DENSE>(level, points, per_sample, size, entries, [&](const Cell& cell, int s) {
            for (int c = 0; c < CORNERS; c++) {
                const float* entry = entries + int64_t(cell.entry[c][s]) * F;
                for (int f = 0; f < F; f++) sum[s][f] += cell.weight[c][s] * entry[f];
            }
        });
        for (int s = 0; s < size; s++) std::memcpy(out + (n + s) * stride, sum[s], sizeof sum[s]);
    }
}

template <int F>
void forward(const float* positions, int64_t count, int per_sample, const float* table, const int64_t* resolutions,
             const int64_t* offsets, int levels, float* out, int threads) {
    const int64_t stride = int64_t(levels) * F;
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        const std::unique_ptr<Point[]> points(new Point[size_t((end - begin + LANES - 1) / LANES * per_sample)]);
        for (int64_t n = begin; n < end; n += LANES)
            load_points(positions, per_sample, n, block(n, end), points.get() + (n - begin) / LANES * per_sample);
        for (int l = 0; l < levels; l++) {
            const Level level = level_of(resolutions, offsets, l);
            const auto run = level.dense ? forward_level<F, true> : forward_level<F, false>;
            run(level, points.get(), per_sample, table, begin, end, out + l * F, stride);
        }
    });
}

// `grad`: the gradient of this level, (count, F).
template <int F, bool DENSE>
void scatter_level(const Level& level, const Point* points, int per_sample, int64_t count, const float* grad,
                   float* table) {
    for (int64_t n = 0; n < count; n += LANES, points += per_sample)
        for_runs<F, DENSE>(level, points, per_sample, block(n, count), table, [&](const Cell& cell, int s) {
            float g[F];
            std::memcpy(g, grad + (n + s) * F, sizeof g);
            for (int c = 0; c < CORNERS; c++) {
                float* entry = table + int64_t(cell.entry[c][s]) * F;
                for (int f = 0; f < F; f++) entry[f] += cell.weight[c][s] * g[f];
            }
        });
}

// Samples with a gradient, collected from parts, each with its own number of points per sample: their rows, points in
// blocks of LANES samples, and the incoming gradient level by level.
template <int F>
struct Gathered {
    struct Part {
        std::vector<int64_t> rows;
        int64_t count;
        int per_sample;
        std::unique_ptr<Point[]> points;
        std::unique_ptr<float[]> by_level;
    };
    std::vector<Part> parts;

    // `ends` holds the number of samples up to the end of each part.
    Gathered(const float* const* points, const float* const* grads, const int64_t* ends, const int64_t* per_sample,
             int count, int levels, int threads) {
        const int64_t stride = int64_t(levels) * F;
        for (int i = 0; i < count; i++) {
            std::vector<int64_t> live;
            rows_with_gradient(grads[i], ends[i] - (i ? ends[i - 1] : 0), stride, live);
            const int64_t size = int64_t(live.size());
            const int own = int(per_sample[i]);
            Part part{std::move(live), size, own,
                      std::unique_ptr<Point[]>(new Point[size_t((size + LANES - 1) / LANES * own)]),
                      std::unique_ptr<float[]>(new float[size_t(size * stride)])};
            for_ranges(threads, size, CHUNK, [&](int64_t begin, int64_t end) {
                for (int64_t n = begin; n < end; n += LANES)
                    load_points(points[i], own, block(n, end), part.points.get() + n / LANES * own,
                                [&](int s) { return part.rows[size_t(n + s)]; });
                for (int64_t n = begin; n < end; n++)
                    for (int l = 0; l < levels; l++)
                        std::memcpy(part.by_level.get() + (l * size + n) * F,
                                    grads[i] + part.rows[size_t(n)] * stride + l * F, sizeof(float) * F);
            });
            parts.push_back(std::move(part));
        }
    }
    // Adds a level's gradient to `table`, which points to that level's first entry.
    void scatter_to(const Level& level, int l, float* table) const {
        const auto run = level.dense ? scatter_level<F, true> : scatter_level<F, false>;
        for (const Part& part : parts)
            run(level, part.points.get(), part.per_sample, part.count, part.by_level.get() + l * part.count * F, table);
    }
};

// Adds the gradient of one level by the points of `count` samples to `out`, with three sums per block of points;
// `grad`: gradient of the level, (count, F). The points of a run share one look-up of their corners.
template <int F, bool DENSE>
void add_point_gradient(const Level& level, const Point* points, int per_sample, int64_t count, const float* table,
                        const float* grad, Floats (*out)[3]) {
    const float* entries = table + level.offset * F;
    const bool far = is_far<F>(level);
    alignas(64) float value[CORNERS][LANES] = {};
    Cell cells[2];  // this point's and the next one's, which is prefetched
    uint32_t fresh[2];
    for (int64_t n = 0; n < count; n += LANES, points += per_sample) {
        const uint32_t all = first_lanes(block(n, count));
        const auto find = [&](int j) {
            Cell& here = cells[j & 1];
            find_cell<DENSE>(level, points[j].xyz[0], points[j].xyz[1], points[j].xyz[2], here);
            fresh[j & 1] = j ? bits_of(have_moved(here, cells[~j & 1])) & all : all;
            if (far) prefetch<F>(here, fresh[j & 1], entries);
        };
        find(0);
        for (int j = 0; j < per_sample; j++) {
            const Cell& here = cells[j & 1];
            if (j + 1 < per_sample) find(j + 1);
            for (uint32_t left = fresh[j & 1]; left; left &= left - 1) {
                const int s = __builtin_ctz(left);
                weigh_corners<F>(here, s, entries, grad + (n + s) * F, value);
            }
            Floats own[3] = {splat(0), splat(0), splat(0)};
            add_slopes(here, value, own);
            const Floats share = share_of(level, points[j].deviation, per_sample);
            for (int axis = 0; axis < 3; axis++) (*out)[axis] += share * own[axis];
            out++;
        }
    }
}

template <int F>
void backward_points(const float* points, int64_t count, int per_sample, const float* table, const float* grad,
                     const int64_t* resolutions, const int64_t* offsets, int levels, float* out, int threads) {
    const int64_t each = per_sample;
    const Gathered<F> gathered(&points, &grad, &count, &each, 1, levels, threads);
    const auto& live = gathered.parts[0];
    const int64_t row = each * 4;
    if (live.count < count) std::memset(out, 0, sizeof(float) * size_t(count * row));
    for_ranges(threads, live.count, CHUNK, [&](int64_t begin, int64_t end) {
        const int64_t size = end - begin, first = begin / LANES * each;
        const std::unique_ptr<Floats[][3]> sums(new Floats[size_t((size + LANES - 1) / LANES * each)][3]());
        for (int l = 0; l < levels; l++) {
            const Level level = level_of(resolutions, offsets, l);
            const auto run = level.dense ? add_point_gradient<F, true> : add_point_gradient<F, false>;
            const float* incoming = live.by_level.get() + (l * live.count + begin) * F;
            run(level, live.points.get() + first, per_sample, size, table, incoming, sums.get());
        }
        for (int64_t n = 0; n < size; n++)
            for (int j = 0; j < per_sample; j++) {
                const Floats* sum = sums[size_t(n / LANES * each + j)];
                float* to = out + live.rows[size_t(begin + n)] * row + j * 4;
                for (int axis = 0; axis < 3; axis++) to[axis] = sum[axis][n % LANES];
                to[3] = 0;
            }
    });
}

}  // namespace

EXPORT int multisampled_grid_forward(const float* points, int64_t count, int per_sample, const float* table,
                                     int features, const int64_t* resolutions, const int64_t* offsets, int levels,
                                     float* out, int threads) {
    return guarded([&] {
#define CALL(F) forward<F>(points, count, per_sample, table, resolutions, offsets, levels, out, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adds to `table_grad`.
EXPORT int multisampled_grid_backward_table(const float* const* points, const float* const* grads,
                                            const int64_t* ends, const int64_t* per_sample, int parts, int features,
                                            const int64_t* resolutions, const int64_t* offsets, int levels,
                                            float* table_grad, int threads) {
    return guarded([&] {
#define CALL(F)                                                                                               \
    add_by_level<F>(Gathered<F>(points, grads, ends, per_sample, parts, levels, threads), resolutions, offsets, \
                    levels, table_grad, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// Adam on the gradient that multisampled_grid_backward_table would add. `touched`: number of updated entries.
EXPORT int multisampled_grid_adam(const float* const* points, const float* const* grads, const int64_t* ends,
                                  const int64_t* per_sample, int parts, int features, const int64_t* resolutions,
                                  const int64_t* offsets, int levels, float* values, float* mean, float* square,
                                  float* seen, float rate, double beta1, double beta2, float eps, int threads,
                                  int64_t* touched) {
    return guarded([&] {
        const adam::Settings settings(rate, beta1, beta2, eps);
#define CALL(F)                                                                                                \
    *touched = adam_by_level<F>(Gathered<F>(points, grads, ends, per_sample, parts, levels, threads), resolutions, \
                                offsets, levels, values, mean, square, seen, settings, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

EXPORT int multisampled_grid_backward_points(const float* points, int64_t count, int per_sample, const float* table,
                                             const float* grad, int features, const int64_t* resolutions,
                                             const int64_t* offsets, int levels, float* points_grad, int threads) {
    return guarded([&] {
#define CALL(F) \
    backward_points<F>(points, count, per_sample, table, grad, resolutions, offsets, levels, points_grad, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}
