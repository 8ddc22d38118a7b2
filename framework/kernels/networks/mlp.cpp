// Small fully connected networks, ReLU between layers, in float32. See mlp.py for the reference.
//
// Samples pass through all layers in blocks that stay in cache; only the result leaves it. The backward pass recomputes
// a block's hidden layers, which costs less than writing them to memory and reading them back. Samples with zero
// incoming gradient (hidden ones) are skipped.
#include "networks/mlp_calls.h"
#include "networks/mlp_float32.h"

using namespace mlp;

std::unique_ptr<Layers> mlp::layers_of(const int64_t* widths, int layers, const float* const* weights) {
    return without_biases<Float>(widths, layers, weights);
}

#if !defined(__AVX512BF16__)
std::unique_ptr<Layers> mlp::layers_bf16_of(const int64_t*, int, const float* const*) {
    throw std::invalid_argument("this processor does not multiply in bfloat16");
}
#endif

// The input is `parts` arrays (count, part_widths[p]) side by side; widths: of the input and every layer.
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
