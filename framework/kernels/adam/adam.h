// Adam on entries of a table, shared by adam.cpp and hash_grid.cpp. See adam.py for the formulas.
#pragma once

#include "runtime/common.h"

#include <algorithm>
#include <cmath>
#include <utility>
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
    std::vector<float> unbias1, unbias2;  // by the number of an entry's updates
    std::vector<uint64_t> unbias;         // the bits of both; the first moment's are the lower half
    float settled;                        // last index of both, where they are 1

    Settings(float rate, double beta1, double beta2, float eps)
        : keep1(float(beta1)), add1(float(1 - beta1)), keep2(float(beta2)), add2(float(1 - beta2)), rate(rate),
          eps(eps), unbias1(corrections(beta1)), unbias2(corrections(beta2)) {
        const size_t size = std::max(unbias1.size(), unbias2.size());
        unbias1.resize(size, 1.0f), unbias2.resize(size, 1.0f);
        settled = float(size - 1);
        for (size_t k = 0; k < size; k++) {
            uint32_t first, second;
            std::memcpy(&first, &unbias1[k], sizeof first);
            std::memcpy(&second, &unbias2[k], sizeof second);
            unbias.push_back(uint64_t(second) << 32 | first);
        }
    }
    size_t index(float updates) const { return size_t(updates < settled ? updates : settled); }
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

// Vector of 64-bit integers, one for each pair of lanes.
typedef uint64_t Longs __attribute__((vector_size(LANES * 4)));
typedef int32_t PairInts __attribute__((vector_size(LANES * 2)));
typedef float PairFloats __attribute__((vector_size(LANES * 2)));
constexpr int PAIRS = LANES / 2;

// value(0), value(1), ... assembled in a register: a load would wait for many small stores.
template <typename Vector, size_t... I, typename Value>
inline Vector each(std::index_sequence<I...>, const Value& value) { return Vector{value(I)...}; }

template <typename To, typename From>
inline To same_bits(From from) {
    static_assert(sizeof(To) == sizeof(From));
    To to;
    std::memcpy(&to, &from, sizeof to);
    return to;
}

// Which of LANES values belong to an entry of F values with a gradient.
template <int F>
inline Ints with_gradient(const float* grad) {
    if constexpr (F == 1) {
        return (same_bits<Ints>(load(grad)) & 0x7fffffff) != 0;
    } else if constexpr (F == 2) {
        return same_bits<Ints>((same_bits<Longs>(load(grad)) & 0x7fffffff7fffffff) != 0);
    } else {
        uint64_t any[LANES / F];
        for (int e = 0; e < LANES / F; e++) {
            uint64_t bits[F / 2], all = 0;
            std::memcpy(bits, grad + e * F, sizeof bits);
            for (int i = 0; i < F / 2; i++) all |= bits[i];
            any[e] = 0 - uint64_t((all & 0x7fffffff7fffffff) != 0);
        }
        return same_bits<Ints>(each<Longs>(std::make_index_sequence<PAIRS>(), [&](size_t i) { return any[i * 2 / F]; }));
    }
}

// Counts the updates of LANES / F entries and looks up the corrections of each of their values.
template <int F>
inline void count(Ints any, float* seen, Floats& unbias1, Floats& unbias2, const Settings& s) {
    if constexpr (F == 1) {
        const Floats updates = load(seen) - __builtin_convertvector(any, Floats);
        store(seen, updates);
        const Ints k = __builtin_convertvector(smaller(updates, splat(s.settled)), Ints);
        unbias1 = each<Floats>(std::make_index_sequence<LANES>(), [&](size_t i) { return s.unbias1[size_t(k[i])]; });
        unbias2 = each<Floats>(std::make_index_sequence<LANES>(), [&](size_t i) { return s.unbias2[size_t(k[i])]; });
    } else {
        const Longs used = same_bits<Longs>(any);
        Longs both;
        if constexpr (F == 2) {
            PairFloats updates;
            std::memcpy(&updates, seen, sizeof updates);
            updates -= __builtin_convertvector(__builtin_convertvector(used, PairInts), PairFloats);
            std::memcpy(seen, &updates, sizeof updates);
            const PairFloats last = PairFloats{} + s.settled;
            const PairInts k = __builtin_convertvector(updates < last ? updates : last, PairInts);
            both = each<Longs>(std::make_index_sequence<PAIRS>(), [&](size_t i) { return s.unbias[size_t(k[i])]; });
        } else {
            uint64_t found[LANES / F];
            for (int e = 0; e < LANES / F; e++) found[e] = s.unbias[s.index(seen[e] += float(int(used[e * F / 2] & 1)))];
            both = each<Longs>(std::make_index_sequence<PAIRS>(), [&](size_t i) { return found[i * 2 / F]; });
        }
        const Longs low = both & 0xffffffff, high = both ^ low;
        unbias1 = same_bits<Floats>(low | low << 32);
        unbias2 = same_bits<Floats>(high | high >> 32);
    }
}

// Whether all of LANES / F entries are past the correction, so that they need no individual look-up.
template <int F>
inline bool all_settled(const float* seen, const Settings& s) {
    bool settled = true;
    for (int e = 0; e < LANES / F; e++) settled &= seen[e] >= s.settled;
    return settled;
}

// LANES values, LANES / F entries; settled entries are not counted. Returns which of them had a gradient.
template <int F>
inline Ints update(float* values, float* mean, float* square, float* grad, float* seen, const Settings& s) {
    const Ints any = with_gradient<F>(grad);
    if (all_settled<F>(seen, s)) {
        move(values, mean, square, grad, any, 1.0f, 1.0f, s);
    } else {
        Floats unbias1, unbias2;
        count<F>(any, seen, unbias1, unbias2, s);
        move(values, mean, square, grad, any, unbias1, unbias2, s);
    }
    return any;
}

// Vector V of the values of LANES entries, F of each, if all values of an entry are alike.
template <int F, size_t V, typename Vector, size_t... I>
inline Vector of_entries(Vector x, std::index_sequence<I...>) {
#if defined(__clang__)
    return __builtin_shufflevector(x, x, int((V * LANES + I) / F)...);
#else
    return __builtin_shuffle(x, Ints{int32_t((V * LANES + I) / F)...});
#endif
}

// LANES entries of F values, which are F vectors; settled entries are not counted. Returns which had a gradient.
template <int F, size_t... V>
inline Ints update_entries(float* values, float* mean, float* square, float* grad, float* seen, const Settings& s,
                           std::index_sequence<V...>) {
    const auto lanes = std::make_index_sequence<LANES>();
    const Ints any = each<Ints>(lanes, [&](size_t e) {
        uint32_t bits[F], all = 0;
        std::memcpy(bits, grad + e * F, sizeof bits);
        for (int i = 0; i < F; i++) all |= bits[i];
        return -int32_t((all & 0x7fffffff) != 0);
    });
    Floats unbias1 = splat(1), unbias2 = splat(1);
    if (!all_settled<1>(seen, s)) count<1>(any, seen, unbias1, unbias2, s);
    (move(values + V * LANES, mean + V * LANES, square + V * LANES, grad + V * LANES, of_entries<F, V>(any, lanes),
          of_entries<F, V>(unbias1, lanes), of_entries<F, V>(unbias2, lanes), s),
     ...);
    return any;
}

// A single entry, if it has fewer than LANES values and is not among whole vectors of entries.
inline int update_entry(float* values, float* mean, float* square, float* grad, float* seen, int features,
                        const Settings& s) {
    bool any = false;
    for (int f = 0; f < features; f++) any |= grad[f] != 0;
    if (!any) return 0;
    const size_t k = s.index(seen[0] += 1);
    const float unbias1 = s.unbias1[k], unbias2 = s.unbias2[k];
    for (int f = 0; f < features; f++) {
        mean[f] = s.keep1 * mean[f] + s.add1 * grad[f];
        square[f] = s.keep2 * square[f] + s.add2 * grad[f] * grad[f];
        values[f] -= s.rate * unbias1 * mean[f] / (std::sqrt(unbias2 * square[f]) + s.eps);
        grad[f] = 0;
    }
    return 1;
}

// A single entry of LANES values or more. The last vector may begin within the one before it; a value moves once.
inline int update_row(float* values, float* mean, float* square, float* grad, float* seen, int features,
                      const Settings& s) {
    const int last = features - LANES;
    bool none = all_zero(grad + last);
    for (int i = 0; i < last; i += LANES) none &= all_zero(grad + i);
    if (none) return 0;
    const size_t k = s.index(seen[0] += 1);
    const float unbias1 = s.unbias1[k], unbias2 = s.unbias2[k];
    int i = 0;
    for (; i <= last; i += LANES) move(values + i, mean + i, square + i, grad + i, Ints{} - 1, unbias1, unbias2, s);
    if (i < features) {
        const Ints lane = each<Ints>(std::make_index_sequence<LANES>(), [](size_t of) { return int32_t(of); });
        move(values + last, mean + last, square + last, grad + last, lane >= i - last, unbias1, unbias2, s);
    }
    return 1;
}

// Entries [begin, end) in order. Returns the number with a gradient.
template <int F>
int64_t update_range(float* values, float* mean, float* square, float* grad, float* seen, int64_t begin, int64_t end,
                     int features, const Settings& s) {
    int64_t touched = 0, e = begin;
    Ints updates{};  // of each lane
    if constexpr (F > 0 && LANES % F == 0) {
        for (; e + LANES / F <= end; e += LANES / F) {
            const int64_t i = e * F;
            if (!all_zero(grad + i)) updates -= update<F>(values + i, mean + i, square + i, grad + i, seen + e, s);
        }
        for (int lane = 0; lane < LANES; lane += F) touched += updates[lane];
    } else if constexpr (F > 0) {
        for (; e + LANES <= end; e += LANES) {
            const int64_t i = e * F;
            bool none = true;
            for (int v = 0; v < F; v++) none &= all_zero(grad + i + v * LANES);
            if (!none)
                updates -= update_entries<F>(values + i, mean + i, square + i, grad + i, seen + e, s,
                                             std::make_index_sequence<F>());
        }
        for (int lane = 0; lane < LANES; lane++) touched += updates[lane];
    } else if (features >= LANES) {
        for (; e < end; e++) {
            const int64_t i = e * features;
            touched += update_row(values + i, mean + i, square + i, grad + i, seen + e, features, s);
        }
    }
    for (; e < end; e++) {
        const int64_t i = e * features;
        touched += update_entry(values + i, mean + i, square + i, grad + i, seen + e, features, s);
    }
    return touched;
}

}  // namespace adam
