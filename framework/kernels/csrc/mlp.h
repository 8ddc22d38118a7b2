// What the two forms of the small networks share (mlp.cpp in float32, mlp_bf16.cpp in bfloat16).
#pragma once

#include "common.h"

namespace mlp {

constexpr int BLOCK = 32;
constexpr int MAX_LAYERS = 8;
constexpr int MAX_WIDTH = 384;  // K-Planes' explicit basis; D-NeRF's layer that is fed the encoded position again: 328

inline int padded(int width) { return (width + LANES - 1) / LANES * LANES; }

enum Activation { NONE = 0, RELU = 1, SIGMOID = 2 };

inline void activate(float* values, int64_t count, int activation) {
    for (int64_t i = 0; i < count; i += LANES) {
        Floats v = load(values + i);
        if (activation == RELU) v = v < 0 ? splat(0) : v;
        if (activation == SIGMOID) v = 1 / (1 + exponential(-v));
        store(values + i, v);
    }
}

// Rows of a block plus a layer's bias, `wide` long; ReLU behind it where asked for.
inline void add_bias(float* values, const float* bias, int wide, bool relu) {
    for (int r = 0; r < BLOCK; r++)
        for (int i = 0; i < wide; i += LANES) {
            Floats v = load(values + r * wide + i);
            if (bias) v += load(bias + i);
            if (relu) v = v < 0 ? splat(0) : v;
            store(values + r * wide + i, v);
        }
}

// The bias's gradient: sums over a block's rows.
inline void add_rows(const float* grad, int wide, float* sums) {
    for (int r = 0; r < BLOCK; r++)
        for (int i = 0; i < wide; i += LANES) store(sums + i, load(sums + i) + load(grad + r * wide + i));
}

struct Inputs {  // the network's input, in parts that stand side by side
    int parts;
    const float* const* part;
    const int64_t* width;

    void read(float* to, int wide, const int64_t* rows, int count) const {
        std::memset(to, 0, sizeof(float) * BLOCK * wide);
        for (int r = 0; r < count; r++) {
            float* at = to + r * wide;
            for (int p = 0; p < parts; at += width[p++])
                std::memcpy(at, part[p] + rows[r] * width[p], sizeof(float) * width[p]);
        }
    }
};

inline bool is_zero(const float* values, int count) {
    for (int i = 0; i < count; i++)
        if (values[i] != 0) return false;
    return true;
}

// The gradient of a block's output, through the output's activation function.
inline void read_output_gradient(const float* grad, int width, int wide, const int64_t* rows, int count,
                                 int activation, const float* output, float* to) {
    std::memset(to, 0, sizeof(float) * BLOCK * wide);
    for (int r = 0; r < count; r++) std::memcpy(to + r * wide, grad + rows[r] * width, sizeof(float) * width);
    if (activation == NONE) return;
    for (int i = 0; i < BLOCK * wide; i += LANES) {
        Floats g = load(to + i), raw = load(output + i);
        if (activation == RELU) g = raw > 0 ? g : splat(0);
        if (activation == SIGMOID) {
            const Floats y = 1 / (1 + exponential(-raw));
            g = g * y * (1 - y);
        }
        store(to + i, g);
    }
}

// Up to BLOCK rows of [next, end) whose gradient is not zero; the input gradient of the others is set to zero.
inline int live_rows(const float* grad, int outputs, float* const* input_grads, const Inputs& input, int64_t& next,
                     int64_t end, int64_t* rows) {
    int size = 0;
    for (; next < end && size < BLOCK; next++) {
        if (!is_zero(grad + next * outputs, outputs)) {
            rows[size++] = next;
            continue;
        }
        for (int p = 0; p < input.parts; p++)
            if (input_grads[p]) std::memset(input_grads[p] + next * input.width[p], 0, sizeof(float) * input.width[p]);
    }
    return size;
}

// Rows of the input's gradient (wide apart) to where they belong.
inline void write_input_gradient(const float* from, int wide, const Inputs& input, const int64_t* rows, int size,
                                 float* const* input_grads) {
    for (int r = 0; r < size; r++) {
        const float* at = from + r * wide;
        for (int p = 0; p < input.parts; at += input.width[p++])
            if (input_grads[p])
                std::memcpy(input_grads[p] + rows[r] * input.width[p], at, sizeof(float) * input.width[p]);
    }
}

// The sums over threads, (wide inputs, wide outputs) and one more row for the bias each, to the gradients of a layer's
// weights (outputs, inputs) and bias (outputs).
inline void write_weight_gradient(const float* sums, int64_t total, int threads, int in, int wide_in, int out,
                                  int wide_out, float* grad, float* bias_grad) {
    for (int o = 0; bias_grad && o < out; o++) {
        bias_grad[o] = 0;
        for (int t = 0; t < threads; t++) bias_grad[o] += sums[total * t + int64_t(wide_in) * wide_out + o];
    }
    for (int o = 0; o < out; o++)
        for (int i = 0; i < in; i++) {
            float value = 0;
            for (int t = 0; t < threads; t++) value += sums[total * t + i * wide_out + o];
            grad[o * in + i] = value;
        }
}

}  // namespace mlp
