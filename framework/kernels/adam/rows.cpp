// Adam over listed rows of a table. See row_gradient.py, and adam.py for the formulas.
#include "adam/adam.h"

namespace {

constexpr int64_t ROWS = 1024, VALUES = 1 << 15;  // of a chunk, at most; a chunk has a row or more
constexpr int64_t AHEAD = 8;                      // rows that are fetched before they are used

// Arguments are by value and without aliases, so that the compiler uses whole vectors. A row has F values, or
// `features` if F is 0.
template <int F>
void update_row(float* __restrict p, float* __restrict m, float* __restrict v, const float* __restrict g, int features,
                float keep1, float add1, float keep2, float add2, float unbias2, float step, float eps) {
    const int count = F ? F : features;
    for (int f = 0; f < count; f++) {
        m[f] = keep1 * m[f] + add1 * g[f];
        v[f] = keep2 * v[f] + add2 * g[f] * g[f];
        p[f] -= step * m[f] / (std::sqrt(unbias2 * v[f]) + eps);
    }
}

template <int F>
void update_rows(float* values, float* mean, float* square, float* seen, const float* grad, const int32_t* rows,
                 int64_t count, int features, const adam::Settings& s, int threads) {
    const int64_t width = F ? F : features;
    for_ranges(threads, count, std::min(ROWS, std::max<int64_t>(VALUES / width, 1)), [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            if (F && i + AHEAD < end) {  // long rows are fetched by the processor itself
                const int64_t later = int64_t(rows[i + AHEAD]) * width;
                for (const float* from : {values + later, mean + later, square + later})
                    for (int f = 0; f < F; f += 16) __builtin_prefetch(from + f);
            }
            const float* g = grad + i * width;
            bool any = false;
            for (int64_t f = 0; f < width; f++) any |= g[f] != 0;
            if (!any) continue;
            const int64_t row = rows[i];
            const size_t k = s.index(seen[row] += 1);
            update_row<F>(values + row * width, mean + row * width, square + row * width, g, features, s.keep1, s.add1,
                          s.keep2, s.add2, s.unbias2[k], s.rate * s.unbias1[k], s.eps);
        }
    });
}

}  // namespace

// values, mean, square (E, F), seen (E): Adam on rows `rows` (T), each once, with the gradient grad (T, F).
EXPORT int adam_rows(float* values, float* mean, float* square, float* seen, const float* grad, const int32_t* rows,
                     int64_t count, int features, float rate, double beta1, double beta2, float eps, int threads) {
    return guarded([&] {
        if (features < 1) throw std::invalid_argument("a row has 1 value or more");
        const adam::Settings s(rate, beta1, beta2, eps);
        const auto run = features == 1    ? update_rows<1>
                         : features == 3  ? update_rows<3>
                         : features == 12 ? update_rows<12>
                         : features == 27 ? update_rows<27>
                         : features == 48 ? update_rows<48>
                                          : update_rows<0>;
        run(values, mean, square, seen, grad, rows, count, features, s, threads);
    });
}
