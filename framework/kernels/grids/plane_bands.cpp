// The mean squared difference of neighbours along each axis in bands of rows, summed over both axes. See
// plane_bands.py. `shapes` has for each band its first entry, its number of rows and the entries per row.
#include "runtime/common.h"

#include <algorithm>
#include <vector>

namespace {

struct Rows {
    int64_t first, rows, across;
    int64_t along(int features) const { return rows * (across - 1) * features; }  // differences along a row
    int64_t beside(int features) const { return (rows - 1) * across * features; }
};

inline Rows rows_of(const int64_t* shapes, int64_t band) {
    return {shapes[band * 3], shapes[band * 3 + 1], shapes[band * 3 + 2]};
}

double squared_differences(const float* a, const float* b, int64_t count) {
    Floats sums = splat(0);
    int64_t i = 0;
    for (; i + LANES <= count; i += LANES) {
        const Floats step = load(a + i) - load(b + i);
        sums += step * step;
    }
    double total = 0;
    for (int lane = 0; lane < LANES; lane++) total += sums[lane];
    for (; i < count; i++) total += double(a[i] - b[i]) * (a[i] - b[i]);
    return total;
}

// Adds weight * (a - b) to `to`.
inline void add_differences(const float* __restrict a, const float* __restrict b, int64_t count, float weight,
                            float* __restrict to) {
    for (int64_t i = 0; i < count; i++) to[i] += weight * (a[i] - b[i]);
}

// body(band, row, index of the row over all bands) for each row of each band, distributed over threads.
template <typename Body>
void for_rows(int threads, int bands, const int64_t* shapes, const Body& body) {
    std::vector<int64_t> ends;
    for (int band = 0; band < bands; band++)
        ends.push_back((ends.empty() ? 0 : ends.back()) + rows_of(shapes, band).rows);
    if (ends.empty()) return;
    for_each(threads, ends.back(), 4, [&](int64_t item) {
        const int64_t band = std::upper_bound(ends.begin(), ends.end(), item) - ends.begin();
        body(band, item - (ends[band] - rows_of(shapes, band).rows), item);
    });
}

}  // namespace

EXPORT int band_variation(const float* table, int features, int bands, const int64_t* shapes, float* found,
                          int threads) {
    return guarded([&] {
        int64_t count = 0;
        for (int band = 0; band < bands; band++) count += rows_of(shapes, band).rows;
        std::vector<double> sums(count);  // per row, so that the order of sums never changes
        for_rows(threads, bands, shapes, [&](int64_t band, int64_t row, int64_t item) {
            const Rows of = rows_of(shapes, band);
            const int64_t width = of.across * features;
            const float* here = table + of.first * features + row * width;
            double& sum = sums[item];
            if (of.across > 1)
                sum += squared_differences(here + features, here, width - features) / double(of.along(features));
            if (row + 1 < of.rows) sum += squared_differences(here + width, here, width) / double(of.beside(features));
        });
        int64_t item = 0;
        for (int band = 0; band < bands; band++) {
            double total = 0;
            for (int64_t row = 0; row < rows_of(shapes, band).rows; row++) total += sums[item++];
            found[band] = float(total);
        }
    });
}

// Adds to `table_grad`. Each row adds only to its own entries.
EXPORT int band_variation_backward(const float* table, int features, int bands, const int64_t* shapes,
                                   const float* grad, float* table_grad, int threads) {
    return guarded([&] {
        for_rows(threads, bands, shapes, [&](int64_t band, int64_t row, int64_t) {
            const Rows of = rows_of(shapes, band);
            const int64_t width = of.across * features, inner = width - features, at = of.first * features + row * width;
            const float* here = table + at;
            float* to = table_grad + at;
            if (of.across > 1) {
                const float weight = 2 * grad[band] / float(of.along(features));
                add_differences(here + features, here, inner, weight, to + features);
                add_differences(here + features, here, inner, -weight, to);
            }
            if (of.rows < 2) return;
            const float weight = 2 * grad[band] / float(of.beside(features));
            if (row > 0) add_differences(here, here - width, width, weight, to);
            if (row + 1 < of.rows) add_differences(here + width, here, width, -weight, to);
        });
    });
}
