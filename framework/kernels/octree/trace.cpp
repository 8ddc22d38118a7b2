// Light along rays through an octree: colour, opacity and depth, and the gradient of its leaves. See light.py for the
// reference and the equations.
#include "encodings/harmonics.h"
#include "octree/walk.h"

#include <algorithm>
#include <vector>

namespace {

constexpr int64_t RAYS = 256;  // rays of a chunk, whose leaves stay in cache
constexpr size_t AHEAD = 16;   // visits that are fetched before they are used
constexpr int MOST = 48;        // values of a leaf: 16 harmonics of 3 channels

// Leaves of floats: the optical depth of a cell's edge is exp(raw - 1), from 1 on raw itself.
struct Raw {
    static constexpr float NONE = -1e9f;  // the value where there is no leaf
    const float *raw, *colors;
    int values;
    float value(int32_t leaf, int32_t) const { return raw[leaf]; }
    static Floats depth(Floats x) {
        const Floats low = exponential(smaller(splat(1), x) - 1.0f);  // NaN stays NaN
        return x > 1.0f ? x : low;
    }
    const float* row(int32_t leaf) const { return colors + int64_t(leaf) * values; }
    void expect(int32_t leaf) const {
        octree::fetch(raw + leaf);
        if (values > 0) octree::fetch(row(leaf), values);
    }
    float decoded(int, float sum, float) const { return sum; }
};

// Leaves of bytes: a table of optical depths for each level; a coefficient is scale * byte + offset.
struct Packed {
    static constexpr float NONE = 0;
    const uint8_t *codes, *colors;
    const float *table, *scales, *offsets;
    int values;
    float value(int32_t leaf, int32_t level) const { return table[256 * level + codes[leaf]]; }
    static Floats depth(Floats x) { return x; }
    const uint8_t* row(int32_t leaf) const { return colors + int64_t(leaf) * values; }
    void expect(int32_t leaf) const { octree::fetch(codes + leaf), octree::fetch(row(leaf), values); }
    float decoded(int value, float sum, float weight) const { return scales[value] * sum + offsets[value] * weight; }
};

// A step of all lanes: optical depth of an edge, length in cells, and weight of each lane's leaf.
struct Step {
    alignas(64) float edge[LANES], length[LANES], weight[LANES], left[LANES];

    template <typename Leaves>
    Step(const Leaves& leaves, const octree::Passage& met, float* through, float limit, int32_t* ends) {
        alignas(64) float value[LANES];
        for (int lane = 0; lane < LANES; lane++)
            value[lane] = met.leaf[lane] < 0 ? Leaves::NONE : leaves.value(met.leaf[lane], met.level[lane]);
        const Floats of_edge = Leaves::depth(load(value)), before = load(through);
        const Floats cells = (load(met.to) - load(met.from)) * load(met.per_cell);
        const Floats share = before * opacity_of(of_edge * cells), after = before - share;
        store(edge, of_edge), store(length, cells), store(weight, share), store(left, before), store(through, after);
        const Ints over = after < splat(limit);
        std::memcpy(ends, &over, sizeof over);
    }
};

void basis_of(const float* direction, int basis, float* out) {
    out[0] = FIRST_HARMONIC;
    harmonics(direction[0], direction[1], direction[2], basis - 1, out + 1);
}

struct Results {  // of R rays
    const float* background;                     // (R, 3)
    float *color, *opacity, *moment, *median;
    int32_t* visits;
};

// Sums over the leaves of a ray. Colours are linear in the coefficients: these are summed with their weights, and meet
// the harmonics of the ray's direction once, at its end.
template <typename Leaves, int N>
struct Shade {
    const Leaves& leaves;
    const octree::Beams& beams;
    const Results& out;
    float limit;
    alignas(64) float sums[LANES][N];
    alignas(64) float through[LANES], moment[LANES], median[LANES];
    int32_t visits[LANES];

    void expect(int32_t leaf) const { leaves.expect(leaf); }
    void start(int lane, int64_t) {
        for (int k = 0; k < N; k++) sums[lane][k] = 0;
        through[lane] = 1, moment[lane] = 0, median[lane] = -1, visits[lane] = 0;
    }

    void meet(const octree::Passage& met, int32_t* ends) {
        const Step step(leaves, met, through, limit, ends);
        store(moment, load(moment) + load(step.weight) * 0.5f * (load(met.from) + load(met.to)));
        for (int lane = 0; lane < LANES; lane++) {
            if (met.leaf[lane] < 0) continue;
            visits[lane]++;
            const float weight = step.weight[lane];
            const auto* row = leaves.row(met.leaf[lane]);
            float* to = sums[lane];
            for (int k = 0; k < N; k++) to[k] += weight * float(row[k]);
            if (median[lane] < 0 && through[lane] <= 0.5f) {
                const float depth = step.edge[lane] * step.length[lane];
                const float length = met.to[lane] - met.from[lane];
                median[lane] = met.from[lane] + length * (std::log(2 * step.left[lane]) / depth);
            }
        }
    }

    void finish(int lane, int64_t r) {
        constexpr int basis = N / 3;
        float y[16];
        basis_of(beams.directions + 3 * r, basis, y);
        const float weight = 1 - through[lane];
        for (int c = 0; c < 3; c++) {
            float sum = through[lane] * out.background[3 * r + c];
            for (int k = 0; k < basis; k++) sum += y[k] * leaves.decoded(c * basis + k, sums[lane][c * basis + k], weight);
            out.color[3 * r + c] = sum;
        }
        out.opacity[r] = weight, out.moment[r] = moment[lane], out.visits[r] = visits[lane];
        out.median[r] = median[lane] < 0 ? beams.fars[r] : std::min(median[lane], beams.fars[r]);
    }
};

template <typename Leaves, int N>
void shade(const octree::Layout& layout, const octree::Beams& beams, const Leaves& leaves, const Results& out,
           int64_t rays, float limit, int threads) {
    for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
        Shade<Leaves, N> light{leaves, beams, out, limit, {}, {}, {}, {}, {}};
        octree::Walk<Shade<Leaves, N>>(layout, beams, light).run(begin, end);
    });
}

template <typename Leaves>
void shade_any(const octree::Layout& layout, const octree::Beams& beams, const Leaves& leaves, const Results& out,
               int64_t rays, float limit, int threads) {
    switch (leaves.values) {
        case 3: return shade<Leaves, 3>(layout, beams, leaves, out, rays, limit, threads);
        case 12: return shade<Leaves, 12>(layout, beams, leaves, out, rays, limit, threads);
        case 27: return shade<Leaves, 27>(layout, beams, leaves, out, rays, limit, threads);
        case MOST: return shade<Leaves, MOST>(layout, beams, leaves, out, rays, limit, threads);
        default: throw std::invalid_argument("a leaf has 3, 12, 27 or 48 colour values");
    }
}

struct Visit {
    int32_t leaf, ray;
    float weight, slope;  // of the colour; derivative of the loss by the leaf's raw density
};

// The leaves of each ray, for its gradient.
struct Record {
    struct Part {
        int32_t leaf;
        float edge, length, weight;
    };
    const Raw& leaves;
    float limit;
    std::vector<Part> met[LANES];
    alignas(64) float through[LANES];
    std::vector<std::vector<Part>>& rays;
    int64_t first;

    void expect(int32_t leaf) const { leaves.expect(leaf); }
    void start(int lane, int64_t) { met[lane].clear(), through[lane] = 1; }
    void meet(const octree::Passage& passage, int32_t* ends) {
        const Step step(leaves, passage, through, limit, ends);
        for (int lane = 0; lane < LANES; lane++)
            if (passage.leaf[lane] >= 0)
                met[lane].push_back({passage.leaf[lane], step.edge[lane], step.length[lane], step.weight[lane]});
    }
    void finish(int lane, int64_t r) { rays[size_t(r - first)].swap(met[lane]); }
};

struct Incoming {  // gradients of R rays
    const float *color, *opacity, *background;
};

// A ray's visits. Behind a leaf, the ray shows `behind`: the light of all leaves behind and of the background.
void differentiate(const std::vector<Record::Part>& met, int32_t ray, const float* y, const Raw& leaves,
                   const Incoming& grad, std::vector<Visit>& visits) {
    const int n = leaves.values, basis = n / 3;
    const size_t begin = visits.size();
    float mixed[MOST];  // derivative of the loss by the coefficients of a leaf of weight 1
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < basis; k++) mixed[c * basis + k] = grad.color[3 * ray + c] * y[k];
    const float opaque = grad.opacity ? grad.opacity[ray] : 0;
    float left = 1;
    for (const auto& part : met) {
        const float* row = leaves.row(part.leaf);
        float shown = opaque;
        for (int k = 0; k < n; k++) shown += mixed[k] * row[k];
        left -= part.weight;
        visits.push_back({part.leaf, ray, part.weight, shown});
    }
    float behind = 0;
    for (int c = 0; c < 3; c++) behind += grad.color[3 * ray + c] * grad.background[3 * ray + c];
    behind *= left;
    for (size_t i = met.size(); i-- > 0;) {
        Visit& v = visits[begin + i];
        const float value = v.slope;
        // d/dtau of w value + (all behind) is (transmittance behind the leaf) value - (all behind). The slope of the
        // depth by raw is the depth itself, up to 1.
        v.slope = (left * value - behind) * met[i].length * std::min(met[i].edge, 1.0f);
        behind += v.weight * value;
        left += v.weight;
    }
}

// Gives each leaf that a ray has visited a row, in ascending order. Returns the rows; `slots` has each leaf's, or -1.
int64_t give_rows(const std::vector<std::vector<Visit>>& chunks, int64_t leaves, int64_t shares, int threads,
                  std::vector<int32_t>& slots, int32_t* touched) {
    slots.assign(size_t(leaves), -1);
    std::vector<int64_t> rows(size_t(shares) + 1, 0);
    for_chunks(threads, shares, [&](int64_t share, int) {
        const int32_t from = int32_t(leaves * share / shares), to = int32_t(leaves * (share + 1) / shares);
        int64_t count = 0;
        for (const auto& visits : chunks) {
            for (size_t i = 0; i < visits.size(); i++) {
                if (i + AHEAD < visits.size()) octree::fetch(&slots[size_t(visits[i + AHEAD].leaf)]);
                const int32_t leaf = visits[i].leaf;
                if (leaf >= from && leaf < to && slots[size_t(leaf)] < 0) slots[size_t(leaf)] = 0, count++;
            }
        }
        rows[size_t(share) + 1] = count;
    });
    for (int64_t share = 0; share < shares; share++) rows[size_t(share) + 1] += rows[size_t(share)];
    for_chunks(threads, shares, [&](int64_t share, int) {
        const int32_t from = int32_t(leaves * share / shares), to = int32_t(leaves * (share + 1) / shares);
        int64_t row = rows[size_t(share)];
        for (int32_t leaf = from; leaf < to; leaf++)
            if (slots[size_t(leaf)] >= 0) touched[row] = leaf, slots[size_t(leaf)] = int32_t(row++);
    });
    return rows.back();
}

}  // namespace

// The first eight arguments of the functions below describe an octree of some levels, finest first: edge of the finest
// cells, then origin, size, bricks, masks and octants of each level, and the index of its first leaf (walk.h).

// Colour over the background, opacity, sum of weight * t, median t, and number of leaves of R rays. `values` colours a
// leaf.
EXPORT int octree_trace(int levels, float cell, const float* const* origins_of, const int64_t* sizes,
                        const int32_t* const* bricks, const int64_t* const* masks, const int32_t* const* firsts,
                        const int64_t* leaves_of, const float* raw, const float* colors, int values,
                        const float* origins, const float* directions, const float* nears, const float* fars,
                        int64_t rays, const float* background, float limit, float* color, float* opacity,
                        float* moment, float* median, int32_t* visits, int threads) {
    return guarded([&] {
        const octree::Layout layout(levels, cell, origins_of, sizes, bricks, masks, firsts, leaves_of);
        shade_any(layout, {origins, directions, nears, fars, nullptr}, Raw{raw, colors, values},
                  {background, color, opacity, moment, median, visits}, rays, limit, threads);
    });
}

// As octree_trace, of leaves of bytes. smallest (R): smallest edge of cells per unit of distance; null for none.
EXPORT int octree_trace_packed(int levels, float cell, const float* const* origins_of, const int64_t* sizes,
                               const int32_t* const* bricks, const int64_t* const* masks, const int32_t* const* firsts,
                               const int64_t* leaves_of, const uint8_t* codes, const float* table,
                               const uint8_t* colors, const float* scales, const float* offsets, int values,
                               const float* origins, const float* directions, const float* nears, const float* fars,
                               int64_t rays, const float* smallest, const float* background, float limit, float* color,
                               float* opacity, float* moment, float* median, int32_t* visits, int threads) {
    return guarded([&] {
        const octree::Layout layout(levels, cell, origins_of, sizes, bricks, masks, firsts, leaves_of);
        shade_any(layout, {origins, directions, nears, fars, smallest},
                  Packed{codes, colors, table, scales, offsets, values},
                  {background, color, opacity, moment, median, visits}, rays, limit, threads);
    });
}

// The gradient of L leaves. Each thread has a share of the leaves and visits all rays in order, so the sums do not depend
// on their number. With `touched`, gradients have a row for each leaf that a ray has visited, which it lists; their
// number is `rows_used`. Without, they have a row for each leaf, and are added to. `peaks` (L) is raised to each leaf's
// largest weight on the rays. grad_opacity and peaks may be null.
EXPORT int octree_trace_backward(int levels, float cell, const float* const* origins_of, const int64_t* sizes,
                                 const int32_t* const* bricks, const int64_t* const* masks,
                                 const int32_t* const* firsts, const int64_t* leaves_of, const float* raw,
                                 const float* colors, int values, int64_t leaves, const float* origins,
                                 const float* directions, const float* nears, const float* fars, int64_t rays,
                                 const float* background, float limit, const float* grad_color,
                                 const float* grad_opacity, float* grad_raw, float* grad_colors, int32_t* touched,
                                 float* peaks, int threads, int64_t* rows_used) {
    return guarded([&] {
        const octree::Layout layout(levels, cell, origins_of, sizes, bricks, masks, firsts, leaves_of);
        const octree::Beams beams{origins, directions, nears, fars, nullptr};
        const Raw known{raw, colors, values};
        const Incoming incoming{grad_color, grad_opacity, background};
        const int basis = values / 3;
        std::vector<float> y(size_t(rays) * 16);
        std::vector<std::vector<Visit>> chunks(size_t((rays + RAYS - 1) / RAYS));
        for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
            std::vector<std::vector<Record::Part>> met(size_t(end - begin));
            Record record{known, limit, {}, {}, met, begin};
            octree::Walk<Record>(layout, beams, record).run(begin, end);
            auto& visits = chunks[size_t(begin / RAYS)];
            for (int64_t r = begin; r < end; r++) {
                if (met[size_t(r - begin)].empty()) continue;
                basis_of(directions + 3 * r, basis, &y[size_t(r) * 16]);
                differentiate(met[size_t(r - begin)], int32_t(r), &y[size_t(r) * 16], known, incoming, visits);
            }
        });
        const int64_t shares = std::max(threads, 1);
        std::vector<int32_t> slots;
        *rows_used = touched ? give_rows(chunks, leaves, shares, threads, slots, touched) : 0;
        for_chunks(threads, shares, [&](int64_t share, int) {
            if (touched) {
                const int64_t first = *rows_used * share / shares, last = *rows_used * (share + 1) / shares;
                std::fill(grad_raw + first, grad_raw + last, 0.0f);
                std::fill(grad_colors + first * values, grad_colors + last * values, 0.0f);
            }
        });
        for_chunks(threads, shares, [&](int64_t share, int) {
            const int64_t rows = touched ? *rows_used : leaves;
            const int32_t from = int32_t(rows * share / shares), to = int32_t(rows * (share + 1) / shares);
            const auto place = [&](const Visit& v) { return touched ? slots[size_t(v.leaf)] : v.leaf; };
            for (const auto& visits : chunks) {
                for (size_t i = 0; i < visits.size(); i++) {
                    if (touched && i + 2 * AHEAD < visits.size()) octree::fetch(&slots[size_t(visits[i + 2 * AHEAD].leaf)]);
                    if (i + AHEAD < visits.size()) {
                        const int32_t later = place(visits[i + AHEAD]);
                        if (later >= from && later < to) octree::fetch(grad_colors + int64_t(later) * values, values);
                    }
                    const Visit& v = visits[i];
                    const int32_t at = place(v);
                    if (at < from || at >= to) continue;
                    if (peaks && v.weight > peaks[v.leaf]) peaks[v.leaf] = v.weight;
                    grad_raw[at] += v.slope;
                    float* row = grad_colors + int64_t(at) * values;
                    const float* harmonic = &y[size_t(v.ray) * 16];
                    for (int c = 0; c < 3; c++) {
                        const float share_of = v.weight * grad_color[3 * v.ray + c];
                        for (int k = 0; k < basis; k++) row[c * basis + k] += share_of * harmonic[k];
                    }
                }
            }
        });
    });
}

// The opacity of R rays, and the largest weight of each leaf on them, where it is larger than before.
EXPORT int octree_weights(int levels, float cell, const float* const* origins_of, const int64_t* sizes,
                          const int32_t* const* bricks, const int64_t* const* masks, const int32_t* const* firsts,
                          const int64_t* leaves_of, const float* raw, int64_t leaves, const float* origins,
                          const float* directions, const float* nears, const float* fars, int64_t rays, float limit,
                          float* weights, float* opacity, int threads) {
    return guarded([&] {
        const octree::Layout layout(levels, cell, origins_of, sizes, bricks, masks, firsts, leaves_of);
        const octree::Beams beams{origins, directions, nears, fars, nullptr};
        const Raw known{raw, nullptr, 0};
        std::vector<std::vector<std::pair<int32_t, float>>> chunks(size_t((rays + RAYS - 1) / RAYS));
        for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
            std::vector<std::vector<Record::Part>> met(size_t(end - begin));
            Record record{known, limit, {}, {}, met, begin};
            octree::Walk<Record>(layout, beams, record).run(begin, end);
            auto& found = chunks[size_t(begin / RAYS)];
            for (int64_t r = begin; r < end; r++) {
                float left = 1;
                for (const auto& part : met[size_t(r - begin)]) {
                    found.push_back({part.leaf, part.weight});
                    left -= part.weight;
                }
                opacity[r] = 1 - left;
            }
        });
        const int64_t shares = std::max(threads, 1);
        for_chunks(threads, shares, [&](int64_t share, int) {
            const int32_t from = int32_t(leaves * share / shares), to = int32_t(leaves * (share + 1) / shares);
            for (const auto& found : chunks)
                for (const auto& [leaf, weight] : found)
                    if (leaf >= from && leaf < to && weight > weights[leaf]) weights[leaf] = weight;
        });
    });
}
