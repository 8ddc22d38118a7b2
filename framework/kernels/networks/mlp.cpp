// Small fully connected networks, ReLU between layers, in float32. See ../mlp.py for the reference.
//
// Samples pass through all layers in blocks that stay in cache; only the result leaves it. The backward pass recomputes
// a block's hidden layers, which costs less than writing them to memory and reading them back. Samples with zero
// incoming gradient (hidden ones) are skipped.
#include "networks/mlp_calls.h"
#include "networks/products.h"

#include <utility>
#include <vector>

using namespace mlp;

namespace {

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
