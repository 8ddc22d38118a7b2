// Factorised features: look-ups in planes and lines, multiplied (K-Planes, TensoRF). See planes.py.
//
// An entry is a row of features, so that a corner takes one or two cache lines and every product is a whole vector.
#include "runtime/common.h"

#include <initializer_list>

namespace {

constexpr int MAX_PLANES = 6, MAX_DIMS = 4;

// Vectors of features: V is Floats, four floats or one, whichever divides the number of features.
typedef float Four __attribute__((vector_size(16)));
template <typename V>
inline V get(const float* from) {
    V out;
    std::memcpy(&out, from, sizeof out);
    return out;
}
template <typename V>
inline void put(float* to, V value) { std::memcpy(to, &value, sizeof value); }
template <typename V>
constexpr int size_of() { return int(sizeof(V) / sizeof(float)); }

struct Layout {
    int dims, features, scales, planes;
    const int64_t* axes;         // (scales, planes, 2) the two axes of each plane; for a line the second is -1
    const int64_t* resolutions;  // (scales, dims)
    const int64_t* offsets;      // (scales, planes) first entry

    Layout(int dims, int features, int scales, int planes, const int64_t* axes, const int64_t* resolutions,
           const int64_t* offsets)
        : dims(dims), features(features), scales(scales), planes(planes), axes(axes), resolutions(resolutions),
          offsets(offsets) {
        if (dims < 1 || dims > MAX_DIMS || planes < 1 || planes > MAX_PLANES || features < 1)
            throw std::invalid_argument("planes: 1 to 4 axes, 1 to 6 factors and 1 feature or more are what there can be");
    }
};

// The cell of a position on a plane: the entry of its first corner, and the fractions along both axes.
struct Place {
    int64_t first, up;  // `up`: entries to the next along the second axis, if any; along the first it is adjacent
    float a, b;
    float inside_a, inside_b;  // cells along the axis, or 0 if the position was clamped
};

inline void along(float x, int64_t resolution, int64_t& cell, float& fraction, float& inside) {
    const float cells = float(resolution - 1);
    const float clamped = x < 0 ? 0 : x > 1 ? 1 : x;
    const float scaled = clamped * cells;
    cell = scaled == scaled ? int64_t(scaled) : 0;
    if (cell > resolution - 2) cell = resolution - 2;
    fraction = scaled - float(cell);
    inside = x < 0 || x > 1 ? 0 : cells;
}

inline Place place(const Layout& layout, const float* x, int scale, int plane) {
    const int64_t* r = layout.resolutions + scale * layout.dims;
    const int64_t *axes = layout.axes + (scale * layout.planes + plane) * 2, one = axes[0], two = axes[1];
    int64_t i, j = 0;
    Place at{};
    along(x[one], r[one], i, at.a, at.inside_a);
    if (two >= 0) {
        along(x[two], r[two], j, at.b, at.inside_b);
        at.up = r[one];
    }
    at.first = layout.offsets[scale * layout.planes + plane] + j * at.up + i;
    return at;
}

inline void prefetch(const Layout& layout, const Place& at, const float* table) {
    const float* corner = table + at.first * layout.features;
    const int bytes = 2 * layout.features * int(sizeof(float));
    for (int line = 0; line < bytes; line += 64) {
        __builtin_prefetch((const char*)corner + line);
        __builtin_prefetch((const char*)(corner + at.up * layout.features) + line);
    }
}

template <typename V>
inline V blend(const Place& at, const float* corner, int features) {
    const float* above = corner + at.up * features;
    const V low = get<V>(corner) * (1 - at.a) + get<V>(corner + features) * at.a;
    const V high = get<V>(above) * (1 - at.a) + get<V>(above + features) * at.a;
    return low * (1 - at.b) + high * at.b;
}

template <typename V>
void forward(const Layout& layout, const float* positions, int64_t count, const float* table, float* out, int threads) {
    const int F = layout.features, P = layout.planes;
    const int64_t width = int64_t(layout.scales) * F;
    constexpr int64_t CHUNK = 512;  // samples processed together: a scale's planes stay in cache
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        for (int s = 0; s < layout.scales; s++) {
            Place at[2][MAX_PLANES];
            const auto find = [&](int64_t n, Place* found) {
                for (int p = 0; p < P; p++) {
                    found[p] = place(layout, positions + n * layout.dims, s, p);
                    prefetch(layout, found[p], table);
                }
            };
            find(begin, at[0]);
            for (int64_t n = begin, turn = 0; n < end; n++, turn ^= 1) {
                if (n + 1 < end) find(n + 1, at[turn ^ 1]);
                float* to = out + n * width + s * F;
                for (int c = 0; c < F; c += size_of<V>()) {
                    V product = blend<V>(at[turn][0], table + at[turn][0].first * F + c, F);
                    for (int p = 1; p < P; p++) product *= blend<V>(at[turn][p], table + at[turn][p].first * F + c, F);
                    put<V>(to + c, product);
                }
            }
        }
    });
}

// Values of all planes, and the incoming gradient times the product of all planes but each one.
template <typename V>
inline void factors(const Layout& layout, const Place* at, const float* table, int c, V grad, V* others) {
    const int P = layout.planes;
    if (P < 1) __builtin_unreachable();  // tells the compiler that a Layout has one or more
    V value[MAX_PLANES];
    for (int p = 0; p < P; p++) value[p] = blend<V>(at[p], table + at[p].first * layout.features + c, layout.features);
    V before = grad;
    for (int p = 0; p < P; p++) {
        others[p] = before;
        before *= value[p];
    }
    V after = value[P - 1];
    for (int p = P - 2; p >= 0; p--) {
        others[p] *= after;
        after *= value[p];
    }
}

template <typename V>
inline void scatter(const Place& at, float* corner, int features, V grad) {
    float* above = corner + at.up * features;
    const V low = grad * (1 - at.b), high = grad * at.b;
    put<V>(corner, get<V>(corner) + low * (1 - at.a));
    put<V>(corner + features, get<V>(corner + features) + low * at.a);
    put<V>(above, get<V>(above) + high * (1 - at.a));
    put<V>(above + features, get<V>(above + features) + high * at.a);
}

// The next sample from n on with a gradient; its vectors are `width` apart. end if there is none.
template <typename V>
inline int64_t next_live(const float* grad, int64_t width, int64_t n, int64_t end) {
    for (; n < end; n++) {
        uint32_t any = 0, bits;
        for (int i = 0; i < size_of<V>(); i++) {
            std::memcpy(&bits, grad + n * width + i, sizeof bits);
            any |= bits;
        }
        if (any & 0x7fffffff) break;  // a zero has a sign
    }
    return n;
}

// Scales and vectors of features are distributed over threads, so that no two write to the same location and the order
// of sums never changes.
template <typename V>
void backward_table(const Layout& layout, const float* positions, int64_t count, const float* table, const float* grad,
                    float* table_grad, int threads) {
    const int F = layout.features, P = layout.planes, lanes = size_of<V>();
    const int parts = F / lanes, units = layout.scales * parts;
    const int64_t width = int64_t(layout.scales) * F;
    for_each(threads, units, 1, [&](int64_t unit) {
        const int s = layout.scales - 1 - int(unit) / parts, c = int(unit) % parts * lanes;  // slowest first
        Place at[2][MAX_PLANES];
        const auto find = [&](int64_t n, Place* found) {
            for (int p = 0; p < P; p++) {
                found[p] = place(layout, positions + n * layout.dims, s, p);
                const int64_t first = found[p].first * F + c, above = first + found[p].up * F;
                for (const float* of : {table, (const float*)table_grad})
                    for (const int64_t i : {first, first + F, above, above + F}) __builtin_prefetch(of + i);
            }
        };
        const float* own = grad + s * F + c;
        int64_t n = next_live<V>(own, width, 0, count), next = n;
        if (n < count) find(n, at[0]);
        for (int64_t turn = 0; n < count; n = next, turn ^= 1) {
            next = next_live<V>(own, width, n + 1, count);
            if (next < count) find(next, at[turn ^ 1]);
            V others[MAX_PLANES];
            factors<V>(layout, at[turn], table, c, get<V>(own + n * width), others);
            for (int p = 0; p < P; p++) scatter<V>(at[turn][p], table_grad + at[turn][p].first * F + c, F, others[p]);
        }
    });
}

template <typename V>
void backward_positions(const Layout& layout, const float* positions, int64_t count, const float* table,
                        const float* grad, float* positions_grad, int threads) {
    const int F = layout.features, P = layout.planes, D = layout.dims;
    const int64_t width = int64_t(layout.scales) * F;
    for_each(threads, count, 256, [&](int64_t n) {
        float sums[MAX_DIMS] = {};
        for (int s = 0; s < layout.scales; s++) {
            Place at[MAX_PLANES];
            for (int p = 0; p < P; p++) at[p] = place(layout, positions + n * D, s, p);
            for (int c = 0; c < F; c += size_of<V>()) {
                V others[MAX_PLANES];
                factors<V>(layout, at, table, c, get<V>(grad + n * width + s * F + c), others);
                for (int p = 0; p < P; p++) {
                    const float *low = table + at[p].first * F + c, *high = low + at[p].up * F;
                    const V da = (get<V>(low + F) - get<V>(low)) * (1 - at[p].b) +
                                 (get<V>(high + F) - get<V>(high)) * at[p].b;
                    const V db = (get<V>(high) - get<V>(low)) * (1 - at[p].a) +
                                 (get<V>(high + F) - get<V>(low + F)) * at[p].a;
                    float along_a[size_of<V>()], along_b[size_of<V>()];
                    put<V>(along_a, da * others[p]);
                    put<V>(along_b, db * others[p]);
                    float a = 0, b = 0;
                    for (int i = 0; i < size_of<V>(); i++) {
                        a += along_a[i];
                        b += along_b[i];
                    }
                    const int64_t* axes = layout.axes + (s * P + p) * 2;
                    sums[axes[0]] += a * at[p].inside_a;
                    if (axes[1] >= 0) sums[axes[1]] += b * at[p].inside_b;
                }
            }
        }
        std::memcpy(positions_grad + n * D, sums, sizeof(float) * D);
    });
}

}  // namespace

#define FOR_FEATURES(call)                         \
    if (features % LANES == 0) call(Floats);       \
    else if (features % 4 == 0) call(Four);        \
    else call(float)

EXPORT int planes_forward(const float* positions, int64_t count, const float* table, int dims, int features,
                          int scales, int planes, const int64_t* axes, const int64_t* resolutions,
                          const int64_t* offsets, float* out, int threads) {
    return guarded([&] {
        const Layout layout(dims, features, scales, planes, axes, resolutions, offsets);
#define CALL(V) forward<V>(layout, positions, count, table, out, threads)
        FOR_FEATURES(CALL);
#undef CALL
    });
}

// Adds to `table_grad`.
EXPORT int planes_backward_table(const float* positions, int64_t count, const float* table, int dims, int features,
                                 int scales, int planes, const int64_t* axes, const int64_t* resolutions,
                                 const int64_t* offsets, const float* grad, float* table_grad, int threads) {
    return guarded([&] {
        const Layout layout(dims, features, scales, planes, axes, resolutions, offsets);
#define CALL(V) backward_table<V>(layout, positions, count, table, grad, table_grad, threads)
        FOR_FEATURES(CALL);
#undef CALL
    });
}

EXPORT int planes_backward_positions(const float* positions, int64_t count, const float* table, int dims,
                                     int features, int scales, int planes, const int64_t* axes,
                                     const int64_t* resolutions, const int64_t* offsets, const float* grad,
                                     float* positions_grad, int threads) {
    return guarded([&] {
        const Layout layout(dims, features, scales, planes, axes, resolutions, offsets);
#define CALL(V) backward_positions<V>(layout, positions, count, table, grad, positions_grad, threads)
        FOR_FEATURES(CALL);
#undef CALL
    });
}
