// The small networks of mlp.cpp with bfloat16 products and float32 sums, for processors that multiply bfloat16.
//
// Activations are rows of bfloat16; weights are interleaved pairs of rows, as VDPBF16PS requires: one instruction adds
// two products to each of 16 sums. Tiles (AMX), which one processor family has, use the same layout: one instruction
// adds 32 products to each of 16 x 16 sums.
#include "networks/mlp_calls.h"

#if defined(__AVX512BF16__)

#include <immintrin.h>

#include <vector>

using namespace mlp;

namespace {

typedef uint16_t Half;  // bfloat16: the upper half of a float

int wide(int width) { return (width + 31) / 32 * 32; }

Half half(float value) {  // to nearest, ties to even; NaN stays NaN
    uint32_t bits;
    std::memcpy(&bits, &value, 4);
    if (value != value) return Half(bits >> 16 | 0x40);
    return Half((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

inline __m512i halves(__m512 low, __m512 high) { return (__m512i)_mm512_cvtne2ps_pbh(high, low); }

inline __m512bh pair(const Half* from) {
    int32_t bits;
    std::memcpy(&bits, from, 4);
    return (__m512bh)_mm512_set1_epi32(bits);
}

// Interleaves pairs of rows, for the sum over rows: to[r / 2][column][r % 2].
void interleave(const Half* from, int width, Half* to) {
    alignas(64) static const uint16_t ORDER[2][32] = {
        {0, 32, 1, 33, 2, 34, 3, 35, 4, 36, 5, 37, 6, 38, 7, 39, 8, 40, 9, 41, 10, 42, 11, 43, 12, 44, 13, 45, 14, 46,
         15, 47},
        {16, 48, 17, 49, 18, 50, 19, 51, 20, 52, 21, 53, 22, 54, 23, 55, 24, 56, 25, 57, 26, 58, 27, 59, 28, 60, 29,
         61, 30, 62, 31, 63}};
    const __m512i low = _mm512_load_si512(ORDER[0]), high = _mm512_load_si512(ORDER[1]);
    for (int r = 0; r < BLOCK; r += 2)
        for (int c = 0; c < width; c += 32) {
            const __m512i a = _mm512_loadu_si512(from + r * width + c);
            const __m512i b = _mm512_loadu_si512(from + (r + 1) * width + c);
            Half* at = to + r * width + c * 2;
            _mm512_storeu_si512(at, _mm512_permutex2var_epi16(a, low, b));
            _mm512_storeu_si512(at + 32, _mm512_permutex2var_epi16(a, high, b));
        }
}

#if defined(__AMX_BF16__)

// The inner products of a layer are padded with zeros to a multiple of this number.
constexpr int DEPTH = 32;

// Everything written so far is in memory: GCC's tile instructions do not declare all that they read.
inline void written(const void* at = nullptr) { __asm__ volatile("" ::"r"(at) : "memory"); }

// The processor's tiles. A thread must configure them, and release them so that others need not save them.
struct Tiles {
    Tiles() {
        struct alignas(64) {
            uint8_t palette = 1, start = 0, reserved[14] = {};
            uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
            uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
        } shapes;
        written(&shapes);
        _tile_loadconfig(&shapes);
    }
    ~Tiles() { _tile_release(); }
    Tiles(const Tiles&) = delete;
    Tiles& operator=(const Tiles&) = delete;
};

// y (BLOCK, width) float = x (BLOCK, inner) bf16 times w with interleaved pairs of rows: w[k / 2][column][k % 2].
// width is a multiple of 16, inner of DEPTH.
void product(const Half* x, int ldx, const Half* w, int width, int inner, float* y, int ldy) {
    written();
    const int64_t of_x = ldx * 2, of_w = width * 4, of_y = ldy * 4;  // bytes of a row
    int column = 0;
    for (; column + 32 <= width; column += 32) {
        _tile_zero(0);
        _tile_zero(1);
        _tile_zero(2);
        _tile_zero(3);
        for (int k = 0; k < inner; k += DEPTH) {
            _tile_loadd(4, x + k, of_x);
            _tile_loadd(6, w + k * width + column * 2, of_w);
            _tile_loadd(7, w + k * width + column * 2 + 32, of_w);
            _tile_dpbf16ps(0, 4, 6);
            _tile_dpbf16ps(1, 4, 7);
            _tile_loadd(5, x + 16 * ldx + k, of_x);
            _tile_dpbf16ps(2, 5, 6);
            _tile_dpbf16ps(3, 5, 7);
        }
        _tile_stored(0, y + column, of_y);
        _tile_stored(1, y + column + 16, of_y);
        _tile_stored(2, y + 16 * ldy + column, of_y);
        _tile_stored(3, y + 16 * ldy + column + 16, of_y);
    }
    for (; column < width; column += 16) {
        _tile_zero(0);
        _tile_zero(2);
        for (int k = 0; k < inner; k += DEPTH) {
            _tile_loadd(4, x + k, of_x);
            _tile_loadd(5, x + 16 * ldx + k, of_x);
            _tile_loadd(6, w + k * width + column * 2, of_w);
            _tile_dpbf16ps(0, 4, 6);
            _tile_dpbf16ps(2, 5, 6);
        }
        _tile_stored(0, y + column, of_y);
        _tile_stored(2, y + 16 * ldy + column, of_y);
    }
}

// 16 x 16 values of 32 bits, rows `from_row` apart, to their transpose, rows `to_row` apart (in bytes).
inline void transpose(const Half* from, int64_t from_row, Half* to, int64_t to_row) {
    __m512i a[16], b[16];
#pragma GCC unroll 16
    for (int i = 0; i < 16; i++) a[i] = _mm512_loadu_si512((const char*)from + i * from_row);
#pragma GCC unroll 8
    for (int i = 0; i < 16; i += 2) {
        b[i] = _mm512_unpacklo_epi32(a[i], a[i + 1]);
        b[i + 1] = _mm512_unpackhi_epi32(a[i], a[i + 1]);
    }
#pragma GCC unroll 4
    for (int i = 0; i < 16; i += 4) {
        a[i] = _mm512_unpacklo_epi64(b[i], b[i + 2]);
        a[i + 1] = _mm512_unpackhi_epi64(b[i], b[i + 2]);
        a[i + 2] = _mm512_unpacklo_epi64(b[i + 1], b[i + 3]);
        a[i + 3] = _mm512_unpackhi_epi64(b[i + 1], b[i + 3]);
    }
    // a[4 i + c] has the rows 4 i to 4 i + 3 of columns c, c + 4, c + 8, c + 12 (a quarter of the vector each).
#pragma GCC unroll 4
    for (int c = 0; c < 4; c++) {
        const __m512i even = _mm512_shuffle_i32x4(a[c], a[4 + c], 0x88), odd = _mm512_shuffle_i32x4(a[c], a[4 + c], 0xdd);
        const __m512i last = _mm512_shuffle_i32x4(a[8 + c], a[12 + c], 0x88);
        const __m512i rest = _mm512_shuffle_i32x4(a[8 + c], a[12 + c], 0xdd);
        _mm512_storeu_si512((char*)to + c * to_row, _mm512_shuffle_i32x4(even, last, 0x88));
        _mm512_storeu_si512((char*)to + (c + 4) * to_row, _mm512_shuffle_i32x4(odd, rest, 0x88));
        _mm512_storeu_si512((char*)to + (c + 8) * to_row, _mm512_shuffle_i32x4(even, last, 0xdd));
        _mm512_storeu_si512((char*)to + (c + 12) * to_row, _mm512_shuffle_i32x4(odd, rest, 0xdd));
    }
}

// dw (inner, width) += x^T dy over the block, both interleaved in pairs of rows.
void outer_product(const Half* x, int ldx, const Half* dy, int ldy, int inner, float* dw, int width) {
    alignas(64) Half turned[16 * BLOCK];
    const int64_t of_dy = ldy * 4, of_dw = width * 4;
    for (int k = 0; k < inner; k += 16) {
        transpose(x + k * 2, ldx * 4, turned, 64);
        written(turned);
        _tile_loadd(4, turned, 64);
        for (int column = 0; column < width; column += 16) {
            float* at = dw + k * width + column;
            _tile_loadd(0, at, of_dw);
            _tile_loadd(6, dy + column * 2, of_dy);
            _tile_dpbf16ps(0, 4, 6);
            _tile_stored(0, at, of_dw);
        }
    }
}

#else

constexpr int DEPTH = 2;

struct Tiles {};

// y (BLOCK, width) float = x (BLOCK, inner) bf16 times w with interleaved pairs of rows: w[k / 2][column][k % 2].
template <int ROWS, int VECTORS>
inline void product_columns(const Half* x, int ldx, const Half* w, int width, int inner, float* y, int ldy) {
    for (int first = 0; first < BLOCK; first += ROWS) {
        __m512 sum[ROWS][VECTORS];
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[r][v] = _mm512_setzero_ps();
        for (int k = 0; k < inner; k += 2) {
            __m512bh row[VECTORS];
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) row[v] = (__m512bh)_mm512_loadu_si512(w + k * width + v * 32);
#pragma GCC unroll 16
            for (int r = 0; r < ROWS; r++) {
                const __m512bh two = pair(x + (first + r) * ldx + k);
#pragma GCC unroll 4
                for (int v = 0; v < VECTORS; v++) sum[r][v] = _mm512_dpbf16_ps(sum[r][v], two, row[v]);
            }
        }
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) _mm512_storeu_ps(y + (first + r) * ldy + v * 16, sum[r][v]);
    }
}

// width is a multiple of 16 here: a layer of 16 outputs needs no second half.
void product(const Half* x, int ldx, const Half* w, int width, int inner, float* y, int ldy) {
    int column = 0;
    for (; column + 64 <= width; column += 64)
        product_columns<4, 4>(x, ldx, w + column * 2, width, inner, y + column, ldy);
    for (; column + 32 <= width; column += 32)
        product_columns<8, 2>(x, ldx, w + column * 2, width, inner, y + column, ldy);
    for (; column < width; column += 16)
        product_columns<16, 1>(x, ldx, w + column * 2, width, inner, y + column, ldy);
}

// dw (inner, width) += x^T dy over the block, both interleaved in pairs of rows.
template <int INNER, int VECTORS>
inline void outer_columns(const Half* x, int ldx, const Half* dy, int ldy, int inner, float* dw, int width) {
    for (int k = 0; k < inner; k += INNER) {
        __m512 sum[INNER][VECTORS];
#pragma GCC unroll 16
        for (int i = 0; i < INNER; i++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[i][v] = _mm512_loadu_ps(dw + (k + i) * width + v * 16);
        for (int r = 0; r < BLOCK; r += 2) {
            __m512bh row[VECTORS];
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) row[v] = (__m512bh)_mm512_loadu_si512(dy + r * ldy + v * 32);
#pragma GCC unroll 16
            for (int i = 0; i < INNER; i++) {
                const __m512bh two = pair(x + r * ldx + (k + i) * 2);
#pragma GCC unroll 4
                for (int v = 0; v < VECTORS; v++) sum[i][v] = _mm512_dpbf16_ps(sum[i][v], two, row[v]);
            }
        }
#pragma GCC unroll 16
        for (int i = 0; i < INNER; i++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) _mm512_storeu_ps(dw + (k + i) * width + v * 16, sum[i][v]);
    }
}

void outer_product(const Half* x, int ldx, const Half* dy, int ldy, int inner, float* dw, int width) {
    int column = 0;
    for (; column + 64 <= width; column += 64)
        outer_columns<4, 4>(x, ldx, dy + column * 2, ldy, inner, dw + column, width);
    for (; column + 32 <= width; column += 32)
        outer_columns<8, 2>(x, ldx, dy + column * 2, ldy, inner, dw + column, width);
    for (; column < width; column += 16)
        outer_columns<16, 1>(x, ldx, dy + column * 2, ldy, inner, dw + column, width);
}

#endif

// The bias's gradient: sums over a block's rows of bf16 (rows wide).
void add_halves(const Half* grad, int rows, int columns, float* sums) {
    for (int r = 0; r < BLOCK; r++)
        for (int c = 0; c < columns; c += 16) {
            const __m256i half_values = _mm256_loadu_si256((const __m256i*)(grad + r * rows + c));
            const __m512 values = _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(half_values), 16));
            _mm512_storeu_ps(sums + c, _mm512_add_ps(_mm512_loadu_ps(sums + c), values));
        }
}

// Rows of float (columns wide) to rows of bf16 (rows wide), where `keep`, if given, is positive.
void to_halves(const float* from, int columns, Half* to, int rows, bool relu, const Half* keep) {
    const __m512 zero = _mm512_setzero_ps();
    for (int r = 0; r < BLOCK; r++)
        for (int c = 0; c < rows; c += 32) {
            __m512 a = _mm512_loadu_ps(from + r * columns + c);
            __m512 b = c + 16 < columns ? _mm512_loadu_ps(from + r * columns + c + 16) : zero;
            if (relu) {  // the operand order lets NaN through
                a = _mm512_max_ps(zero, a);
                b = _mm512_max_ps(zero, b);
            }
            __m512i out = halves(a, b);
            if (keep) {
                const __m512i k = _mm512_loadu_si512(keep + r * rows + c);
                out = _mm512_maskz_mov_epi16(_mm512_test_epi16_mask(k, k), out);
            }
            _mm512_storeu_si512(to + r * rows + c, out);
        }
}

struct Bfloat16 {  // a form for mlp_calls.h
    typedef Half Value;
    typedef Tiles Prepared;

    struct Network {
        int layers;
        int width[MAX_LAYERS + 1] = {};
        int rows[MAX_LAYERS + 1] = {};     // width of a row of activations, in whole pairs of vectors
        int columns[MAX_LAYERS + 1] = {};  // width of a row of sums, in whole vectors
        std::vector<Half> forward[MAX_LAYERS], backward[MAX_LAYERS];
        std::vector<float> bias[MAX_LAYERS];  // of whole vectors, or none

        Network(const int64_t* widths, int count, const float* const* weights, const float* const* biases)
            : layers(count) {
            for (int l = 0; l <= layers; l++) {
                width[l] = int(widths[l]);
                rows[l] = wide(width[l]);
                columns[l] = (width[l] + 15) / 16 * 16;
            }
            for (int l = 0; l < layers; l++) {
                forward[l].assign(size_t(rows[l]) * columns[l + 1], 0);
                backward[l].assign(size_t(rows[l + 1]) * columns[l], 0);
                if (biases[l]) {
                    bias[l].assign(size_t(columns[l + 1]), 0);
                    std::memcpy(bias[l].data(), biases[l], sizeof(float) * width[l + 1]);
                }
                for (int o = 0; o < width[l + 1]; o++)
                    for (int i = 0; i < width[l]; i++) {
                        const Half w = half(weights[l][o * width[l] + i]);
                        forward[l][i / 2 * columns[l + 1] * 2 + o * 2 + i % 2] = w;
                        backward[l][o / 2 * columns[l] * 2 + i * 2 + o % 2] = w;
                    }
            }
        }
        int inner(int l) const { return (width[l] + DEPTH - 1) / DEPTH * DEPTH; }
        const float* bias_of(int l) const { return bias[l].empty() ? nullptr : bias[l].data(); }
    };

    struct Block {
        alignas(64) Half layer[MAX_LAYERS][BLOCK * MAX_WIDTH];  // the input and hidden activations
        alignas(64) float last[BLOCK * MAX_WIDTH];              // the output
        alignas(64) float scratch[BLOCK * MAX_WIDTH];           // a layer's result, forward and backward

        float* output(const Network&) { return last; }
    };

    struct Gradient {  // of a block
        alignas(64) Half current[BLOCK * MAX_WIDTH], pairs_x[BLOCK * MAX_WIDTH], pairs_dy[BLOCK * MAX_WIDTH];
    };

    static float* start(Block& block, Gradient&) { return block.scratch; }

    static void read_input(const Network& net, const Inputs& input, const int64_t* rows, int size, Block& block) {
        const int columns = net.columns[0];
        input.read(block.scratch, columns, rows, size);
        to_halves(block.scratch, columns, block.layer[0], net.rows[0], false, nullptr);
    }

    // Not inline: they are called from several places.
    static void run_forward(const Network& net, Block& block);
    static const float* run_backward(const Network& net, Block& block, Gradient& grad, const Sums& places,
                                     float* sums);
};

void Bfloat16::run_forward(const Network& net, Block& block) {
    for (int l = 0; l < net.layers; l++) {
        const bool last = l + 1 == net.layers;
        float* out = last ? block.last : block.scratch;
        product(block.layer[l], net.rows[l], net.forward[l].data(), net.columns[l + 1], net.inner(l), out,
                net.columns[l + 1]);
        if (net.bias_of(l)) add_bias(out, net.bias_of(l), net.columns[l + 1], false);
        if (!last) to_halves(out, net.columns[l + 1], block.layer[l + 1], net.rows[l + 1], true, nullptr);
    }
}

const float* Bfloat16::run_backward(const Network& net, Block& block, Gradient& grad, const Sums& places,
                                 float* sums) {
    const int layers = net.layers;
    to_halves(block.scratch, net.columns[layers], grad.current, net.rows[layers], false, nullptr);
    for (int l = layers - 1; l >= 0; l--) {
        float* sum = sums + places.first[l];
        if (net.bias_of(l))
            add_halves(grad.current, net.rows[l + 1], net.columns[l + 1],
                       sum + net.columns[l] * net.columns[l + 1]);
        interleave(block.layer[l], net.rows[l], grad.pairs_x);
        interleave(grad.current, net.rows[l + 1], grad.pairs_dy);
        outer_product(grad.pairs_x, net.rows[l], grad.pairs_dy, net.rows[l + 1], net.columns[l], sum,
                      net.columns[l + 1]);
        product(grad.current, net.rows[l + 1], net.backward[l].data(), net.columns[l], net.inner(l + 1),
                block.scratch, net.columns[l]);
        if (l > 0) to_halves(block.scratch, net.columns[l], grad.current, net.rows[l], false, block.layer[l]);
    }
    return block.scratch;
}

}  // namespace

std::unique_ptr<Layers> mlp::layers_bf16_of(const int64_t* widths, int layers, const float* const* weights) {
    return without_biases<Bfloat16>(widths, layers, weights);
}

// Like mlp_forward and mlp_backward.
EXPORT int mlp_forward_bf16(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                            const int64_t* widths, int layers, const float* const* weights,
                            const float* const* biases, int activation, float* out, float* density, int threads) {
    return guarded([&] {
        forward<Bfloat16>({parts, inputs, part_widths}, count, widths, layers, weights, biases, activation, out,
                          density, threads);
    });
}

EXPORT int mlp_backward_bf16(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                             const int64_t* widths, int layers, const float* const* weights,
                             const float* const* biases, int activation, const float* grad, const float* density,
                             const float* density_grad, float* const* input_grads, float* const* weight_grads,
                             float* const* bias_grads, int threads) {
    return guarded([&] {
        backward<Bfloat16>({parts, inputs, part_widths}, count, widths, layers, weights, biases, activation, grad,
                           density, density_grad, input_grads, weight_grads, bias_grads, threads);
    });
}

#endif
