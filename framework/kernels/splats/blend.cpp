// Blending the Gaussians of each tile from front to back, forward and backward. See blend.py.
//
// A tile of TILE x TILE pixels consists of blocks of LANES pixels, 4 across: a vector holds a block. For each Gaussian
// of the tile's list, only the blocks that its ellipse meets are evaluated. They are found for TOGETHER entries before
// these are blended: the loop over an entry's blocks then depends on memory alone, so that the processor goes on to the
// next entries while it waits for square roots and quotients. The backward pass takes the blocks of the forward pass.
#include "splats/splat.h"

#include <algorithm>

namespace {

constexpr int ACROSS = 4, DOWN = LANES / ACROSS;  // pixels of a block
constexpr int COLUMNS = TILE / ACROSS, ROWS = TILE / DOWN, BLOCKS = COLUMNS * ROWS;
constexpr int64_t TOGETHER = 32;
constexpr int64_t AHEAD = 8;  // entries that are fetched ahead of their use

#if defined(__AVX512F__)
// 2^x for x in [-126, 0], to 2 units in the last place: 2^(k / 16) of the nearest sixteenth from a table in a register,
// times a polynomial of the remainder.
inline Floats power_of_two(Floats x) {
    const __m512 table = _mm512_setr_ps(1.0f, 1.04427378f, 1.09050773f, 1.13878863f, 1.18920712f, 1.24185781f, 1.29683955f,
                                        1.35425555f, 1.41421356f, 1.47682615f, 1.54221083f, 1.61049033f, 1.68179283f,
                                        1.75625216f, 1.83400809f, 1.91520656f);
    const Floats shift = splat(786432.0f), shifted = x + shift;  // 1.5 * 2^19: its last bits count sixteenths
    const Floats nearest = shifted - shift, f = x - nearest;
    Floats p = splat(5.550410866e-2f);
    p = p * f + 2.402265070e-1f;
    p = p * f + 6.931471806e-1f;
    p = p * f + 1.0f;
    p *= (Floats)_mm512_permutexvar_ps(_mm512_castps_si512((__m512)shifted), table);
    return (Floats)_mm512_scalef_ps((__m512)p, (__m512)nearest);  // rounds `nearest` down
}
#else
// 2^x for x in [-126, 0], to 2 units in the last place; Cephes' exp2f.
inline Floats power_of_two(Floats x) {
    const Ints n = __builtin_convertvector(x - 0.5f, Ints);  // rounds towards 0, which is up
    const Floats f = x - __builtin_convertvector(n, Floats);
    Floats p = splat(1.535336188319500e-4f);
    p = p * f + 1.339887440266574e-3f;
    p = p * f + 9.618437357674640e-3f;
    p = p * f + 5.550332471162809e-2f;
    p = p * f + 2.402264791363012e-1f;
    p = p * f + 6.931472028550421e-1f;
    p = p * f + 1.0f;
    Ints bits;
    std::memcpy(&bits, &p, sizeof bits);
    bits += n << 23;
    std::memcpy(&p, &bits, sizeof p);
    return p;
}
#endif

// The lanes where a comparison holds, among the lanes of `within`. AVX-512 has registers of bits for them; compilers
// make vectors of whole lanes of comparisons that are combined.
#if defined(__AVX512F__)
typedef __mmask16 Mask;
constexpr Mask EVERYWHERE = 0xffff;
inline Mask less(Floats a, Floats b, Mask within = EVERYWHERE) {
    return _mm512_mask_cmp_ps_mask(within, (__m512)a, (__m512)b, _CMP_LT_OQ);
}
inline Mask at_most(Floats a, Floats b, Mask within = EVERYWHERE) {
    return _mm512_mask_cmp_ps_mask(within, (__m512)a, (__m512)b, _CMP_LE_OQ);
}
inline Floats where(Mask mask, Floats value) { return (Floats)_mm512_maskz_mov_ps(mask, (__m512)value); }
inline uint64_t bits(Mask mask) { return mask; }
#else
typedef Ints Mask;
inline Mask less(Floats a, Floats b) { return a < b; }
inline Mask less(Floats a, Floats b, Mask within) { return (a < b) & within; }
inline Mask at_most(Floats a, Floats b) { return a <= b; }
inline Mask at_most(Floats a, Floats b, Mask within) { return (a <= b) & within; }
inline Floats where(Mask mask, Floats value) { return mask ? value : splat(0); }
inline uint64_t bits(Mask mask) {
#if defined(__AVX__)
    return uint32_t(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
    return uint32_t(_mm_movemask_ps((__m128)mask));
#else
    uint64_t set = 0;
    for (int i = 0; i < LANES; i++) set |= uint64_t(mask[i] & 1) << i;
    return set;
#endif
}
#endif

// Whether a pixel of a block lets light through, which is usual: as a branch, so that no later entry waits for it.
inline bool lets_through(Floats through) {
    return __builtin_expect_with_probability(bits(at_most(splat(OPAQUE), through)) != 0, true, 0.999);
}

// Blocks of a tile: bit TILE c + r is set for the block in column c that starts at row r of pixels.
typedef uint64_t Blocks;
static_assert(COLUMNS * TILE == 64, "a tile's blocks have a bit each");
constexpr Blocks FIRST_ROWS = ~Blocks(0) / ((Blocks(1) << DOWN) - 1);

// Bit b * DOWN stands for block `b`: column b / ROWS, first row of pixels b % ROWS * DOWN.
inline int first_of(Blocks blocks) { return __builtin_ctzll(blocks) / DOWN; }
inline Blocks only(int b) { return Blocks(1) << (b * DOWN); }

// Offsets of a tile's pixels from its first.
struct Offsets {
    Floats x[BLOCKS], y[BLOCKS];
    Offsets() {
        for (int b = 0; b < BLOCKS; b++) {
            float across[LANES], down[LANES];
            for (int i = 0; i < LANES; i++) {
                across[i] = float(b / ROWS * ACROSS + i % ACROSS);
                down[i] = float(b % ROWS * DOWN + i / ACROSS);
            }
            x[b] = load(across), y[b] = load(down);
        }
    }
};

const Offsets& offsets_in_tile() {
    static const Offsets offsets;
    return offsets;
}

constexpr float LOG2_E = 1.44269504f;

struct Tile {
    int left, top, width, height;  // of its first pixel, and of the image
    Tile(int64_t tile, int columns, int width, int height)
        : left(int(tile % columns) * TILE), top(int(tile / columns) * TILE), width(width), height(height) {}

    // Calls `body` with each block's number, lane and pixel of the image.
    template <typename Body>
    void for_pixels(const Body& body) const {
        const bool whole = left + TILE <= width && top + TILE <= height;
        for (int b = 0; b < BLOCKS; b++) {
            const int x = left + b / ROWS * ACROSS, y = top + b % ROWS * DOWN;
            const int64_t first = int64_t(y) * width + x;
            for (int i = 0; i < LANES; i++)
                if (whole || (x + i % ACROSS < width && y + i / ACROSS < height))
                    body(b, i, first + i / ACROSS * int64_t(width) + i % ACROSS);
        }
    }
    // Copies between planes of blocks and an image (height, width, CHANNELS).
    template <int CHANNELS>
    void read(const float* image, Floats (*planes)[BLOCKS]) const {
        alignas(64) float lanes[CHANNELS][BLOCKS][LANES] = {};
        for_pixels([&](int b, int i, int64_t pixel) {
            for (int c = 0; c < CHANNELS; c++) lanes[c][b][i] = image[pixel * CHANNELS + c];
        });
        std::memcpy(planes, lanes, sizeof lanes);
    }
    template <int CHANNELS>
    void write(float* image, const Floats (*planes)[BLOCKS]) const {
        alignas(64) float lanes[CHANNELS][BLOCKS][LANES];
        std::memcpy(lanes, planes, sizeof lanes);
        for_pixels([&](int b, int i, int64_t pixel) {
            for (int c = 0; c < CHANNELS; c++) image[pixel * CHANNELS + c] = lanes[c][b][i];
        });
    }
    // Sets transmittance at the start, where pixels beyond the image's edge are opaque; returns the blocks that are not.
    Blocks clear(Floats* through) const {
        alignas(64) float lanes[BLOCKS][LANES] = {};
        for_pixels([&](int b, int i, int64_t) { lanes[b][i] = 1; });
        std::memcpy(through, lanes, sizeof lanes);
        Blocks alive = 0;
        for (int b = 0; b < BLOCKS; b++)
            if (bits(less(splat(0), through[b]))) alive |= only(b);
        return alive;
    }
};

// The blocks where a Gaussian reaches the centre of a pixel, and perhaps neighbouring ones.
struct Reach {
    Floats rows[TILE / LANES];  // of the tile's pixels
    Reach() {
        float numbers[TILE];
        for (int i = 0; i < TILE; i++) numbers[i] = float(i);
        for (int v = 0; v < TILE / LANES; v++) rows[v] = load(numbers + v * LANES);
    }
    Blocks blocks(const Tile& tile, const float* g) const {
        const float x = tile.left + 0.5f - g[X], y = tile.top + 0.5f - g[Y], width = 1 / g[U_X], lean = g[U_Y] * width;
        Blocks met = 0;
        for (int v = 0; v < TILE / LANES; v++) {
            // A row meets the ellipse from `first` to `last`, which are counted in pixels from the tile's first.
            const Floats dy = rows[v] + y, of_v = g[V_Y] * dy, rest = g[CUT] - of_v * of_v;
            const Floats middle = -lean * dy - x, rounding = magnitude(middle) * 1e-6f + 0.01f;
            const Floats half = square_root(larger(rest, splat(0))) * width + rounding;
            const Floats first = middle - half, last = middle + half;
            const Mask rows_met = less(splat(0), rest);
            for (int c = 0; c < COLUMNS; c++) {
                const Mask begun = at_most(first, splat(c * ACROSS + ACROSS - 1), rows_met);
                met |= bits(at_most(splat(c * ACROSS), last, begun)) << (c * TILE + v * LANES);
            }
        }
        for (int down = 1; down < DOWN; down *= 2) met |= met >> down;  // a block has all that its rows have
        return met & FIRST_ROWS;
    }
};

// One Gaussian at the pixels of a tile.
struct Shape {
    float x, y;  // of the tile's first pixel's centre, from the Gaussian's
    float u_x, u_y, v_y, cut, opacity;
    Shape(const Tile& tile, const float* g)
        : x(tile.left + 0.5f - g[X]), y(tile.top + 0.5f - g[Y]), u_x(g[U_X]), u_y(g[U_Y]), v_y(g[V_Y]), cut(g[CUT]),
          opacity(g[OPACITY]) {}
    // Where the offset from the tile's first pixel is (across, down).
    Floats u(Floats across, Floats down) const { return u_x * (across + x) + u_y * (down + y); }
    Floats v(Floats down) const { return v_y * (down + y); }
    // Alpha from q = u^2 + v^2.
    Floats alpha(Floats q) const { return opacity * power_of_two(smaller(q, splat(80)) * -LOG2_E); }
};

// Unless `blended` is null, it gets the blocks of each entry that is used.
template <int CHANNELS>
void forward_tile(const Tile& tile, const float* records, const int32_t* ids, int64_t entries, const float* background,
                  float* image, float* through_image, float* median_image, Blocks* blended, int32_t* used) {
    alignas(64) Floats sum[CHANNELS][BLOCKS] = {}, through[BLOCKS], median[BLOCKS] = {};
    const Offsets& offset = offsets_in_tile();
    const Reach reach;
    Blocks alive = tile.clear(through), met[TOGETHER];
    int64_t n = 0;
    while (n < entries && alive) {
        const int64_t first = n, end = std::min(entries, first + TOGETHER);
        for (int64_t i = first; i < end; i++) {
            if (i + AHEAD < entries) __builtin_prefetch(records + int64_t(ids[i + AHEAD]) * RECORD);
            met[i - first] = reach.blocks(tile, records + int64_t(ids[i]) * RECORD);
        }
        for (; n < end && alive; n++) {
            const float* g = records + int64_t(ids[n]) * RECORD;
            const Shape shape(tile, g);
            Blocks rest = met[n - first] & alive;
            if (blended) blended[n] = rest;
            for (; rest; rest &= rest - 1) {
                const int b = first_of(rest);
                const Floats u = shape.u(offset.x[b], offset.y[b]), v = shape.v(offset.y[b]);
                const Floats q = u * u + v * v, before = through[b];
                const Mask inside = at_most(splat(OPAQUE), before, less(q, splat(shape.cut)));
                const Floats alpha = smaller(shape.alpha(q), splat(MAX_ALPHA));
                const Floats weight = where(inside, alpha * before), after = before - weight;
                for (int c = 0; c < CHANNELS; c++) sum[c][b] += weight * g[RED + c];
                if (median_image) median[b] = ((before > 0.5f) & (after <= 0.5f)) ? splat(g[DISTANCE]) : median[b];
                through[b] = after;
                if (!lets_through(after)) alive &= ~only(b);
            }
        }
    }
    *used = int32_t(n);
    for (int c = 0; c < 3; c++)
        for (int b = 0; b < BLOCKS; b++) sum[c][b] += through[b] * background[c];
    tile.write<CHANNELS>(image, sum);
    tile.write<1>(through_image, &through);
    if (median_image) tile.write<1>(median_image, &median);
}

#if defined(__clang__)
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, Ints{__VA_ARGS__})
#endif

// The sums of the lanes of each of RECORD vectors: halves of the vectors, of their halves, and so on.
inline void sum_lanes(const Floats* v, float* out) {
#if defined(__AVX512F__)
    Floats w[8];
    for (int i = 0; i < 8; i++)
        w[i] = SHUFFLE(v[i], v[i + 8], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
               SHUFFLE(v[i], v[i + 8], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    for (int i = 0; i < 4; i++)
        w[i] = SHUFFLE(w[i], w[i + 4], 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
               SHUFFLE(w[i], w[i + 4], 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    for (int i = 0; i < 2; i++)
        w[i] = SHUFFLE(w[i], w[i + 2], 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
               SHUFFLE(w[i], w[i + 2], 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    const Floats last = SHUFFLE(w[0], w[1], 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30) +
                        SHUFFLE(w[0], w[1], 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
    // Lane 8 i + 4 j + 2 k + l holds the sum of vector 8 i + 4 j + 2 k + l.
    store(out, last);
#elif defined(__AVX2__)
    for (int half = 0; half < RECORD; half += 8, v += 8) {
        Floats w[4];
        for (int i = 0; i < 4; i++)
            w[i] = SHUFFLE(v[i], v[i + 4], 0, 1, 2, 3, 8, 9, 10, 11) + SHUFFLE(v[i], v[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
        for (int i = 0; i < 2; i++)
            w[i] = SHUFFLE(w[i], w[i + 2], 0, 1, 8, 9, 4, 5, 12, 13) + SHUFFLE(w[i], w[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        store(out + half, SHUFFLE(w[0], w[1], 0, 8, 2, 10, 4, 12, 6, 14) + SHUFFLE(w[0], w[1], 1, 9, 3, 11, 5, 13, 7, 15));
    }
#else
    for (int k = 0; k < RECORD; k++) {
        float lanes[LANES], sum = 0;
        store(lanes, v[k]);
        for (int i = 0; i < LANES; i++) sum += lanes[i];
        out[k] = sum;
    }
#endif
}

// Slots of the sums over a Gaussian's pixels that have no name among the record's: of the exponent's gradient, of its
// products with u and v, and of the magnitudes of the centre's gradients, which splat_gather multiplies by 2 U_X and 2.
// u and v are of the order of 1, so that thin Gaussians lose no digits, as they would in moments of the offsets.
enum Sums { SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_G, ABSOLUTE_X, ABSOLUTE_Y };

template <int CHANNELS>
void backward_tile(const Tile& tile, const float* records, const int32_t* ids, const int32_t* slots, int64_t entries,
                   const Blocks* blended, int64_t used, const float* image, const float* through_image,
                   const float* image_grad, const float* through_grad, float* parts) {
    const auto clear = [&](int64_t n) { std::memset(parts + int64_t(slots[n]) * RECORD, 0, RECORD * sizeof(float)); };
    for (int64_t n = used; n < entries; n++) clear(n);
    if (used == 0) return;
    alignas(64) Floats of_image[CHANNELS][BLOCKS], shown[CHANNELS][BLOCKS], through[BLOCKS], behind[BLOCKS], last[BLOCKS];
    const Offsets& offset = offsets_in_tile();
    if (through_grad) {
        tile.read<1>(through_image, &last), tile.read<1>(through_grad, &behind);
        for (int b = 0; b < BLOCKS; b++) behind[b] *= last[b];
    } else
        for (int b = 0; b < BLOCKS; b++) behind[b] = splat(0);
    // The light from behind a Gaussian is the whole image minus the Gaussian and everything in front of it.
    tile.read<CHANNELS>(image, shown), tile.read<CHANNELS>(image_grad, of_image);
    for (int c = 0; c < CHANNELS; c++)
        for (int b = 0; b < BLOCKS; b++) behind[b] += shown[c][b] * of_image[c][b];
    tile.clear(through);
    for (int64_t n = 0; n < used; n++) {
        if (n + AHEAD < used) {
            __builtin_prefetch(records + int64_t(ids[n + AHEAD]) * RECORD);
            __builtin_prefetch(parts + int64_t(slots[n + AHEAD]) * RECORD, 1);
        }
        if (!blended[n]) {
            clear(n);
            continue;
        }
        const float* g = records + int64_t(ids[n]) * RECORD;
        const Shape shape(tile, g);
        Floats sums[RECORD] = {};
        for (Blocks rest = blended[n]; rest; rest &= rest - 1) {
            const int b = first_of(rest);
            const Floats u = shape.u(offset.x[b], offset.y[b]), v = shape.v(offset.y[b]);
            const Floats q = u * u + v * v, before = through[b];
            const Mask inside = at_most(splat(OPAQUE), before, less(q, splat(shape.cut)));
            const Floats raw = shape.alpha(q), alpha = smaller(raw, splat(MAX_ALPHA));
            const Floats weight = where(inside, alpha * before);
            Floats own = splat(0);
            for (int c = 0; c < CHANNELS; c++) {
                own += g[RED + c] * of_image[c][b];
                sums[RED + c] += weight * of_image[c][b];
            }
            behind[b] -= weight * own;
            through[b] = before - weight;
            // The gradient of the exponent: alpha times the gradient of alpha, 0 if alpha is clipped.
            const Floats of_alpha = before * own - behind[b] / (1.0f - alpha);
            const Floats of_exponent = where(less(raw, splat(MAX_ALPHA), inside), of_alpha * alpha);
            const Floats by_u = of_exponent * u, by_v = of_exponent * v;
            sums[SUM_G] += of_exponent;
            sums[SUM_U] += by_u, sums[SUM_V] += by_v;
            sums[SUM_UU] += by_u * u, sums[SUM_UV] += by_u * v, sums[SUM_VV] += by_v * v;
            sums[ABSOLUTE_X] += magnitude(by_u), sums[ABSOLUTE_Y] += magnitude(shape.u_y * by_u + shape.v_y * by_v);
        }
        sum_lanes(sums, parts + int64_t(slots[n]) * RECORD);
    }
}

void check_tile(const int32_t* offsets, int64_t tile, int64_t entries, const int32_t* ids, int64_t count) {
    if (offsets[tile] < 0 || offsets[tile + 1] < offsets[tile] || offsets[tile + 1] > entries)
        bad_index(offsets[tile + 1], entries, "offsets");
    for (int64_t n = offsets[tile]; n < offsets[tile + 1]; n++) check_index(ids[n], count, "Gaussians");
}

}  // namespace

// The image (height, width, channels): colours over the background (3), then, of 4 channels, the sum of weight times
// distance, and of 7 the sum of the normals. The transmittance (height, width). If median is not null, the distance
// where half of the light is gone, or 0. The number of entries used in each tile's list and, if blended (entries) is
// not null, the blocks of the tile that each was used in.
EXPORT int splat_blend(const float* records, int64_t count, const int32_t* offsets, const int32_t* ids, int64_t entries,
                       int width, int height, int channels, const float* background, float* image, float* through,
                       float* median, uint64_t* blended, int32_t* used, int threads) {
    return guarded([&] {
        const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
        for_chunks(threads, int64_t(columns) * rows, [&](int64_t t, int) {
            check_tile(offsets, t, entries, ids, count);
            const Tile tile(t, columns, width, height);
            const auto run = [&](auto forward) {
                forward(tile, records, ids + offsets[t], offsets[t + 1] - offsets[t], background, image, through,
                        median, blended ? blended + offsets[t] : nullptr, used + t);
            };
            if (channels == 3) run(forward_tile<3>);
            else if (channels == 4) run(forward_tile<4>);
            else if (channels == 7) run(forward_tile<7>);
            else throw std::invalid_argument("an image has 3, 4 or 7 channels");
        });
    });
}

// Computes the sums of each entry, by slot, from the gradients of image and transmittance (the latter may be null).
EXPORT int splat_blend_backward(const float* records, int64_t count, const int32_t* offsets, const int32_t* ids,
                                const int32_t* slots, int64_t entries, int width, int height, int channels,
                                const float* image, const float* through, const uint64_t* blended,
                                const int32_t* used, const float* image_grad, const float* through_grad, float* parts,
                                int threads) {
    return guarded([&] {
        const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
        for_chunks(threads, int64_t(columns) * rows, [&](int64_t t, int) {
            check_tile(offsets, t, entries, ids, count);
            for (int64_t n = offsets[t]; n < offsets[t + 1]; n++) check_index(slots[n], entries, "entries");
            if (used[t] > offsets[t + 1] - offsets[t]) bad_index(used[t], offsets[t + 1] - offsets[t], "entries used");
            const Tile tile(t, columns, width, height);
            const auto run = [&](auto backward) {
                backward(tile, records, ids + offsets[t], slots + offsets[t], offsets[t + 1] - offsets[t],
                         blended + offsets[t], used[t], image, through, image_grad, through_grad, parts);
            };
            if (channels == 3) run(backward_tile<3>);
            else if (channels == 4) run(backward_tile<4>);
            else throw std::invalid_argument("an image with a gradient has 3 or 4 channels");
        });
    });
}

// The gradient of each record (count, RECORD) from the sums of its entries, which are added in the order of the tiles.
// In CUT and REACH_X it gives the sum over pixels of the absolute gradients of X and Y; REACH_Y is 0.
EXPORT int splat_gather(const float* records, int64_t count, const int32_t* firsts, int64_t entries, const float* parts,
                        float* gradient, int threads) {
    return guarded([&] {
        for_each(threads, count, 1024, [&](int64_t g) {
            const int64_t begin = firsts[g], end = firsts[g + 1];
            if (begin < 0 || end < begin || end > entries) bad_index(end, entries, "slots");
            float* out = gradient + g * RECORD;
            if (begin == end) {  // it may have no shape
                std::memset(out, 0, RECORD * sizeof(float));
                return;
            }
            float s[RECORD] = {};
            for (int64_t slot = begin; slot < end; slot++)
                for (int k = 0; k < RECORD; k++) s[k] += parts[slot * RECORD + k];
            const float* r = records + g * RECORD;
            std::memcpy(out, s, sizeof s);
            // Offsets from the centre are dy = v / V_Y, dx = (u - U_Y dy) / U_X. Where U_X underflows, u is 0 as well.
            const float per_u = r[U_X] != 0 ? 1 / r[U_X] : 0, per_v = r[V_Y] != 0 ? 1 / r[V_Y] : 0;
            out[X] = 2 * r[U_X] * s[SUM_U];
            out[Y] = 2 * (r[U_Y] * s[SUM_U] + r[V_Y] * s[SUM_V]);
            out[U_X] = -2 * per_u * (s[SUM_UU] - r[U_Y] * per_v * s[SUM_UV]);
            out[U_Y] = -2 * per_v * s[SUM_UV];
            out[V_Y] = -2 * per_v * s[SUM_VV];
            out[OPACITY] = r[OPACITY] > 0 ? s[SUM_G] / r[OPACITY] : 0;
            out[CUT] = 2 * std::abs(r[U_X]) * s[ABSOLUTE_X], out[REACH_X] = 2 * s[ABSOLUTE_Y], out[REACH_Y] = 0;
        });
    });
}
