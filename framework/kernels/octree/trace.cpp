// Light along rays through an octree: colour, opacity and depth, and the gradient of its leaves. See ../light.py for the
// reference and the equations.
#include "encodings/harmonics.h"
#include "octree/walk.h"

#include <algorithm>
#include <vector>

namespace {

constexpr int64_t RAYS = 1024;  // rays of a chunk
constexpr int MOST = 48;        // values of a leaf: 16 harmonics of 3 channels

// Leaves of floats: the optical depth of a cell's edge is softplus(raw).
struct Raw {
    const float *raw, *colors;
    int values;
    float depth(int32_t leaf) const {
        const float x = raw[leaf];
        return x > 15 ? x : std::log1p(std::exp(x));
    }
    float slope(int32_t leaf) const { return 1 / (1 + std::exp(-raw[leaf])); }
    const float* row(int32_t leaf) const { return colors + int64_t(leaf) * values; }
    float decoded(int, float sum, float) const { return sum; }
};

// Leaves of bytes: a table of optical depths; a coefficient is scale * byte + offset.
struct Packed {
    const uint8_t *codes, *colors;
    const float *table, *scales, *offsets;
    int values;
    float depth(int32_t leaf) const { return table[codes[leaf]]; }
    const uint8_t* row(int32_t leaf) const { return colors + int64_t(leaf) * values; }
    float decoded(int value, float sum, float weight) const { return scales[value] * sum + offsets[value] * weight; }
};

void basis_of(const float* direction, int basis, float* out) {
    out[0] = FIRST_HARMONIC;
    harmonics(direction[0], direction[1], direction[2], basis - 1, out + 1);
}

struct Results {  // of R rays
    const float* background;                     // (R, 3)
    float *color, *opacity, *moment, *median;
};

// Sums over the leaves of a ray. Colours are linear in the coefficients: these are summed with their weights, and meet
// the harmonics of the ray's direction once, at its end.
template <typename Leaves, int N>
struct Shade {
    const Leaves& leaves;
    const octree::Beams& beams;
    const Results& out;
    float per_cell, limit;
    alignas(64) float sums[LANES][N];
    float through[LANES], moment[LANES], median[LANES];

    void start(int lane, int64_t) {
        for (int k = 0; k < N; k++) sums[lane][k] = 0;
        through[lane] = 1, moment[lane] = 0, median[lane] = -1;
    }

    bool meet(int lane, int32_t leaf, float t0, float t1) {
        const float depth = leaves.depth(leaf) * (t1 - t0) * per_cell, left = through[lane];
        const float weight = left * -std::expm1(-depth);
        const auto* row = leaves.row(leaf);
        float* to = sums[lane];
        for (int k = 0; k < N; k++) to[k] += weight * float(row[k]);
        moment[lane] += weight * 0.5f * (t0 + t1);
        through[lane] = left - weight;
        if (median[lane] < 0 && through[lane] <= 0.5f) median[lane] = t0 + (t1 - t0) * (std::log(2 * left) / depth);
        return !(through[lane] < limit);
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
        out.opacity[r] = weight, out.moment[r] = moment[lane];
        out.median[r] = median[lane] < 0 ? beams.fars[r] : std::min(median[lane], beams.fars[r]);
    }
};

template <typename Leaves, int N>
void shade(const octree::Layout& layout, const octree::Beams& beams, const Leaves& leaves, const Results& out,
           int64_t rays, float limit, int threads) {
    for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
        Shade<Leaves, N> light{leaves, beams, out, 1 / layout.cell, limit, {}, {}, {}, {}};
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
        float length;
    };
    const Raw& leaves;
    float per_cell, limit;
    std::vector<Part> met[LANES];
    float through[LANES];
    std::vector<std::vector<Part>>& rays;
    int64_t first;

    void start(int lane, int64_t) { met[lane].clear(), through[lane] = 1; }
    bool meet(int lane, int32_t leaf, float t0, float t1) {
        met[lane].push_back({leaf, (t1 - t0) * per_cell});
        const float left = through[lane];
        through[lane] = left - left * -std::expm1(-leaves.depth(leaf) * met[lane].back().length);
        return !(through[lane] < limit);
    }
    void finish(int lane, int64_t r) { rays[size_t(r - first)].swap(met[lane]); }
};

struct Incoming {  // gradients of R rays
    const float *color, *opacity, *background;
};

// A ray's visits. Behind a leaf, the ray shows `behind`: the light of what follows and of the background.
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
        const float weight = left * -std::expm1(-leaves.depth(part.leaf) * part.length);
        const float* row = leaves.row(part.leaf);
        float shown = opaque;
        for (int k = 0; k < n; k++) shown += mixed[k] * row[k];
        left -= weight;
        visits.push_back({part.leaf, ray, weight, shown});
    }
    float behind = 0;
    for (int c = 0; c < 3; c++) behind += grad.color[3 * ray + c] * grad.background[3 * ray + c];
    behind *= left;
    for (size_t i = met.size(); i-- > 0;) {
        Visit& v = visits[begin + i];
        const float value = v.slope;
        // d/dtau of w value + (all behind) is (transmittance behind the leaf) value - (all behind).
        v.slope = (left * value - behind) * met[i].length * leaves.slope(v.leaf);
        behind += v.weight * value;
        left += v.weight;
    }
}

}  // namespace

// Colour over the background, opacity, sum of weight * t, and median t of R rays. `values` colours a leaf.
EXPORT int octree_trace(const float* origin, float cell, const int64_t* size, const int32_t* bricks,
                        const int64_t* masks, const int32_t* firsts, const float* raw, const float* colors, int values,
                        const float* origins, const float* directions, const float* nears, const float* fars,
                        int64_t rays, const float* background, float limit, float* color, float* opacity,
                        float* moment, float* median, int threads) {
    return guarded([&] {
        const octree::Layout layout{origin, cell, size, bricks, masks, firsts};
        shade_any(layout, {origins, directions, nears, fars}, Raw{raw, colors, values},
                  {background, color, opacity, moment, median}, rays, limit, threads);
    });
}

// As octree_trace, of leaves of bytes.
EXPORT int octree_trace_packed(const float* origin, float cell, const int64_t* size, const int32_t* bricks,
                               const int64_t* masks, const int32_t* firsts, const uint8_t* codes, const float* table,
                               const uint8_t* colors, const float* scales, const float* offsets, int values,
                               const float* origins, const float* directions, const float* nears, const float* fars,
                               int64_t rays, const float* background, float limit, float* color, float* opacity,
                               float* moment, float* median, int threads) {
    return guarded([&] {
        const octree::Layout layout{origin, cell, size, bricks, masks, firsts};
        shade_any(layout, {origins, directions, nears, fars}, Packed{codes, colors, table, scales, offsets, values},
                  {background, color, opacity, moment, median}, rays, limit, threads);
    });
}

// Adds the gradient of L leaves. Each thread has a share of the leaves and visits all rays in order, so the sums do not
// depend on their number. grad_opacity may be null.
EXPORT int octree_trace_backward(const float* origin, float cell, const int64_t* size, const int32_t* bricks,
                                 const int64_t* masks, const int32_t* firsts, const float* raw, const float* colors,
                                 int values, int64_t leaves, const float* origins, const float* directions,
                                 const float* nears, const float* fars, int64_t rays, const float* background,
                                 float limit, const float* grad_color, const float* grad_opacity, float* grad_raw,
                                 float* grad_colors, int threads) {
    return guarded([&] {
        const octree::Layout layout{origin, cell, size, bricks, masks, firsts};
        const octree::Beams beams{origins, directions, nears, fars};
        const Raw known{raw, colors, values};
        const Incoming incoming{grad_color, grad_opacity, background};
        const int basis = values / 3;
        std::vector<float> y(size_t(rays) * 16);
        std::vector<std::vector<Visit>> chunks(size_t((rays + RAYS - 1) / RAYS));
        for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
            std::vector<std::vector<Record::Part>> met(size_t(end - begin));
            Record record{known, 1 / cell, limit, {}, {}, met, begin};
            octree::Walk<Record>(layout, beams, record).run(begin, end);
            auto& visits = chunks[size_t(begin / RAYS)];
            for (int64_t r = begin; r < end; r++) {
                if (met[size_t(r - begin)].empty()) continue;
                basis_of(directions + 3 * r, basis, &y[size_t(r) * 16]);
                differentiate(met[size_t(r - begin)], int32_t(r), &y[size_t(r) * 16], known, incoming, visits);
            }
        });
        const int64_t shares = std::max(threads, 1);
        for_chunks(threads, shares, [&](int64_t share, int) {
            const int32_t from = int32_t(leaves * share / shares), to = int32_t(leaves * (share + 1) / shares);
            for (const auto& visits : chunks) {
                for (const Visit& v : visits) {
                    if (v.leaf < from || v.leaf >= to) continue;
                    grad_raw[v.leaf] += v.slope;
                    float* row = grad_colors + int64_t(v.leaf) * values;
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
EXPORT int octree_weights(const float* origin, float cell, const int64_t* size, const int32_t* bricks,
                          const int64_t* masks, const int32_t* firsts, const float* raw, int64_t leaves,
                          const float* origins, const float* directions, const float* nears,
                          const float* fars, int64_t rays, float limit, float* weights, float* opacity,
                          int threads) {
    return guarded([&] {
        const octree::Layout layout{origin, cell, size, bricks, masks, firsts};
        const octree::Beams beams{origins, directions, nears, fars};
        const Raw known{raw, nullptr, 0};
        std::vector<std::vector<std::pair<int32_t, float>>> chunks(size_t((rays + RAYS - 1) / RAYS));
        for_ranges(threads, rays, RAYS, [&](int64_t begin, int64_t end) {
            std::vector<std::vector<Record::Part>> met(size_t(end - begin));
            Record record{known, 1 / cell, limit, {}, {}, met, begin};
            octree::Walk<Record>(layout, beams, record).run(begin, end);
            auto& found = chunks[size_t(begin / RAYS)];
            for (int64_t r = begin; r < end; r++) {
                float left = 1;
                for (const auto& part : met[size_t(r - begin)]) {
                    const float weight = left * -std::expm1(-known.depth(part.leaf) * part.length);
                    found.push_back({part.leaf, weight});
                    left -= weight;
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
