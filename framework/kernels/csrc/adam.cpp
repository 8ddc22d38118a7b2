// Adam over the entries of a table that got a gradient. See ../adam.py for the reference and what is computed.
#include "adam.h"

namespace {

constexpr int64_t RUN = 4096;  // values that a thread looks at together

template <int F>
int64_t update_all(float* values, float* mean, float* square, float* grad, float* seen, int64_t entries, int features,
                   const adam::Settings& s, int threads) {
    const int64_t per_run = RUN / features, runs = (entries + per_run - 1) / per_run;
    int64_t touched = 0;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(+ : touched) if (threads > 1)
    for (int64_t run = 0; run < runs; run++) {
        const int64_t last = (run + 1) * per_run < entries ? (run + 1) * per_run : entries;
        touched += adam::update_range<F>(values, mean, square, grad, seen, run * per_run, last, features, s);
    }
    return touched;
}

}  // namespace

// Updates the entries with a gradient that is not zero, and sets that to zero. Returns how many there were.
// values, mean, square, grad (E, F); seen (E): how often an entry has been updated.
EXPORT int64_t adam_sparse(float* values, float* mean, float* square, float* grad, float* seen, int64_t entries,
                           int features, float rate, double beta1, double beta2, float eps, int threads) {
    const adam::Settings s(rate, beta1, beta2, eps);
    const auto run = features == 1   ? update_all<1>
                     : features == 2 ? update_all<2>
                     : features == 4 ? update_all<4>
                     : features == 8 ? update_all<8>
                                     : update_all<0>;
    return run(values, mean, square, grad, seen, entries, features, s, threads);
}

// Whether every value is finite. The sum of values times zero is NaN if any is not.
EXPORT int all_finite(const float* values, int64_t count, int threads) {
    int bad = 0;
    const int64_t runs = (count + RUN - 1) / RUN;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(+ : bad) if (threads > 1)
    for (int64_t run = 0; run < runs; run++) {
        const int64_t end = run * RUN + RUN < count ? run * RUN + RUN : count;
        float sum = 0;
        int64_t i = run * RUN;
        Floats sums = splat(0);
        for (; i + LANES <= end; i += LANES) sums += load(values + i) * 0;
        for (; i < end; i++) sum += values[i] * 0;
        for (int lane = 0; lane < LANES; lane++) sum += sums[lane];
        bad += sum != 0 || sum != sum;
    }
    return bad == 0;
}
