// Histograms of rays in proposal sampling, and the contraction of space. See intervals.py and
// ../encodings/contraction.py for the references and the equations.
#include "encodings/contraction.h"
#include "histograms/interval_weights.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

// Weights (rays, bins) of densities (rays, bins) between distances (rays, bins + 1).
EXPORT int interval_weights(const float* sigma, const float* t, int64_t rays, int64_t bins, float* weights,
                            int threads) {
    return guarded([&] {
        for_ranges(threads, rays, 64, [&](int64_t begin, int64_t end) {
            Weights of(bins);
            for (int64_t r = begin; r < end; r++)
                of.of_ray(sigma + r * bins, t + r * (bins + 1), weights + r * bins);
        });
    });
}

// With g_i = dL/dw_i:  dL/dtau_i = g_i T_{i+1} - sum_{j > i} g_j w_j.
EXPORT int interval_weights_backward(const float* sigma, const float* t, const float* weights, const float* grad,
                                     int64_t rays, int64_t bins, float* sigma_grad, int threads) {
    return guarded([&] {
        for_each(threads, rays, 64, [&](int64_t r) {
            const float *s = sigma + r * bins, *edge = t + r * (bins + 1), *w = weights + r * bins, *g = grad + r * bins;
            float depth = 0, after = 0;
            for (int64_t i = 0; i < bins; i++) after += g[i] * w[i];
            for (int64_t i = 0; i < bins; i++) {
                const float delta = edge[i + 1] - edge[i];
                depth += optical_depth(s[i], delta);
                after -= g[i] * w[i];
                const float slope = depth_slope(s[i], delta);
                sigma_grad[r * bins + i] = slope == 0 ? 0 : slope * (g[i] * std::exp(-depth) - after);
            }
        });
    });
}

// count + 1 new edges per ray, at the quantiles (j + shift) / (count + 1) of the histogram with weights weight^power +
// padding.
EXPORT int resample_intervals(const float* edges, const float* weights, const float* shift, int64_t rays, int64_t bins,
                              int64_t count, float power, float padding, float* out, int threads) {
    return guarded([&] {
        if (bins < 1) throw std::invalid_argument("a histogram without bins");
        for_ranges(threads, rays, 64, [&](int64_t begin, int64_t end) {
            std::vector<double> cdf(bins + 1);
            for (int64_t r = begin; r < end; r++) {
                const float *w = weights + r * bins, *edge = edges + r * (bins + 1);
                cdf[0] = 0;
                for (int64_t i = 0; i < bins; i++)
                    cdf[i + 1] = cdf[i] + (power == 1 ? w[i] : std::pow(w[i], power)) + padding;
                const double total = cdf[bins];
                int64_t bin = 0;
                for (int64_t j = 0; j <= count; j++) {
                    const double u = total * (j + double(shift[r])) / (count + 1);
                    while (bin < bins - 1 && cdf[bin + 1] <= u) bin++;
                    const double width = cdf[bin + 1] - cdf[bin];
                    // Comparisons and the order of operands let NaN through, so that it appears in the edges.
                    const double share = width <= 0 ? 0.0 : std::min(std::max((u - cdf[bin]) / width, 0.0), 1.0);
                    out[r * (count + 1) + j] = float(edge[bin] + share * (double(edge[bin + 1]) - edge[bin]));
                }
            }
        });
    });
}

// Per ray sum_i max(0, w_i - bound_i)^2 / (w_i + eps), where bound_i is the weight of all proposed bins that touch
// interval i; and its gradient by the proposed weights.
EXPORT int proposal_excess(const float* edges, const float* weights, int64_t bins, const float* proposed_edges,
                           const float* proposed_weights, int64_t proposed_bins, int64_t rays, float eps, float* loss,
                           float* grad, int threads) {
    return guarded([&] {
        for_ranges(threads, rays, 64, [&](int64_t begin, int64_t last) {
            std::vector<double> sum(proposed_bins + 1), change(proposed_bins + 1);
            for (int64_t r = begin; r < last; r++) {
                const float *edge = edges + r * (bins + 1), *w = weights + r * bins;
                const float *p_edge = proposed_edges + r * (proposed_bins + 1), *p = proposed_weights + r * proposed_bins;
                sum[0] = 0;
                for (int64_t j = 0; j < proposed_bins; j++) sum[j + 1] = sum[j] + p[j];
                std::fill(change.begin(), change.end(), 0.0);
                int64_t first = 0, end = 0;
                double total = 0;
                for (int64_t i = 0; i < bins; i++) {
                    while (first < proposed_bins && p_edge[first + 1] < edge[i]) first++;
                    end = std::max(end, first);
                    while (end < proposed_bins && p_edge[end] <= edge[i + 1]) end++;
                    const double excess = w[i] - (sum[end] - sum[first]);
                    if (excess <= 0) continue;
                    const double scaled = excess / (double(w[i]) + eps);
                    total += excess * scaled;
                    change[first] -= 2 * scaled;
                    change[end] += 2 * scaled;
                }
                loss[r] = float(total);
                double running = 0;
                for (int64_t j = 0; j < proposed_bins; j++) {
                    running += change[j];
                    grad[r * proposed_bins + j] = float(running);
                }
            }
        });
    });
}

namespace {

float mix(float a, float b, float share) { return share < 0.5f ? a + share * (b - a) : b - (b - a) * (1 - share); }

float to_disparity(float t) { return t < 1 ? t / 2 : 1 - 1 / (2 * t); }

float from_disparity(float s) {
    constexpr float LEAST = std::numeric_limits<float>::epsilon();
    const float left = 2 - 2 * s;
    return s < 0.5f ? 2 * s : 1 / (left < LEAST ? LEAST : left);
}

}  // namespace

// Converts normalised distances (rays, count) between the near and the far end of each ray to distances: linear if
// scale is 0, otherwise in disparity beyond that distance. See spacing.py.
EXPORT int spaced_distances(const float* edges, const float* nears, const float* fars, int64_t rays, int64_t count,
                            float scale, float* out, int threads) {
    return guarded([&] {
        for_each(threads, rays, 256, [&](int64_t r) {
            const float *s = edges + r * count, near = nears[r], far = fars[r];
            float* t = out + r * count;
            if (scale == 0) {
                for (int64_t i = 0; i < count; i++) t[i] = mix(near, far, s[i]);
                return;
            }
            const float first = to_disparity(near / scale), last = to_disparity(far / scale);
            for (int64_t i = 0; i < count; i++) t[i] = scale * from_disparity(mix(first, last, s[i]));
        });
    });
}

// Positions (count, 3) to [0, 1]^3: those within half an edge of the centre are unchanged, all others contracted into
// the ball of radius 2.
EXPORT int contract_positions(const float* positions, const float* centre, const float* scale, int64_t count,
                              float* out, int threads) {
    return guarded([&] {
        for_each(threads, count, 4096, [&](int64_t n) {
            const Contracted x(positions + n * 3, centre, scale);
            x.write(out + n * 3);
        });
    });
}

// With n = max(1, |x|) and y = x s(n), s(n) = 2/n - 1/n^2:  J^T g = s g + x (x . g) s'(n) / n. The second term is 0 if
// n is 1.
EXPORT int contract_positions_backward(const float* positions, const float* centre, const float* scale,
                                       const float* grad, int64_t count, float* out, int threads) {
    return guarded([&] {
        for_each(threads, count, 4096, [&](int64_t n) {
            const Contracted x(positions + n * 3, centre, scale);
            const float* g = grad + n * 3;
            const float along = (x.place[0] * g[0] + x.place[1] * g[1] + x.place[2] * g[2]) / x.norm;
            const float radial = along * ((2 * x.unit / x.norm - 2) / (x.norm * x.norm));
            for (int c = 0; c < 3; c++)
                out[n * 3 + c] = 0.25f * scale[c] * x.unit * (x.factor * g[c] + radial * x.place[c]);
        });
    });
}
