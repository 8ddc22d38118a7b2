// Adam over the entries of a table that got a gradient. See adam.py for the reference and the formulas.
#include "adam/adam.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <vector>

namespace {

constexpr int64_t RUN = 16384;  // values that a thread tests together

template <int F>
int64_t update_all(float* values, float* mean, float* square, float* grad, float* seen, int64_t entries, int features,
                   const adam::Settings& s, int threads) {
    std::atomic<int64_t> touched{0};
    for_ranges(threads, entries, std::max<int64_t>(RUN / features, 1), [&](int64_t begin, int64_t end) {
        touched += adam::update_range<F>(values, mean, square, grad, seen, begin, end, features, s);
    });
    return touched;
}

// A separate function, because the compiler assumes that any store of a float may change a lambda's captures.
void update_dense(float* __restrict p, float* __restrict m, float* __restrict v, const float* __restrict g,
                  int64_t count, float step, float unbias, float add1, float keep2, float add2, float eps) {
    for (int64_t k = 0; k < count; k++) {
        m[k] += add1 * (g[k] - m[k]);
        v[k] = keep2 * v[k] + add2 * g[k] * g[k];
        p[k] -= step * m[k] / (std::sqrt(v[k]) * unbias + eps);
    }
}

}  // namespace

// Updates the entries with a nonzero gradient and sets the gradient to zero. `touched`: number of such entries. values,
// mean, square, grad (E, F); seen (E): number of updates of each entry.
EXPORT int adam_sparse(float* values, float* mean, float* square, float* grad, float* seen, int64_t entries,
                       int features, float rate, double beta1, double beta2, float eps, int threads,
                       int64_t* touched) {
    return guarded([&] {
        const adam::Settings s(rate, beta1, beta2, eps);
        const auto run = features == 1   ? update_all<1>
                         : features == 2 ? update_all<2>
                         : features == 3 ? update_all<3>
                         : features == 4 ? update_all<4>
                         : features == 8 ? update_all<8>
                                         : update_all<0>;
        *touched = run(values, mean, square, grad, seen, entries, features, s, threads);
    });
}

// Adam on every value of `tensors` tensors with counts[i] values each. steps[i]: number of updates, including this one.
EXPORT int adam_dense(float* const* values, float* const* mean, float* const* square, const float* const* grad,
                      const int64_t* counts, const double* steps, int tensors, float rate, double beta1, double beta2,
                      float eps, int threads) {
    return guarded([&] {
        const float add1 = float(1 - beta1), keep2 = float(beta2), add2 = float(1 - beta2);
        std::vector<int64_t> runs(size_t(tensors) + 1, 0);  // before each tensor
        for (int i = 0; i < tensors; i++) runs[size_t(i) + 1] = runs[size_t(i)] + (counts[i] + RUN - 1) / RUN;
        for_each(threads, runs.back(), 1, [&](int64_t run) {
            const size_t i = size_t(std::upper_bound(runs.begin(), runs.end(), run) - runs.begin() - 1);
            const int64_t begin = (run - runs[i]) * RUN, end = std::min(counts[i], begin + RUN);
            const float step = float(rate / (1 - std::pow(beta1, steps[i])));
            const float unbias = float(1 / std::sqrt(1 - std::pow(beta2, steps[i])));
            update_dense(values[i] + begin, mean[i] + begin, square[i] + begin, grad[i] + begin, end - begin, step,
                         unbias, add1, keep2, add2, eps);
        });
    });
}

// Whether all values are finite. The sum of values times zero is NaN if one is not.
EXPORT int all_finite(const float* values, int64_t count, int threads, int* finite) {
    return guarded([&] {
        std::atomic<bool> bad{false};
        for_ranges(threads, count, 4 * RUN, [&](int64_t i, int64_t end) {
            float sum = 0;
            Floats sums = splat(0);
            for (; i + LANES <= end; i += LANES) sums += load(values + i) * 0;
            for (; i < end; i++) sum += values[i] * 0;
            for (int lane = 0; lane < LANES; lane++) sum += sums[lane];
            if (sum != 0 || sum != sum) bad = true;
        });
        *finite = !bad;
    });
}
