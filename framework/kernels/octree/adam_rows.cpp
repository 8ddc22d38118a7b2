// Adam over listed rows of a table. See ../leaf_gradient.py; the formulas are those of adam/adam.py.
#include "adam/adam.h"

namespace {

constexpr int64_t ROWS = 1024;  // rows of a chunk
constexpr int64_t AHEAD = 8;    // rows that are fetched before they are used

// By value and without aliases, so that the compiler takes whole vectors.
template <int F>
void update_row(float* __restrict p, float* __restrict m, float* __restrict v, const float* __restrict g, float keep1,
                float add1, float keep2, float add2, float unbias2, float step, float eps) {
    for (int f = 0; f < F; f++) {
        m[f] = keep1 * m[f] + add1 * g[f];
        v[f] = keep2 * v[f] + add2 * g[f] * g[f];
        p[f] -= step * m[f] / (std::sqrt(unbias2 * v[f]) + eps);
    }
}

template <int F>
void update_rows(float* values, float* mean, float* square, float* seen, const float* grad, const int32_t* rows,
                 int64_t count, const adam::Settings& s, int threads) {
    for_ranges(threads, count, ROWS, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            if (i + AHEAD < end) {
                const int64_t later = int64_t(rows[i + AHEAD]) * F;
                for (const float* from : {values + later, mean + later, square + later})
                    for (int f = 0; f < F; f += 16) __builtin_prefetch(from + f);
            }
            const float* g = grad + i * F;
            bool any = false;
            for (int f = 0; f < F; f++) any |= g[f] != 0;
            if (!any) continue;
            const int64_t row = rows[i];
            const size_t k = s.index(seen[row] += 1);
            update_row<F>(values + row * F, mean + row * F, square + row * F, g, s.keep1, s.add1, s.keep2, s.add2,
                          s.unbias2[k], s.rate * s.unbias1[k], s.eps);
        }
    });
}

}  // namespace

// values, mean, square (L, F), seen (L): Adam on rows `rows` (T), each once, whose gradient is grad (T, F).
EXPORT int octree_adam(float* values, float* mean, float* square, float* seen, const float* grad, const int32_t* rows,
                       int64_t count, int features, float rate, double beta1, double beta2, float eps, int threads) {
    return guarded([&] {
        const adam::Settings s(rate, beta1, beta2, eps);
        const auto run = features == 1    ? update_rows<1>
                         : features == 3  ? update_rows<3>
                         : features == 12 ? update_rows<12>
                         : features == 27 ? update_rows<27>
                         : features == 48 ? update_rows<48>
                                          : nullptr;
        if (run == nullptr) throw std::invalid_argument("a leaf has 1, 3, 12, 27 or 48 values");
        run(values, mean, square, seen, grad, rows, count, s, threads);
    });
}
