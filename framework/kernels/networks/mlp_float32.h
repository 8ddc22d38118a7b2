// The float32 form of small networks (mlp_calls.h), for mlp.cpp and mlp_grouped.cpp.
#pragma once

#include "networks/mlp.h"
#include "networks/products.h"

#include <utility>
#include <vector>

namespace mlp {

struct Float {
    typedef float Value;
    struct Prepared {};

    struct Network {
        int layers;
        int width[MAX_LAYERS + 1] = {};
        int rows[MAX_LAYERS + 1] = {}, columns[MAX_LAYERS + 1] = {};  // width in whole vectors, both
        std::vector<float> forward[MAX_LAYERS];   // (padded inputs, padded outputs), zeros outside
        std::vector<float> backward[MAX_LAYERS];  // (padded outputs, padded inputs)
        std::vector<float> bias[MAX_LAYERS];      // (padded outputs), or none

        // Without weights, until `take`.
        Network(const int64_t* widths, int count) : layers(count) {
            for (int l = 0; l <= layers; l++) width[l] = int(widths[l]), rows[l] = columns[l] = padded(width[l]);
            for (int l = 0; l < layers; l++) {
                forward[l].assign(size_t(rows[l]) * rows[l + 1], 0);
                backward[l].assign(size_t(rows[l]) * rows[l + 1], 0);
            }
        }
        Network(const int64_t* widths, int count, const float* const* weights, const float* const* biases)
            : Network(widths, count) {
            take(weights, biases);
        }
        // Replaces the weights (outputs, inputs) and biases (outputs) of all layers; a bias may be null.
        void take(const float* const* weights, const float* const* biases) {
            for (int l = 0; l < layers; l++) {
                const int in = rows[l], out = rows[l + 1], inputs = width[l], outputs = width[l + 1];
                if (biases[l]) {
                    bias[l].assign(out, 0);
                    std::memcpy(bias[l].data(), biases[l], sizeof(float) * outputs);
                }
                float *down = forward[l].data(), *up = backward[l].data();
                for (int i = 0; i < inputs; i++)
                    for (int o = 0; o < outputs; o++) down[i * out + o] = weights[l][o * inputs + i];
                for (int o = 0; o < outputs; o++)
                    std::memcpy(up + o * in, weights[l] + o * inputs, sizeof(float) * inputs);
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

    // Not inline, because they are called from several places. `count` is the number of rows in use, a multiple of
    // ROW_STEP. to_input: whether the gradient of the input is needed; without it the result is undefined.
    __attribute__((noinline)) static void run_forward(const Network& net, Block& block, int count = BLOCK) {
        for (int l = 0; l < net.layers; l++) {
            const int in = net.rows[l], out = net.rows[l + 1];
            product(block.layer[l], in, net.forward[l].data(), net.width[l], out, block.layer[l + 1], out, count);
            if (l + 1 < net.layers || net.bias_of(l))
                add_bias(block.layer[l + 1], net.bias_of(l), out, l + 1 < net.layers, count);
        }
    }

    __attribute__((noinline)) static const float* run_backward(const Network& net, const Block& block,
                                                               Gradient& gradient, const Sums& places, float* sums,
                                                               int count = BLOCK, bool to_input = true) {
        float *grad = gradient.first, *other = gradient.second;
        for (int l = net.layers - 1; l >= 0; l--) {
            const int in = net.rows[l], out = net.rows[l + 1];
            float* sum = sums + places.first[l];
            outer_product(block.layer[l], in, grad, out, in, sum, out, count);
            if (net.bias_of(l)) add_rows(grad, out, sum + in * out, count);
            if (l == 0 && !to_input) break;
            product(grad, out, net.backward[l].data(), net.width[l + 1], in, other, in, count);
            if (l > 0)
                for (int i = 0; i < count * in; i += LANES)
                    store(other + i, load(block.layer[l] + i) > 0 ? load(other + i) : splat(0));
            std::swap(grad, other);
        }
        return grad;
    }
};

}  // namespace mlp
