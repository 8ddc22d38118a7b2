// Blending the Gaussians of each tile from front to back, forward and backward. See ../splat_blend.py.
//
// A tile of TILE x TILE pixels consists of blocks of LANES pixels, 4 across: a vector holds a block. For each Gaussian
// of the tile's list, the blocks that its box meets are evaluated, so most of what is computed is used.
#include "splat.h"

#include <vector>

namespace {

constexpr int ACROSS = 4, DOWN = LANES / ACROSS;  // pixels of a block
constexpr int COLUMNS = TILE / ACROSS, ROWS = TILE / DOWN, BLOCKS = COLUMNS * ROWS;

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

inline bool any(Ints mask) {
#if defined(__AVX512F__)
    typedef long long Eight __attribute__((vector_size(64)));
    Eight halves;
    std::memcpy(&halves, &mask, sizeof halves);
    return __builtin_ia32_ptestmq512((Eight)halves, (Eight)halves, 0xff) != 0;
#else
    int64_t parts[LANES / 2], all = 0;
    std::memcpy(parts, &mask, sizeof parts);
    for (const int64_t part : parts) all |= part;
    return all != 0;
#endif
}

struct Offsets {  // of a block's pixels from its first
    Floats x, y;
    Offsets() {
        float across[LANES], down[LANES];
        for (int i = 0; i < LANES; i++) across[i] = float(i % ACROSS), down[i] = float(i / ACROSS);
        x = load(across), y = load(down);
    }
};

// The blocks of a tile whose pixels' centres a Gaussian's box holds.
struct Box {
    int left, right, top, bottom;
    Box(const float* g, float x, float y) {  // x, y: the tile's first pixel's centre, from the Gaussian's
        left = at_least(-g[REACH_X] - x, ACROSS, COLUMNS), right = at_most(g[REACH_X] - x, ACROSS, COLUMNS);
        top = at_least(-g[REACH_Y] - y, DOWN, ROWS), bottom = at_most(g[REACH_Y] - y, DOWN, ROWS);
    }
    static int at_least(float from, int size, int count) {  // the first block whose last pixel is not before
        const float block = std::ceil((from - (size - 1)) / size);
        return block < 0 ? 0 : (block > count ? count : int(block));
    }
    static int at_most(float to, int size, int count) {
        const float block = std::floor(to / size) + 1;
        return block < 0 ? 0 : (block > count ? count : int(block));
    }
};

// What one Gaussian is at the pixels of a tile.
struct Shape {
    Floats u, v;  // at the offsets within a block, less its first pixel's
    float u_x, u_y, v_y, cut, opacity;
    Shape(const float* g, const Offsets& offset)
        : u(g[U_X] * offset.x + g[U_Y] * offset.y), v(g[V_Y] * offset.y), u_x(g[U_X]), u_y(g[U_Y]), v_y(g[V_Y]),
          cut(g[CUT]), opacity(g[OPACITY]) {}
    // u^2 + v^2 at a block whose first pixel's centre is at (dx, dy) from the Gaussian's.
    Floats squared(float dx, float dy) const {
        const Floats a = u + (u_x * dx + u_y * dy), b = v + v_y * dy;
        return a * a + b * b;
    }
};

constexpr float LOG2_E = 1.44269504f;

struct Tile {
    int left, top, width, height;  // of its first pixel, and of the image
    Tile(int64_t tile, int columns, int width, int height)
        : left(int(tile % columns) * TILE), top(int(tile / columns) * TILE), width(width), height(height) {}

    // Copies between planes of blocks and rows of pixels (height, width, channels).
    template <typename Values>
    void read(const float* image, int channels, int channel, Values& planes) const {
        for (int b = 0; b < BLOCKS; b++) {
            float lanes[LANES];
            for (int i = 0; i < LANES; i++) {
                const int x = left + b % COLUMNS * ACROSS + i % ACROSS, y = top + b / COLUMNS * DOWN + i / ACROSS;
                lanes[i] = x < width && y < height ? image[(int64_t(y) * width + x) * channels + channel] : 0;
            }
            planes[b] = load(lanes);
        }
    }
    template <typename Values>
    void write(float* image, int channels, int channel, const Values& planes) const {
        for (int b = 0; b < BLOCKS; b++) {
            float lanes[LANES];
            store(lanes, planes[b]);
            for (int i = 0; i < LANES; i++) {
                const int x = left + b % COLUMNS * ACROSS + i % ACROSS, y = top + b / COLUMNS * DOWN + i / ACROSS;
                if (x < width && y < height) image[(int64_t(y) * width + x) * channels + channel] = lanes[i];
            }
        }
    }
    // Transmittance at the start: pixels beyond the image's edge are opaque.
    void clear(Floats* through) const {
        for (int b = 0; b < BLOCKS; b++) {
            float lanes[LANES];
            for (int i = 0; i < LANES; i++) {
                const int x = left + b % COLUMNS * ACROSS + i % ACROSS, y = top + b / COLUMNS * DOWN + i / ACROSS;
                lanes[i] = x < width && y < height ? 1.0f : 0.0f;
            }
            through[b] = load(lanes);
        }
    }
};

template <int CHANNELS>
void forward_tile(const Tile& tile, const float* records, const int32_t* ids, int64_t entries, const float* background,
                  float* image, float* through_image, float* median_image, int32_t* used) {
    alignas(64) Floats sum[CHANNELS][BLOCKS] = {}, through[BLOCKS], median[BLOCKS] = {};
    const Offsets offset;
    tile.clear(through);
    uint64_t alive = 0;
    for (int b = 0; b < BLOCKS; b++) alive |= uint64_t(any(through[b] > 0)) << b;
    int64_t n = 0;
    for (; n < entries && alive; n++) {
        const float* g = records + int64_t(ids[n]) * RECORD;
        const float x = tile.left + 0.5f - g[X], y = tile.top + 0.5f - g[Y];
        const Box box(g, x, y);
        const Shape shape(g, offset);
        for (int row = box.top; row < box.bottom; row++)
            for (int column = box.left; column < box.right; column++) {
                const int b = row * COLUMNS + column;
                if (!(alive >> b & 1)) continue;
                const Floats q = shape.squared(x + column * ACROSS, y + row * DOWN), before = through[b];
                const Ints inside = (q < shape.cut) & (before >= OPAQUE);
                if (!any(inside)) continue;
                const Floats alpha = smaller(shape.opacity * power_of_two(smaller(q, splat(80)) * -LOG2_E), splat(MAX_ALPHA));
                const Floats weight = inside ? alpha * before : splat(0), after = before - weight;
                for (int c = 0; c < CHANNELS; c++) sum[c][b] += weight * g[RED + c];
                if (median_image) median[b] = ((before > 0.5f) & (after <= 0.5f)) ? splat(g[DISTANCE]) : median[b];
                through[b] = after;
                if (!any(after >= OPAQUE)) alive &= ~(uint64_t(1) << b);
            }
    }
    *used = int32_t(n);
    for (int c = 0; c < CHANNELS; c++) {
        if (c < 3)
            for (int b = 0; b < BLOCKS; b++) sum[c][b] += through[b] * background[c];
        tile.write(image, CHANNELS, c, sum[c]);
    }
    tile.write(through_image, 1, 0, through);
    if (median_image) tile.write(median_image, 1, 0, median);
}

#if defined(__clang__)
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, Ints{__VA_ARGS__})
#endif

// The sums of the lanes of `count` vectors (a multiple of LANES).
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
#else
    for (int k = 0; k < RECORD; k++) {
        float lanes[LANES], sum = 0;
        store(lanes, v[k]);
        for (int i = 0; i < LANES; i++) sum += lanes[i];
        out[k] = sum;
    }
#endif
}

// Slots of the sums over a Gaussian's pixels that have no name among the record's.
enum Sums { SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, SUM_G, ABSOLUTE_X, ABSOLUTE_Y };

template <int CHANNELS>
void backward_tile(const Tile& tile, const float* records, const int32_t* ids, const int32_t* slots, int64_t entries,
                   int64_t used, const float* image, const float* through_image, const float* image_grad,
                   const float* through_grad, float* parts) {
    alignas(64) Floats of_image[CHANNELS][BLOCKS], through[BLOCKS], behind[BLOCKS], last[BLOCKS];
    const Offsets offset;
    tile.read(through_image, 1, 0, last);
    if (through_grad) tile.read(through_grad, 1, 0, behind);
    for (int b = 0; b < BLOCKS; b++) behind[b] = through_grad ? behind[b] * last[b] : splat(0);
    // What is behind a Gaussian is all that is seen, less what is in front of it and itself.
    for (int c = 0; c < CHANNELS; c++) {
        Floats shown[BLOCKS];
        tile.read(image, CHANNELS, c, shown), tile.read(image_grad, CHANNELS, c, of_image[c]);
        for (int b = 0; b < BLOCKS; b++) behind[b] += shown[b] * of_image[c][b];
    }
    tile.clear(through);
    uint64_t alive = 0;
    for (int b = 0; b < BLOCKS; b++) alive |= uint64_t(any(through[b] > 0)) << b;
    for (int64_t n = 0; n < used; n++) {
        const float* g = records + int64_t(ids[n]) * RECORD;
        const float x = tile.left + 0.5f - g[X], y = tile.top + 0.5f - g[Y];
        const Box box(g, x, y);
        const Shape shape(g, offset);
        Floats sums[RECORD] = {};
        // Rows of the inverse covariance, for the absolute gradient of the centre.
        const float xx = 2 * g[U_X] * g[U_X], xy = 2 * g[U_X] * g[U_Y], yy = 2 * (g[U_Y] * g[U_Y] + g[V_Y] * g[V_Y]);
        for (int row = box.top; row < box.bottom; row++)
            for (int column = box.left; column < box.right; column++) {
                const int b = row * COLUMNS + column;
                if (!(alive >> b & 1)) continue;
                const float block_x = x + column * ACROSS, block_y = y + row * DOWN;
                const Floats q = shape.squared(block_x, block_y), before = through[b];
                const Ints inside = (q < shape.cut) & (before >= OPAQUE);
                if (!any(inside)) continue;
                const Floats raw = shape.opacity * power_of_two(smaller(q, splat(80)) * -LOG2_E);
                const Floats alpha = smaller(raw, splat(MAX_ALPHA));
                const Floats weight = inside ? alpha * before : splat(0), after = before - weight;
                Floats own = splat(0);
                for (int c = 0; c < CHANNELS; c++) {
                    own += g[RED + c] * of_image[c][b];
                    sums[RED + c] += weight * of_image[c][b];
                }
                behind[b] -= weight * own;
                through[b] = after;
                // The gradient of the exponent: alpha times that of alpha; none where alpha is at its bound.
                const Floats of_alpha = before * own - behind[b] / (1.0f - alpha);
                const Floats of_exponent = (inside & (raw < MAX_ALPHA)) ? of_alpha * alpha : splat(0);
                const Floats dx = offset.x + block_x, dy = offset.y + block_y;
                const Floats by_x = of_exponent * dx, by_y = of_exponent * dy;
                sums[SUM_G] += of_exponent;
                sums[SUM_X] += by_x, sums[SUM_Y] += by_y;
                sums[SUM_XX] += by_x * dx, sums[SUM_XY] += by_x * dy, sums[SUM_YY] += by_y * dy;
                const Floats of_x = xx * by_x + xy * by_y, of_y = xy * by_x + yy * by_y;
                sums[ABSOLUTE_X] += of_x < 0 ? -of_x : of_x, sums[ABSOLUTE_Y] += of_y < 0 ? -of_y : of_y;
                if (!any(after >= OPAQUE)) alive &= ~(uint64_t(1) << b);
            }
        sum_lanes(sums, parts + int64_t(slots[n]) * RECORD);
    }
    for (int64_t n = used; n < entries; n++) std::memset(parts + int64_t(slots[n]) * RECORD, 0, RECORD * sizeof(float));
}

void check_tile(const int32_t* offsets, int64_t tile, int64_t entries, const int32_t* ids, int64_t count) {
    if (offsets[tile] < 0 || offsets[tile + 1] < offsets[tile] || offsets[tile + 1] > entries)
        bad_index(offsets[tile + 1], entries, "offsets");
    for (int64_t n = offsets[tile]; n < offsets[tile + 1]; n++) check_index(ids[n], count, "Gaussians");
}

}  // namespace

// The image (height, width, channels): colours over the background (3), then, of 4 channels, the sum of weight times
// distance, and of 7 the sum of the normals. The transmittance (height, width). If median is not null, the distance at
// which half of the light is gone, or 0. How many entries of each tile's list were used.
EXPORT int splat_blend(const float* records, int64_t count, const int32_t* offsets, const int32_t* ids, int64_t entries,
                       int width, int height, int channels, const float* background, float* image, float* through,
                       float* median, int32_t* used, int threads) {
    return guarded([&] {
        const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
        for_chunks(threads, int64_t(columns) * rows, [&](int64_t t, int) {
            check_tile(offsets, t, entries, ids, count);
            const Tile tile(t, columns, width, height);
            const auto run = [&](auto forward) {
                forward(tile, records, ids + offsets[t], offsets[t + 1] - offsets[t], background, image, through, median,
                        used + t);
            };
            if (channels == 3) run(forward_tile<3>);
            else if (channels == 4) run(forward_tile<4>);
            else if (channels == 7) run(forward_tile<7>);
            else throw std::invalid_argument("an image has 3, 4 or 7 channels");
        });
    });
}

// From the gradients of image and transmittance (the latter may be null) the sums of each entry, by slot.
EXPORT int splat_blend_backward(const float* records, int64_t count, const int32_t* offsets, const int32_t* ids,
                                const int32_t* slots, int64_t entries, int width, int height, int channels,
                                const float* image, const float* through, const int32_t* used, const float* image_grad,
                                const float* through_grad, float* parts, int threads) {
    return guarded([&] {
        const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
        for_chunks(threads, int64_t(columns) * rows, [&](int64_t t, int) {
            check_tile(offsets, t, entries, ids, count);
            for (int64_t n = offsets[t]; n < offsets[t + 1]; n++) check_index(slots[n], entries, "entries");
            if (used[t] > offsets[t + 1] - offsets[t]) bad_index(used[t], offsets[t + 1] - offsets[t], "entries used");
            const Tile tile(t, columns, width, height);
            const auto run = [&](auto backward) {
                backward(tile, records, ids + offsets[t], slots + offsets[t], offsets[t + 1] - offsets[t], used[t],
                         image, through, image_grad, through_grad, parts);
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
            float s[RECORD] = {};
            for (int64_t slot = begin; slot < end; slot++)
                for (int k = 0; k < RECORD; k++) s[k] += parts[slot * RECORD + k];
            const float* r = records + g * RECORD;
            float* out = gradient + g * RECORD;
            std::memcpy(out, s, sizeof s);
            const float by_u = r[U_X] * s[SUM_X] + r[U_Y] * s[SUM_Y];
            out[X] = 2 * r[U_X] * by_u;
            out[Y] = 2 * (r[U_Y] * by_u + r[V_Y] * r[V_Y] * s[SUM_Y]);
            out[U_X] = -2 * (r[U_X] * s[SUM_XX] + r[U_Y] * s[SUM_XY]);
            out[U_Y] = -2 * (r[U_X] * s[SUM_XY] + r[U_Y] * s[SUM_YY]);
            out[V_Y] = -2 * r[V_Y] * s[SUM_YY];
            out[OPACITY] = r[OPACITY] > 0 ? s[SUM_G] / r[OPACITY] : 0;
            out[CUT] = s[ABSOLUTE_X], out[REACH_X] = s[ABSOLUTE_Y], out[REACH_Y] = 0;
        });
    });
}
