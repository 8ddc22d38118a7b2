// Adam on entries of a table: what adam.cpp and hash_grid.cpp share. See ../adam.py for what is computed.
#pragma once

#include "common.h"

#include <cmath>
#include <vector>

namespace adam {


// 1 / (1 - beta^k) for k = 1, 2, ... until it is 1 in float32.
inline std::vector<float> corrections(double beta) {
    std::vector<float> out{1.0f};
    double power = beta;
    while (power > 1e-8 && out.size() < (1u << 24)) {
        out.push_back(float(1 / (1 - power)));
        power *= beta;
    }
    out.push_back(1.0f);
    return out;
}

inline bool all_zero(const float* values) {
    int32_t bits[LANES], any = 0;
    std::memcpy(bits, values, sizeof bits);
    for (int i = 0; i < LANES; i++) any |= bits[i];
    return (any & 0x7fffffff) == 0;
}

struct Settings {
    float keep1, add1, keep2, add2, rate, eps;
    std::vector<float> unbias1, unbias2;  // by how often an entry has been updated
    float settled;                        // updates after which both are 1

    Settings(float rate, double beta1, double beta2, float eps)
        : keep1(float(beta1)), add1(float(1 - beta1)), keep2(float(beta2)), add2(float(1 - beta2)), rate(rate),
          eps(eps), unbias1(corrections(beta1)), unbias2(corrections(beta2)),
          settled(float((unbias1.size() > unbias2.size() ? unbias1.size() : unbias2.size()) - 1)) {}
};

// Moves LANES values where `mask` is set; the gradient is cleared. Corrections may be 1 or vectors.
template <typename Factor>
inline void move(float* values, float* mean, float* square, float* grad, Ints mask, Factor unbias1, Factor unbias2,
                 const Settings& s) {
    const Floats g = load(grad), m0 = load(mean), v0 = load(square);
    const Floats m = s.keep1 * m0 + s.add1 * g, v = s.keep2 * v0 + s.add2 * g * g;
    alignas(64) float root[LANES];
    store(root, unbias2 * v);
    for (int i = 0; i < LANES; i++) root[i] = std::sqrt(root[i]);
    const Floats p = load(values), moved = p - s.rate * unbias1 * m / (load(root) + s.eps);
    store(values, mask ? moved : p);
    store(mean, mask ? m : m0);
    store(square, mask ? v : v0);
    store(grad, splat(0));
}

// LANES values, LANES / F entries. Returns how many of them had a gradient.
template <int F>
inline int update(float* values, float* mean, float* square, float* grad, float* seen, const Settings& s) {
    constexpr int ENTRIES = LANES / F;
    alignas(64) float unbias1[LANES], unbias2[LANES];
    alignas(64) int32_t used[LANES];
    int touched = 0;
    for (int e = 0; e < ENTRIES; e++) {
        bool any = false;
        for (int f = 0; f < F; f++) any |= grad[e * F + f] != 0;
        touched += any;
        const size_t k = size_t(seen[e] += float(any));
        for (int f = 0; f < F; f++) {
            used[e * F + f] = -int32_t(any);
            unbias1[e * F + f] = s.unbias1[k < s.unbias1.size() ? k : s.unbias1.size() - 1];
            unbias2[e * F + f] = s.unbias2[k < s.unbias2.size() ? k : s.unbias2.size() - 1];
        }
    }
    Ints mask;
    std::memcpy(&mask, used, sizeof mask);
    move(values, mean, square, grad, mask, load(unbias1), load(unbias2), s);
    return touched;
}

typedef int64_t Longs __attribute__((vector_size(LANES * 4)));

// Whether LANES / F entries, F being 1 or 2, are all past the correction: then they need no look at each by itself.
template <int F>
inline bool all_settled(const float* seen, const Settings& s) {
    bool settled = true;
    for (int e = 0; e < LANES / F; e++) settled &= seen[e] >= s.settled;
    return settled;
}

// As `update`, for settled entries, whose counts grow no more.
template <int F>
inline int update_settled(float* values, float* mean, float* square, float* grad, const Settings& s) {
    Ints mask;
    if constexpr (F == 2) {
        Longs pairs;
        std::memcpy(&pairs, grad, sizeof pairs);
        const Longs any = (pairs & 0x7fffffff7fffffff) != 0;
        std::memcpy(&mask, &any, sizeof mask);
    } else {
        std::memcpy(&mask, grad, sizeof mask);
        mask = (mask & 0x7fffffff) != 0;
    }
    move(values, mean, square, grad, mask, 1.0f, 1.0f, s);
    int touched = 0;
    for (int i = 0; i < LANES; i++) touched -= mask[i];
    return touched / F;
}

// A single entry, where fewer than LANES values are left or an entry has an odd number of features.
inline int update_entry(float* values, float* mean, float* square, float* grad, float* seen, int features,
                        const Settings& s) {
    bool any = false;
    for (int f = 0; f < features; f++) any |= grad[f] != 0;
    if (!any) return 0;
    const size_t k = size_t(seen[0] += 1);
    const float unbias1 = s.unbias1[k < s.unbias1.size() ? k : s.unbias1.size() - 1];
    const float unbias2 = s.unbias2[k < s.unbias2.size() ? k : s.unbias2.size() - 1];
    for (int f = 0; f < features; f++) {
        mean[f] = s.keep1 * mean[f] + s.add1 * grad[f];
        square[f] = s.keep2 * square[f] + s.add2 * grad[f] * grad[f];
        values[f] -= s.rate * unbias1 * mean[f] / (std::sqrt(unbias2 * square[f]) + s.eps);
        grad[f] = 0;
    }
    return 1;
}

// A single entry of whole vectors.
inline int update_row(float* values, float* mean, float* square, float* grad, float* seen, int features,
                      const Settings& s) {
    bool none = true;
    for (int i = 0; i < features; i += LANES) none &= all_zero(grad + i);
    if (none) return 0;
    const size_t k = size_t(seen[0] += 1);
    const float unbias1 = s.unbias1[k < s.unbias1.size() ? k : s.unbias1.size() - 1];
    const float unbias2 = s.unbias2[k < s.unbias2.size() ? k : s.unbias2.size() - 1];
    for (int i = 0; i < features; i += LANES)
        move(values + i, mean + i, square + i, grad + i, Ints{} - 1, unbias1, unbias2, s);
    return 1;
}

// Entries [begin, end) in order. Returns how many had a gradient.
template <int F>
int64_t update_range(float* values, float* mean, float* square, float* grad, float* seen, int64_t begin, int64_t end,
                     int features, const Settings& s) {
    int64_t touched = 0, e = begin;
    if constexpr (F > 0 && F <= LANES)
        for (; e + LANES / F <= end; e += LANES / F) {
            const int64_t i = e * F;
            if (all_zero(grad + i)) continue;
            if constexpr (F <= 2)
                if (all_settled<F>(seen + e, s)) {
                    touched += update_settled<F>(values + i, mean + i, square + i, grad + i, s);
                    continue;
                }
            touched += update<F>(values + i, mean + i, square + i, grad + i, seen + e, s);
        }
    for (; F == 0 && features % LANES == 0 && e < end; e++) {
        const int64_t i = e * features;
        touched += update_row(values + i, mean + i, square + i, grad + i, seen + e, features, s);
    }
    for (; e < end; e++) {
        const int64_t i = e * features;
        touched += update_entry(values + i, mean + i, square + i, grad + i, seen + e, features, s);
    }
    return touched;
}

}  // namespace adam
