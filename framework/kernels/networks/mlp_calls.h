// The calls of a network, written once for both forms (mlp_float32.h in float32, mlp_bf16.cpp in bfloat16).
//
// A form has
//   Value, the type of an activation;
//   Prepared, an object on the stack of a thread while it computes;
//   Network(widths, layers, weights, biases): `width` of the input and of each layer, padded to `rows` for a row of
//     activations and to `columns` for a row of sums;
//   Block, the activations of BLOCK rows: layer[l] is the input of layer l, output(network) the last layer's output,
//     before its activation function;
//   Gradient, memory of the backward pass; start(block, gradient) takes the output's gradient;
//   read_input and run_forward, which fill a block, and run_backward, which adds to `sums` and returns the gradient of
//     the input (columns wide).
#pragma once

#include "networks/mlp.h"

namespace mlp {

// Computes the output and the density, which may be null, of the rows [begin, end) of the input. each(first, size,
// block) is called for every block.
template <typename Form, typename Each>
void take_through(const typename Form::Network& net, const Inputs& input, int64_t begin, int64_t end, int activation,
                  float* out, float* density, const Each& each) {
    const int outputs = net.width[net.layers], columns = net.columns[net.layers];
    [[maybe_unused]] const typename Form::Prepared prepared{};
    typename Form::Block block;
    for (int64_t first = begin; first < end; first += BLOCK) {
        const int size = int(std::min<int64_t>(end - first, BLOCK));
        int64_t rows[BLOCK];
        for (int r = 0; r < size; r++) rows[r] = first + r;
        Form::read_input(net, input, rows, size, block);
        Form::run_forward(net, block);
        each(first, size, block);
        float* last = block.output(net);
        if (density) write_density(last, columns, size, density + first);
        activate(last, BLOCK * columns, activation);
        for (int r = 0; r < size; r++)
            std::memcpy(out + rows[r] * outputs, last + r * columns, sizeof(float) * outputs);
    }
}

template <typename Form>
struct LayersOf final : Layers {
    using Value = typename Form::Value;
    using Block = typename Form::Block;

    typename Form::Network net;
    Sums places;
    size_t values = 0;  // values in a record

    LayersOf(const int64_t* widths, int layers, const float* const* weights, const float* const* biases)
        : net(widths, layers, weights, biases), places(layers, net.columns) {
        for (int l = 0; l < layers; l++) values += size_t(net.rows[l]);
    }
    size_t record() const override { return values * sizeof(Value); }
    size_t sums() const override { return places.size; }

    void forward(const float* in, int64_t count, int activation, float* out, float* density,
                 char* records) const override {
        const int64_t width = net.width[0];
        take_through<Form>(net, Inputs{1, &in, &width}, 0, count, activation, out, density,
                           [&](int64_t first, int size, const Block& block) {
                               for (int r = 0; records && r < size; r++) {
                                   Value* to = (Value*)records + size_t(first + r) * values;
                                   for (int l = 0; l < net.layers; to += net.rows[l++])
                                       std::memcpy(to, block.layer[l] + r * net.rows[l], sizeof(Value) * net.rows[l]);
                               }
                           });
    }
    void backward(const char* records, const int64_t* rows, int count, const float* grad, float* sums,
                  float* input_grad) const override {
        const int outputs = net.width[net.layers], columns = net.columns[net.layers], inputs = net.width[0];
        [[maybe_unused]] const typename Form::Prepared prepared{};
        Block block;
        typename Form::Gradient gradient;
        float* start = Form::start(block, gradient);
        for (int l = 0; l < net.layers; l++) std::memset(block.layer[l], 0, sizeof(Value) * BLOCK * net.rows[l]);
        std::memset(start, 0, sizeof(float) * BLOCK * columns);
        for (int r = 0; r < count; r++) {
            const Value* from = (const Value*)records + size_t(rows[r]) * values;
            for (int l = 0; l < net.layers; from += net.rows[l++])
                std::memcpy(block.layer[l] + r * net.rows[l], from, sizeof(Value) * net.rows[l]);
            std::memcpy(start + r * columns, grad + r * outputs, sizeof(float) * outputs);
        }
        const float* dx = Form::run_backward(net, block, gradient, places, sums);
        for (int r = 0; r < count; r++)
            std::memcpy(input_grad + r * inputs, dx + r * net.columns[0], sizeof(float) * inputs);
    }
    void write(float* sums, int64_t parts, int threads, float* const* weight_grads) const override {
        places.write(sums, parts, threads, net.width, weight_grads, nullptr);
    }
};

template <typename Form>
std::unique_ptr<Layers> without_biases(const int64_t* widths, int layers, const float* const* weights) {
    check_sizes(widths, layers);
    const float* none[MAX_LAYERS] = {};
    return std::make_unique<LayersOf<Form>>(widths, layers, weights, none);
}

// Like mlp_forward.
template <typename Form>
void forward(const Inputs& input, int64_t count, const int64_t* widths, int layers, const float* const* weights,
             const float* const* biases, int activation, float* out, float* density, int threads) {
    check_sizes(widths, layers);
    const typename Form::Network net(widths, layers, weights, biases);
    for_ranges(threads, count, FORWARD_ROWS, [&](int64_t begin, int64_t end) {
        take_through<Form>(net, input, begin, end, activation, out, density,
                           [](int64_t, int, const typename Form::Block&) {});
    });
}

// Like mlp_backward.
template <typename Form>
void backward(const Inputs& input, int64_t count, const int64_t* widths, int layers, const float* const* weights,
              const float* const* biases, int activation, const float* grad, const float* density,
              const float* density_grad, float* const* input_grads, float* const* weight_grads,
              float* const* bias_grads, int threads) {
    check_sizes(widths, layers);
    const typename Form::Network net(widths, layers, weights, biases);
    const Incoming incoming{grad, density, density_grad, net.width[layers]};
    WeightSums sums(count, layers, net.columns, threads);
    for_chunks(threads, sums.parts, [&](int64_t p, int) {
        sums.clear(p);
        [[maybe_unused]] const typename Form::Prepared prepared{};
        typename Form::Block block;
        typename Form::Gradient gradient;
        for (int64_t next = sums.begin(p); next < sums.end(p);) {
            int64_t rows[BLOCK];
            const int size = live_rows(incoming, input_grads, input, nullptr, next, sums.end(p), rows);
            if (size == 0) break;
            Form::read_input(net, input, rows, size, block);
            Form::run_forward(net, block);
            read_output_gradient(incoming, net.columns[layers], rows, size, activation, block.output(net),
                                 Form::start(block, gradient));
            const float* dx = Form::run_backward(net, block, gradient, sums, sums.of(p));
            write_input_gradient(dx, net.columns[0], input, rows, size, input_grads);
        }
    });
    sums.write(net.width, weight_grads, bias_grads);
}

}  // namespace mlp
