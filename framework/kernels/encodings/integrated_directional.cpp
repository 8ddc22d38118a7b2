// Integrated directional encoding. See integrated_directional.py for the reference and its recurrence.
#include "runtime/common.h"

#include <algorithm>
#include <cmath>

namespace {

constexpr int MAX_BANDS = 5, LAST = 16, MAX_FEATURES = 67;
constexpr float ROOT_OF_2 = 1.4142135623730951f;

// Constants of the recurrence, and slopes[l][m] with dP_l^m / dz = slopes[l][m] P_l^(m + 1).
struct Constants {
    float diagonal[LAST + 1], a[LAST + 1][LAST + 1], b[LAST + 1][LAST + 1], slopes[LAST + 1][LAST + 1];

    Constants() {
        double value = 0.28209479177387814;
        for (int l = 0; l <= LAST; l++) {
            if (l) value *= -std::sqrt((2.0 * l + 1) / (2.0 * l));
            diagonal[l] = float(value);
            const double square = double(l) * l, lower = double(l - 1) * (l - 1);
            for (int m = 0; m <= LAST; m++) {
                const double order = double(m) * m;
                a[l][m] = m < l ? float(std::sqrt((4 * square - 1) / (square - order))) : 0.0f;
                b[l][m] = m < l - 1 ? float(std::sqrt((lower - order) / (4 * lower - 1))) : 0.0f;
                slopes[l][m] = m < l ? -float(std::sqrt((l + m + 1.0) * (l - m))) : 0.0f;
            }
        }
    }
};

const Constants& constants() {
    static const Constants made;
    return made;
}

inline int last_degree(int bands) {
    if (bands < 1 || bands > MAX_BANDS) throw std::invalid_argument("a directional encoding has 1 to 5 bands");
    return 1 << (bands - 1);
}

inline int features_of(int last) {
    int count = 0;
    for (int l = 1; l <= last; l *= 2) count += 2 * l + 1;
    return count;
}

// LANES rows: coordinates, roughness, and the powers of x + i y. Rows beyond the last repeat it.
struct Block {
    Floats x, y, z, roughness, real[LAST + 1], imaginary[LAST + 1];

    Block(const float* directions, const float* rough, int64_t begin, int rows, int last) {
        float columns[4][LANES];
        for (int i = 0; i < LANES; i++) {
            const int64_t n = begin + std::min(i, rows - 1);
            for (int c = 0; c < 3; c++) columns[c][i] = directions[n * 3 + c];
            columns[3][i] = rough[n];
        }
        x = load(columns[0]), y = load(columns[1]), z = load(columns[2]), roughness = load(columns[3]);
        real[0] = splat(1.0f), imaginary[0] = splat(0.0f);
        for (int m = 1; m <= last; m++) {
            real[m] = x * real[m - 1] - y * imaginary[m - 1];
            imaginary[m] = x * imaginary[m - 1] + y * real[m - 1];
        }
    }
};

// Calls visit(l, P_l^0 ... P_l^l) for l = 1 to `last`.
template <typename F>
inline void legendre(Floats z, int last, F visit) {
    const Constants& k = constants();
    Floats rows[3][LAST + 2];
    Floats *before = rows[0], *row = rows[1], *next = rows[2];
    row[0] = splat(k.diagonal[0]);
    for (int l = 1; l <= last; l++) {
        before[l - 1] = splat(0.0f);
        for (int m = 0; m < l; m++) next[m] = k.a[l][m] * (z * row[m] - k.b[l][m] * before[m]);
        next[l] = splat(k.diagonal[l]);
        next[l + 1] = splat(0.0f);
        visit(l, next);
        Floats* oldest = before;
        before = row, row = next, next = oldest;
    }
}

inline bool has_band(int l) { return (l & (l - 1)) == 0; }

}  // namespace

// Rows of directions (N, 3) with roughness (N), `bands` bands.
EXPORT int directional_encoding(const float* directions, const float* roughness, int64_t count, int bands, float* out,
                                int threads) {
    return guarded([&] {
        const int last = last_degree(bands), width = features_of(last);
        for_ranges(threads, count, 512, [&](int64_t begin, int64_t end) {
            float values[MAX_FEATURES][LANES];
            for (int64_t n = begin; n < end; n += LANES) {
                const int rows = int(std::min<int64_t>(LANES, end - n));
                const Block block(directions, roughness, n, rows, last);
                int middle = 0;  // the feature of m = 0
                legendre(block.z, last, [&](int l, const Floats* row) {
                    if (!has_band(l)) return;
                    middle += l;
                    const Floats kept = exponential(block.roughness * (-0.5f * l * (l + 1)));
                    store(values[middle], kept * row[0]);
                    for (int m = 1; m <= l; m++) {
                        const Floats scaled = ROOT_OF_2 * kept * row[m];
                        store(values[middle - m], scaled * block.imaginary[m]);
                        store(values[middle + m], scaled * block.real[m]);
                    }
                    middle += l + 1;
                });
                for (int i = 0; i < rows; i++)
                    for (int f = 0; f < width; f++) out[(n + i) * width + f] = values[f][i];
            }
        });
    });
}

// The gradients of directions (N, 3) and roughness (N), from `grad` (N, width) of the rows.
EXPORT int directional_encoding_backward(const float* directions, const float* roughness, int64_t count, int bands,
                                         const float* grad, float* of_directions, float* of_roughness, int threads) {
    return guarded([&] {
        const int last = last_degree(bands), width = features_of(last);
        for_ranges(threads, count, 512, [&](int64_t begin, int64_t end) {
            float given[MAX_FEATURES][LANES], found[4][LANES];
            for (int64_t n = begin; n < end; n += LANES) {
                const int rows = int(std::min<int64_t>(LANES, end - n));
                const Block block(directions, roughness, n, rows, last);
                for (int i = 0; i < LANES; i++)
                    for (int f = 0; f < width; f++) given[f][i] = grad[(n + std::min(i, rows - 1)) * width + f];
                Floats gx{}, gy{}, gz{}, rough{};
                int middle = 0;
                legendre(block.z, last, [&](int l, const Floats* row) {
                    if (!has_band(l)) return;
                    middle += l;
                    const float rate = -0.5f * l * (l + 1);
                    const Floats kept = exponential(block.roughness * rate);
                    const float* slopes = constants().slopes[l];
                    Floats along = load(given[middle]), sum = along * row[0];  // gradient of P, and of the attenuation
                    gz += kept * along * slopes[0] * row[1];
                    for (int m = 1; m <= l; m++) {
                        const Floats re = ROOT_OF_2 * load(given[middle + m]), im = ROOT_OF_2 * load(given[middle - m]);
                        const Floats c = block.real[m - 1], s = block.imaginary[m - 1];
                        along = re * block.real[m] + im * block.imaginary[m];
                        sum += along * row[m];
                        gz += kept * along * slopes[m] * row[m + 1];
                        const Floats power = kept * row[m] * float(m);
                        gx += power * (re * c + im * s);
                        gy += power * (im * c - re * s);
                    }
                    rough += rate * kept * sum;
                    middle += l + 1;
                });
                store(found[0], gx), store(found[1], gy), store(found[2], gz), store(found[3], rough);
                for (int i = 0; i < rows; i++) {
                    for (int c = 0; c < 3; c++) of_directions[(n + i) * 3 + c] = found[c][i];
                    of_roughness[n + i] = found[3][i];
                }
            }
        });
    });
}
