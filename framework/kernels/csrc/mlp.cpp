// Small fully connected networks, ReLU between layers, in float32. See ../mlp.py for the reference.
//
// Samples go through all layers in blocks that stay in cache; nothing but the result leaves it. The backward pass
// computes a block's hidden layers again, which costs less than writing them to memory and reading them back. Samples
// whose incoming gradient is zero (hidden ones) are left out of it.
#include "mlp.h"

#include <vector>

using namespace mlp;

namespace {

// y (rows, width) = x (rows, inner) w (inner, width), all row-major; width a whole number of vectors, rows of ROWS.
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

// How many vectors of a row are summed at once: as many as leave every sum in a register.
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

// inner is a whole number of vectors.
void outer_product(const float* x, int ldx, const float* dy, int ldy, int inner, float* dw, int width) {
    int column = 0;
    for (; column + WIDE * LANES <= width; column += WIDE * LANES)
        outer_columns<4, WIDE>(x, ldx, dy + column, ldy, inner, dw + column, width);
    for (; column + 2 * LANES <= width; column += 2 * LANES)
        outer_columns<4, 2>(x, ldx, dy + column, ldy, inner, dw + column, width);
    for (; column < width; column += LANES)
        outer_columns<LANES == 16 ? 16 : LANES == 8 ? 8 : 4, 1>(x, ldx, dy + column, ldy, inner, dw + column, width);
}

struct Network {
    int layers;
    int width[MAX_LAYERS + 1] = {}, wide[MAX_LAYERS + 1] = {};  // of the input and each layer; padded to whole vectors
    std::vector<float> forward[MAX_LAYERS];   // (wide inputs, wide outputs), zeros outside
    std::vector<float> backward[MAX_LAYERS];  // (wide outputs, wide inputs)
    std::vector<float> bias[MAX_LAYERS];      // (wide outputs), or none

    Network(const int64_t* widths, int count, const float* const* weights, const float* const* biases)
        : layers(count) {
        for (int l = 0; l <= layers; l++) width[l] = int(widths[l]), wide[l] = padded(width[l]);
        for (int l = 0; l < layers; l++) {
            const int in = wide[l], out = wide[l + 1];
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

// A block's activations: layer[0] is the input, layer[L] the output before its activation function.
struct Block {
    alignas(64) float layer[MAX_LAYERS + 1][BLOCK * MAX_WIDTH];
};

void run_forward(const Network& net, Block& block) {
    for (int l = 0; l < net.layers; l++) {
        const int in = net.wide[l], out = net.wide[l + 1];
        product(block.layer[l], in, net.forward[l].data(), net.width[l], out, block.layer[l + 1], out);
        if (l + 1 < net.layers || net.bias_of(l)) add_bias(block.layer[l + 1], net.bias_of(l), out, l + 1 < net.layers);
    }
}

// One block's backward pass: adds to `sums`, leaves the input's gradient in the returned buffer.
float* run_backward(const Network& net, const Block& block, float* grad, float* other, const Sums& places, float* sums) {
    for (int l = net.layers - 1; l >= 0; l--) {
        const int in = net.wide[l], out = net.wide[l + 1];
        float* sum = sums + places.first[l];
        outer_product(block.layer[l], in, grad, out, in, sum, out);
        if (net.bias_of(l)) add_rows(grad, out, sum + in * out);
        product(grad, out, net.backward[l].data(), net.width[l + 1], in, other, in);
        if (l > 0)
            for (int i = 0; i < BLOCK * in; i += LANES)
                store(other + i, load(block.layer[l] + i) > 0 ? load(other + i) : splat(0));
        float* swap = grad;
        grad = other;
        other = swap;
    }
    return grad;
}

// The rows [begin, end) of the input to those of the output, and of the density, which may be null. each(first, size,
// block) sees every block.
template <typename Each>
void take_through(const Network& net, const Inputs& input, int64_t begin, int64_t end, int activation, float* out,
                  float* density, const Each& each) {
    const int outputs = net.width[net.layers], columns = net.wide[net.layers];
    Block block;
    for (int64_t first = begin; first < end; first += BLOCK) {
        const int size = int(std::min<int64_t>(end - first, BLOCK));
        int64_t rows[BLOCK];
        for (int r = 0; r < size; r++) rows[r] = first + r;
        input.read(block.layer[0], net.wide[0], rows, size);
        run_forward(net, block);
        each(first, size, block);
        float* last = block.layer[net.layers];
        if (density) write_density(last, columns, size, density + first);
        activate(last, BLOCK * columns, activation);
        for (int r = 0; r < size; r++)
            std::memcpy(out + rows[r] * outputs, last + r * columns, sizeof(float) * outputs);
    }
}

struct Whole final : Layers {
    Network net;
    Sums places;
    size_t wide = 0;  // floats of a record

    Whole(const int64_t* widths, int layers, const float* const* weights, const float* const* biases)
        : net(widths, layers, weights, biases), places(layers, net.wide) {
        for (int l = 0; l < layers; l++) wide += size_t(net.wide[l]);
    }
    size_t record() const override { return wide * sizeof(float); }
    size_t sums() const override { return places.size; }

    void forward(const float* in, int64_t count, int activation, float* out, float* density,
                 char* records) const override {
        const int64_t width = net.width[0];
        take_through(net, Inputs{1, &in, &width}, 0, count, activation, out, density,
                     [&](int64_t first, int size, const Block& block) {
                         for (int r = 0; records && r < size; r++) {
                             float* to = (float*)records + size_t(first + r) * wide;
                             for (int l = 0; l < net.layers; to += net.wide[l++])
                                 std::memcpy(to, block.layer[l] + r * net.wide[l], sizeof(float) * net.wide[l]);
                         }
                     });
    }
    void backward(const char* records, const int64_t* rows, int count, const float* grad, float* sums,
                  float* input_grad) const override {
        const int outputs = net.width[net.layers], columns = net.wide[net.layers], inputs = net.width[0];
        Block block;
        alignas(64) float first[BLOCK * MAX_WIDTH], second[BLOCK * MAX_WIDTH];
        for (int l = 0; l < net.layers; l++) std::memset(block.layer[l], 0, sizeof(float) * BLOCK * net.wide[l]);
        std::memset(first, 0, sizeof(float) * BLOCK * columns);
        for (int r = 0; r < count; r++) {
            const float* from = (const float*)records + size_t(rows[r]) * wide;
            for (int l = 0; l < net.layers; from += net.wide[l++])
                std::memcpy(block.layer[l] + r * net.wide[l], from, sizeof(float) * net.wide[l]);
            std::memcpy(first + r * columns, grad + r * outputs, sizeof(float) * outputs);
        }
        const float* dx = run_backward(net, block, first, second, places, sums);
        for (int r = 0; r < count; r++)
            std::memcpy(input_grad + r * inputs, dx + r * net.wide[0], sizeof(float) * inputs);
    }
    void write(float* sums, int64_t parts, int threads, float* const* weight_grads) const override {
        places.write(sums, parts, threads, net.width, weight_grads, nullptr);
    }
};

}  // namespace

std::unique_ptr<Layers> mlp::layers_of(const int64_t* widths, int layers, const float* const* weights) {
    check_sizes(widths, layers);
    const float* none[MAX_LAYERS] = {};
    return std::make_unique<Whole>(widths, layers, weights, none);
}

#if !defined(__AVX512BF16__)
std::unique_ptr<Layers> mlp::layers_bf16_of(const int64_t*, int, const float* const*) {
    throw std::invalid_argument("this processor does not multiply in bfloat16");
}
#endif

// The input is `parts` arrays (count, part_widths[p]) side by side; widths are those of the input and every layer.
// density (count), or null: exp of the first output, which is at most exp(15).
EXPORT int mlp_forward(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                       const int64_t* widths, int layers, const float* const* weights, const float* const* biases,
                       int activation, float* out, float* density, int threads) {
    return guarded([&] {
        check_sizes(widths, layers);
        const Network net(widths, layers, weights, biases);
        const Inputs input{parts, inputs, part_widths};
        for_ranges(threads, count, FORWARD_ROWS, [&](int64_t begin, int64_t end) {
            take_through(net, input, begin, end, activation, out, density, [](int64_t, int, const Block&) {});
        });
    });
}

// The gradients of the output, `grad`, and of the density may be null.
// Writes the inputs' gradients (parts that are null are left out) and the weights', (outputs, inputs) like them.
EXPORT int mlp_backward(const float* const* inputs, const int64_t* part_widths, int parts, int64_t count,
                        const int64_t* widths, int layers, const float* const* weights, const float* const* biases,
                        int activation, const float* grad, const float* density, const float* density_grad,
                        float* const* input_grads, float* const* weight_grads, float* const* bias_grads, int threads) {
    return guarded([&] {
        check_sizes(widths, layers);
        const Network net(widths, layers, weights, biases);
        const Inputs input{parts, inputs, part_widths};
        const Incoming incoming{grad, density, density_grad, net.width[layers]};
        WeightSums sums(count, layers, net.wide, threads);
        for_chunks(threads, sums.parts, [&](int64_t p, int) {
            sums.clear(p);
            Block block;
            alignas(64) float first[BLOCK * MAX_WIDTH], second[BLOCK * MAX_WIDTH];
            for (int64_t next = sums.begin(p); next < sums.end(p);) {
                int64_t rows[BLOCK];
                const int size = live_rows(incoming, input_grads, input, next, sums.end(p), rows);
                if (size == 0) break;
                input.read(block.layer[0], net.wide[0], rows, size);
                run_forward(net, block);
                read_output_gradient(incoming, net.wide[layers], rows, size, activation, block.layer[layers], first);
                const float* dx = run_backward(net, block, first, second, sums, sums.of(p));
                write_input_gradient(dx, net.wide[0], input, rows, size, input_grads);
            }
        });
        sums.write(net.width, weight_grads, bias_grads);
    });
}
