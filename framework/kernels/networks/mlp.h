// Shared by both forms of the small networks: mlp_float32.h in float32, mlp_bf16.cpp in bfloat16. mlp_calls.h combines
// them.
#pragma once

#include "runtime/common.h"

#include <memory>
#include <vector>

namespace mlp {

constexpr int BLOCK = 32;
constexpr int MAX_LAYERS = 8;
constexpr int MAX_WIDTH = 384;  // K-Planes' explicit basis; D-NeRF's skip layer has 328

constexpr int64_t FORWARD_ROWS = 8 * BLOCK;  // rows that a thread processes at a time

inline void check_sizes(const int64_t* widths, int layers) {
    if (layers < 1 || layers > MAX_LAYERS) throw std::invalid_argument("a network has 1 to 8 layers");
    for (int l = 0; l <= layers; l++)
        if (widths[l] < 1 || widths[l] > MAX_WIDTH) throw std::invalid_argument("a layer has 1 to 384 features");
}

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

// Adds a layer's bias to the rows of a block, `wide` long, followed by ReLU if requested.
inline void add_bias(float* values, const float* bias, int wide, bool relu, int rows = BLOCK) {
    for (int r = 0; r < rows; r++)
        for (int i = 0; i < wide; i += LANES) {
            Floats v = load(values + r * wide + i);
            if (bias) v += load(bias + i);
            if (relu) v = v < 0 ? splat(0) : v;
            store(values + r * wide + i, v);
        }
}

// The bias's gradient: sums over a block's rows.
inline void add_rows(const float* grad, int wide, float* sums, int rows = BLOCK) {
    for (int r = 0; r < rows; r++)
        for (int i = 0; i < wide; i += LANES) store(sums + i, load(sums + i) + load(grad + r * wide + i));
}

// The density of a block's first rows, if the first output is its logarithm. See ../math.py (truncated_exp).
inline void write_density(const float* output, int wide, int rows, float* density) {
    constexpr float MAX_LOG_DENSITY = 15;
    alignas(64) float values[BLOCK];
    for (int r = 0; r < BLOCK; r++) values[r] = output[r * wide];
    for (int r = 0; r < BLOCK; r += LANES) {
        const Floats x = load(values + r);
        store(values + r, exponential(x > MAX_LOG_DENSITY ? splat(MAX_LOG_DENSITY) : x));  // NaN stays
    }
    std::memcpy(density, values, sizeof(float) * rows);
}

struct Inputs {  // the network's input, in parts side by side
    int parts;
    const float* const* part;
    const int64_t* width;
    const int64_t* stride = nullptr;  // distance of the rows of each part; null for its width

    void read(float* to, int wide, const int64_t* rows, int count) const {
        std::memset(to, 0, sizeof(float) * BLOCK * wide);
        for (int r = 0; r < count; r++) {
            float* at = to + r * wide;
            for (int p = 0; p < parts; at += width[p++])
                std::memcpy(at, part[p] + rows[r] * (stride ? stride[p] : width[p]), sizeof(float) * width[p]);
        }
    }
};

// A network for other kernels. A record holds a row's input and hidden activations for the backward pass.
struct Layers {
    virtual ~Layers() = default;
    virtual size_t record() const = 0;  // bytes
    virtual size_t sums() const = 0;    // floats of the gradients of all weights
    // Rows of the input (count, inputs) to out (count, outputs) and, unless null, to density (count) and records.
    virtual void forward(const float* in, int64_t count, int activation, float* out, float* density,
                         char* records) const = 0;
    // For up to BLOCK rows with records `rows`: from the gradient (count, outputs) before the output's activation
    // function to the gradient of the input (count, inputs). Adds to `sums`.
    virtual void backward(const char* records, const int64_t* rows, int count, const float* grad, float* sums,
                          float* input_grad) const = 0;
    // The gradients of the weights, from the sums of all parts.
    virtual void write(float* sums, int64_t parts, int threads, float* const* weight_grads) const = 0;
};

std::unique_ptr<Layers> layers_of(const int64_t* widths, int layers, const float* const* weights);
std::unique_ptr<Layers> layers_bf16_of(const int64_t* widths, int layers, const float* const* weights);

inline bool is_zero(const float* values, int count) {
    for (int i = 0; i < count; i++)
        if (values[i] != 0) return false;
    return true;
}

struct Incoming {  // gradients of the output, `width` wide, and of the density (its own derivative); or null
    const float *grad, *density, *density_grad;
    int width;

    bool is_zero_at(int64_t row) const {
        return (!grad || is_zero(grad + row * width, width)) && (!density_grad || density_grad[row] == 0);
    }
    void read(int64_t row, float* to) const {
        if (grad) std::memcpy(to, grad + row * width, sizeof(float) * width);
        if (density_grad) to[0] += density_grad[row] * density[row];
    }
};

// The gradient of a block's output, through the output's activation function.
inline void read_output_gradient(const Incoming& incoming, int wide, const int64_t* rows, int count, int activation,
                                 const float* output, float* to) {
    std::memset(to, 0, sizeof(float) * BLOCK * wide);
    for (int r = 0; r < count; r++) incoming.read(rows[r], to + r * wide);
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

// Up to BLOCK rows with a nonzero gradient of those at [next, end) in `order`, or of [next, end) itself if it is null;
// the input gradient of the others is set to zero.
inline int live_rows(const Incoming& incoming, float* const* input_grads, const Inputs& input, const int64_t* order,
                     int64_t& next, int64_t end, int64_t* rows) {
    int size = 0;
    for (; next < end && size < BLOCK; next++) {
        const int64_t row = order ? order[next] : next;
        if (!incoming.is_zero_at(row)) {
            rows[size++] = row;
            continue;
        }
        for (int p = 0; p < input.parts; p++)
            if (input_grads[p]) std::memset(input_grads[p] + row * input.width[p], 0, sizeof(float) * input.width[p]);
    }
    return size;
}

// Copies rows of the input's gradient (wide apart) to their positions.
inline void write_input_gradient(const float* from, int wide, const Inputs& input, const int64_t* rows, int size,
                                 float* const* input_grads) {
    for (int r = 0; r < size; r++) {
        const float* at = from + r * wide;
        for (int p = 0; p < input.parts; at += input.width[p++])
            if (input_grads[p])
                std::memcpy(input_grads[p] + rows[r] * input.width[p], at, sizeof(float) * input.width[p]);
    }
}

// Sums of the gradients of all weights and biases: per layer (wide inputs, wide outputs), plus one row for the bias.
struct Sums {
    int layers;
    const int* wide;  // widths in whole vectors, of the input and each layer
    size_t size = 0;  // floats
    size_t first[MAX_LAYERS] = {};

    Sums(int layers, const int* wide) : layers(layers), wide(wide) {
        for (int l = 0; l < layers; l++) {
            first[l] = size;
            size += size_t(wide[l] + 1) * size_t(wide[l + 1]);
        }
    }
    // Adds the sums of all parts, in order, to the gradients of the weights (outputs, inputs) and biases (outputs),
    // which may be null.
    void write(float* sums, int64_t parts, int threads, const int* width, float* const* weight_grads,
               float* const* bias_grads) const {
        for_ranges(threads, int64_t(size), 4096, [&](int64_t from, int64_t to) {
            for (int64_t p = 1; p < parts; p++) {
                const float* part = sums + size * size_t(p);
                for (int64_t i = from; i < to; i++) sums[i] += part[i];
            }
        });
        for (int l = 0; l < layers; l++) {
            const float* sum = sums + first[l];
            const int in = width[l], out = width[l + 1], wide_out = wide[l + 1];
            for (int o = 0; o < out; o++)
                for (int i = 0; i < in; i++) weight_grads[l][o * in + i] = parts ? sum[i * wide_out + o] : 0;
            for (int o = 0; bias_grads && bias_grads[l] && o < out; o++)
                bias_grads[l][o] = parts ? sum[size_t(wide[l]) * wide_out + o] : 0;
        }
    }
};

// The gradients of all weights and biases, in one sum per part of the samples. The parts do not depend on the threads
// and are added in order, so the result has the same bits for any number of threads.
struct WeightSums : Sums {
    int64_t parts, rows;  // rows per part
    int threads;
    std::vector<float>& sums;

    // Large networks get fewer parts, because their sums would not stay in cache.
    WeightSums(int64_t count, int layers, const int* wide, int threads)
        : Sums(layers, wide), threads(threads), sums(kept()), count(count) {
        constexpr int64_t ROWS = 1024, FEWEST = 16, FLOATS = 1 << 19;
        const int64_t most = std::max(FEWEST, FLOATS / int64_t(size));
        parts = std::min((count + ROWS - 1) / ROWS, most);
        rows = parts ? ((count + parts - 1) / parts + BLOCK - 1) / BLOCK * BLOCK : 0;
        parts = rows ? (count + rows - 1) / rows : 0;
        if (sums.size() < size * size_t(parts)) sums.resize(size * size_t(parts));
    }
    int64_t begin(int64_t part) const { return part * rows; }
    int64_t end(int64_t part) const { return std::min(count, (part + 1) * rows); }
    float* of(int64_t part) const { return sums.data() + size * size_t(part); }

    void clear(int64_t part) const { std::fill_n(of(part), size, 0.0f); }

    void write(const int* width, float* const* weight_grads, float* const* bias_grads) const {
        Sums::write(sums.data(), parts, threads, width, weight_grads, bias_grads);
    }

private:
    int64_t count;
    static std::vector<float>& kept() {  // per calling thread: new memory costs page faults
        static thread_local std::vector<float> sums;
        return sums;
    }
};

}  // namespace mlp
