// Weights of a proposal along rays in one call. See proposals.py for the reference.
//
// A block of rays is placed, encoded, evaluated and weighted on one thread while it is in cache.
#include "grids/grid_density.h"
#include "histograms/interval_weights.h"

namespace {

constexpr int64_t SAMPLES = grid::CHUNK;  // in a block, about

}  // namespace

// Distances t (rays, bins + 1) along rays; the density in the middle of each interval is as in trace_rays. Writes
// weights (rays, bins). If these are null, it writes values for the backward pass: unit (N, 3), features (N, E),
// outputs (N, D) and density (N), with N = rays * bins.
EXPORT int proposal_weights(const float* origins, const float* directions, const float* t, int64_t rays, int64_t bins,
                            const float* scale, const float* shift, const float* around, const float* table, int features,
                            const int64_t* resolutions, const int64_t* offsets, int levels, const int64_t* widths,
                            int layers, const float* const* weights, int bf16, float* out, float* unit, float* encoded,
                            float* outputs, float* density, int threads) {
    return guarded([&] {
        if (bins < 1) throw std::invalid_argument("a ray without intervals");
        const Density of(scale, shift, around, table, features, resolutions, offsets, levels, widths, layers,
                         weights, bf16);
        const int64_t each = std::max<int64_t>(SAMPLES / bins, 1);
        for_chunks(threads, (rays + each - 1) / each, [&](int64_t block, int) {
            static thread_local std::vector<float> kept;
            const int64_t first = block * each, count = (std::min(rays, first + each) - first) * bins;
            float *at = unit, *found = encoded, *values = outputs, *sigma = density;
            if (out) {
                kept.resize(std::max(kept.size(), size_t(each * bins * (4 + of.inputs + of.width))));
                at = kept.data(), found = at + each * bins * 3, values = found + each * bins * of.inputs;
                sigma = values + each * bins * of.width;
            } else {
                const int64_t from = first * bins;
                at += from * 3, found += from * of.inputs, values += from * of.width, sigma += from;
            }
            for (int64_t n = 0; n < count; n++) {
                const int64_t r = first + n / bins;
                const float* start = t + first * (bins + 1) + n + n / bins;
                of.place(origins + r * 3, directions + r * 3, (start[0] + start[1]) / 2, at + n * 3);
            }
            of.evaluate(at, count, found, values, sigma, nullptr);
            if (!out) return;
            Weights weights_of(bins);
            for (int64_t n = 0; n < count; n += bins)
                weights_of.of_ray(sigma + n, t + (first + n / bins) * (bins + 1), out + first * bins + n);
        });
    });
}
