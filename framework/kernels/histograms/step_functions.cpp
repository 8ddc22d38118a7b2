// The anti-aliased loss of proposals, on blurred step functions (Zip-NeRF). See step_functions.py for the reference.
#include "runtime/common.h"

#include <stdexcept>
#include <vector>

namespace {

// The second integral D of a ray's step function, from the left: quadratic within each bin and linear after the last.
// Blurring with a box of half-width r gives the first integral (D(x + r) - D(x - r)) / (2 r) at x. In double precision,
// so that the difference keeps enough digits.
struct SecondIntegral {
    int64_t bins;
    const float* edge;
    std::vector<double> mass, area, slope;  // at the start of each bin, and in it

    explicit SecondIntegral(int64_t bins) : bins(bins), edge(nullptr), mass(bins + 1), area(bins + 1), slope(bins) {}

    void set(const float* edges, const float* weights) {
        edge = edges;
        mass[0] = area[0] = 0;
        for (int64_t i = 0; i < bins; i++) {
            const double width = double(edges[i + 1]) - edges[i];
            mass[i + 1] = mass[i] + weights[i];
            area[i + 1] = area[i] + 0.5 * (mass[i] + mass[i + 1]) * width;
            slope[i] = width > 0 ? weights[i] / width : 0.0;
        }
    }
    // Its value at x. `bin` is the start of the search; x must not be less than in the previous call with the same
    // `bin`.
    double at(double x, int64_t& bin) const {
        while (bin < bins && edge[bin + 1] < x) bin++;
        const double past = x - edge[bin];
        if (bin == bins) return area[bins] + mass[bins] * past;
        return past <= 0 && bin == 0 ? 0.0 : area[bin] + past * (mass[bin] + 0.5 * slope[bin] * past);
    }
};

}  // namespace

// Per ray sum_i max(0, b_i - p_i)^2 / (p_i + eps), where b_i is the weight in proposed bin i of the blurred histogram
// and p_i the proposed weight; and its gradient with respect to the proposed weights.
EXPORT int blurred_excess(const float* edges, const float* weights, int64_t bins, const float* proposed_edges,
                          const float* proposed_weights, int64_t proposed_bins, int64_t rays, double radius, float eps,
                          float* loss, float* grad, int threads) {
    return guarded([&] {
        if (bins < 1) throw std::invalid_argument("a histogram without bins");
        for_ranges(threads, rays, 64, [&](int64_t begin, int64_t end) {
            SecondIntegral integral(bins);
            for (int64_t r = begin; r < end; r++) {
                integral.set(edges + r * (bins + 1), weights + r * bins);
                const float *edge = proposed_edges + r * (proposed_bins + 1), *p = proposed_weights + r * proposed_bins;
                int64_t behind = 0, ahead = 0;
                double before = 0, total = 0;
                for (int64_t i = 0; i <= proposed_bins; i++) {
                    const double x = edge[i];
                    const double low = integral.at(x - radius, behind), high = integral.at(x + radius, ahead);
                    const double here = (high - low) / (2 * radius);
                    if (i > 0) {
                        const double excess = here - before - p[i - 1], divisor = double(p[i - 1]) + eps;
                        const bool none = excess <= 0;  // NaN stays
                        total += none ? 0.0 : excess * excess / divisor;
                        grad[r * proposed_bins + i - 1] =
                            none ? 0.0f : float(-excess / divisor * (2 + excess / divisor));
                    }
                    before = here;
                }
                loss[r] = float(total);
            }
        });
    });
}
