// Small fully connected networks, ReLU between layers, in float32. See ../mlp.py for the reference.
//
// Samples pass through all layers in blocks that stay in cache; only the result leaves it. The backward pass recomputes
// a block's hidden layers, which costs less than writing them to memory and reading them back. Samples with zero
// incoming gradient (hidden ones) are skipped.
#include "networks/mlp_calls.h"

#include <utility>
#include <vector>

using namespace mlp;

namespace {

// y (rows, width) = x (rows, inner) w (inner, width), all row-major; width is a multiple of a vector, rows of ROWS.
template <int ROWS, int VECTORS>
inline void product_tile(const float* x, int ldx, const float* w, int ldw, int inner, float* y, int ldy) {
    Floats sum[ROWS][VECTORS];
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) sum[r][v] = splat(0);
    for (int k = 0; k < inner; k++) {
        Floats row[VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) row[v] = load(w + k * ldw + v * LANES);
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[r][v] += x[r * ldx + k] * row[v];
    }
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) store(y + r * ldy + v * LANES, sum[r][v]);
}

template <int ROWS, int VECTORS>
inline void product_columns(const float* x, int ldx, const float* w, int ldw, int inner, float* y, int ldy) {
    for (int r = 0; r < BLOCK; r += ROWS)
        product_tile<ROWS, VECTORS>(x + r * ldx, ldx, w, ldw, inner, y + r * ldy, ldy);
}

// Number of vectors of a row summed at once: as many as registers hold.
constexpr int WIDE = LANES == 16 ? 4 : 2;

void product(const float* x, int ldx, const float* w, int inner, int width, float* y, int ldy) {
    int column = 0;
    for (; column + WIDE * LANES <= width; column += WIDE * LANES)
        product_columns<4, WIDE>(x, ldx, w + column, width, inner, y + column, ldy);
    for (; column + 2 * LANES <= width; column += 2 * LANES)
        product_columns<LANES == 16 ? 8 : 4, 2>(x, ldx, w + column, width, inner, y + column, ldy);
    for (; column < width; column += LANES)
        product_columns<LANES == 16 ? 16 : 8, 1>(x, ldx, w + column, width, inner, y + column, ldy);
}

// dw (inner, width) += x^T (inner, rows) dy (rows, width), over one block of rows.
template <int INNER, int VECTORS>
inline void outer_tile(const float* x, int ldx, const float* dy, int ldy, float* dw, int width) {
    Floats sum[INNER][VECTORS];
#pragma GCC unroll 16
    for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) sum[k][v] = load(dw + k * width + v * LANES);
    for (int r = 0; r < BLOCK; r++) {
        Floats row[VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) row[v] = load(dy + r * ldy + v * LANES);
#pragma GCC unroll 16
        for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[k][v] += x[r * ldx + k] * row[v];
    }
#pragma GCC unroll 16
    for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) store(dw + k * width + v * LANES, sum[k][v]);
}

template <int INNER, int VECTORS>
inline void outer_columns(const float* x, int ldx, const float* dy, int ldy, int inner, float* dw, int width) {
    for (int k = 0; k < inner; k += INNER)
        outer_tile<INNER, VECTORS>(x + k, ldx, dy, ldy, dw + k * width, width);
}

// inner is a multiple of a vector.
void outer_product(const float* x, int ldx, const float* dy, int ldy, int inner, float* dw, int width) {
    int column = 0;
    for (; column + WIDE * LANES <= width; column += WIDE * LANES)
        outer_columns<4, WIDE>(x, ldx, dy + column, ldy, inner, dw + column, width);
    for (; column + 2 * LANES <= width; column += 2 * LANES)
        outer_columns<4, 2>(x, ldx, dy + column, ldy, inner, dw + column, width);
    for (; column < width; column += LANES)
        outer_columns<LANES == 16 ? 16 : LANES == 8 ? 8 : 4, 1>(x, ldx, dy + column, ldy, inner, dw + column, width);
}

struct Float {  // a form for mlp_calls.h
    typedef float Value;
    struct Prepared {};

    struct Network {
        int layers;
        int width[MAX_LAYERS + 1] = {};
        int rows[MAX_LAYERS + 1] = {}, columns[MAX_LAYERS + 1] = {};  // width in whole vectors, both
        std::vector<float> forward[MAX_LAYERS];   // (padded inputs, padded outputs), zeros outside
        std::vector<float> backward[MAX_LAYERS];  // (padded outputs, padded inputs)
        std::vector<float> bias[MAX_LAYERS];      // (padded outputs), or none

        Network(const int64_t* widths, int count, const float* const* weights, const float* const* biases)
            : layers(count) {
            for (int l = 0; l <= layers; l++) width[l] = int(widths[l]), rows[l] = columns[l] = padded(width[l]);
            for (int l = 0; l < layers; l++) {
                const int in = rows[l], out = rows[l + 1];
                forward[l].assign(size_t(in) * out, 0);
                backward[l].assign(size_t(in) * out, 0);
                if (biases[l]) {
                    bias[l].assign(out, 0);
                    std::memcpy(bias[l].data(), biases[l], sizeof(float) * width[l + 1]);
                }
                for (int o = 0; o < width[l + 1]; o++)
                    for (int i = 0; i < width[l]; i++)
                        forward[l][i * out + o] = backward[l][o * in + i] = weights[l][o * width[l] + i];
            }
        }
        const float* bias_of(int l) const { return bias[l].empty() ? nullptr : bias[l].data(); }
    };

    struct Block {
        alignas(64) float layer[MAX_LAYERS + 1][BLOCK * MAX_WIDTH];

        float* output(const Network& net) { return layer[net.layers]; }
    };

    struct Gradient {  // of one layer and of the previous one, alternating
        alignas(64) float first[BLOCK * MAX_WIDTH], second[BLOCK * MAX_WIDTH];
    };

    static float* start(Block&, Gradient& gradient) { return gradient.first; }

    static void read_input(const Network& net, const Inputs& input, const int64_t* rows, int size, Block& block) {
        input.read(block.layer[0], net.rows[0], rows, size);
    }

    // Not inline: they are called from several places.
    static void run_forward(const Network& net, Block& block);
    static const float* run_backward(const Network& net, const Block& block, Gradient& gradient, const Sums& places,
                                     float* sums);
};

void Float::run_forward(const Network& net, Block& block) {
    for (int l = 0; l < net.layers; l++) {
        const int in = net.rows[l], out = net.rows[l + 1];
        product(block.layer[l], in, net.forward[l].data(), net.width[l], out, block.layer[l + 1], out);
        if (l + 1 < net.layers || net.bias_of(l))
            add_bias(block.layer[l + 1], net.bias_of(l), out, l + 1 < net.layers);
    }
}

const float* Float::run_backward(const Network& net, const Block& block, Gradient& gradient, const Sums& places,
                                 float* sums) {
    float *grad = gradient.first, *other = gradient.second;
    for (int l = net.layers - 1; l >= 0; l--) {
        const int in = net.rows[l], out = net.rows[l + 1];
        float* sum = sums + places.first[l];
        outer_product(block.layer[l], in, grad, out, in, sum, out);
        if (net.bias_of(l)) add_rows(grad, out, sum + in * out);
        product(grad, out, net.backward[l].data(), net.width[l + 1], in, other, in);
        if (l > 0)
            for (int i = 0; i < BLOCK * in; i += LANES)
                store(other + i, load(block.layer[l] + i) > 0 ? load(other + i) : splat(0));
        std::swap(grad, other);
    }
    return grad;
}

}  // namespace

std::unique_ptr<Layers> mlp::layers_of(const int64_t* widths, int layers, const float* const* weights) {
    return without_biases<Float>(widths, layers, weights);
}

#if !defined(__AVX512BF16__)
std::unique_ptr<Layers> mlp::layers_bf16_of(const int64_t*, int, const float* const*) {
    throw std::invalid_argument("this processor does not multiply in bfloat16");
}
#endif

// The input is `parts` arrays (count, part_widths[p]) side by side; widths are those of the input and every layer.
// density (count), or null: exp of the first output, clamped at exp(15).
EXPORT int mlp_forward(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                       const int64_t* widths, int layers, const float* const* weights, const float* const* biases,
                       int activation, float* out, float* density, int threads) {
    return guarded([&] {
        forward<Float>({parts, inputs, part_widths}, count, widths, layers, weights, biases, activation, out, density,
                       threads);
    });
}

// The gradients of the output, `grad`, and of the density may be null.
// Writes the gradients of the inputs (null parts are skipped) and of the weights, (outputs, inputs).
EXPORT int mlp_backward(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                        const int64_t* widths, int layers, const float* const* weights, const float* const* biases,
                        int activation, const float* grad, const float* density, const float* density_grad,
                        float* const* input_grads, float* const* weight_grads, float* const* bias_grads, int threads) {
    return guarded([&] {
        backward<Float>({parts, inputs, part_widths}, count, widths, layers, weights, biases, activation, grad, density,
                        density_grad, input_grads, weight_grads, bias_grads, threads);
    });
}
