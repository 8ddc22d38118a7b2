// A small network on a hash grid, and the gradient of its first output by the position. See distance.py for the
// equations.
#pragma once

#include "grids/hash_grid.h"
#include "networks/products.h"

#include <memory>
#include <vector>

namespace surfaces {

using mlp::BLOCK;

// The weights of both layers, in whole vectors, with zeros outside.
struct Network {
    int inputs, hidden, outputs, wide[3];
    std::vector<float> first_down, first_up;    // (inputs, hidden) and (hidden, inputs)
    std::vector<float> second_down, second_up;  // (hidden, outputs) and (outputs, hidden)

    Network(int inputs, int hidden, int outputs, const float* first, const float* second)
        : inputs(inputs), hidden(hidden), outputs(outputs),
          wide{mlp::padded(inputs), mlp::padded(hidden), mlp::padded(outputs)} {
        const int64_t sizes[] = {inputs, hidden, outputs};
        mlp::check_sizes(sizes, 2);
        fill(first, inputs, hidden, wide[0], wide[1], first_down, first_up);
        fill(second, hidden, outputs, wide[1], wide[2], second_down, second_up);
    }
    static void fill(const float* weights, int in, int out, int wide_in, int wide_out, std::vector<float>& down,
                     std::vector<float>& up) {
        down.assign(size_t(wide_in) * wide_out, 0);
        up.assign(size_t(wide_in) * wide_out, 0);
        for (int o = 0; o < out; o++)
            for (int i = 0; i < in; i++) down[i * wide_out + o] = up[o * wide_in + i] = weights[o * in + i];
    }
    // The first output's weights of active units, by the hidden layer before ReLU, of one block.
    void outward(const float* before, float* to) const {
        for (int r = 0; r < BLOCK; r++)
            for (int h = 0; h < wide[1]; h += LANES)
                store(to + r * wide[1] + h, load(before + r * wide[1] + h) > 0 ? load(second_up.data() + h) : splat(0));
    }
    // The first output, by the hidden layer (wide[1]) before ReLU of one row.
    float first_output(const float* before) const {
        Floats sum = splat(0);
        for (int h = 0; h < wide[1]; h += LANES) {
            const Floats value = load(before + h);
            sum += (value < 0 ? splat(0) : value) * load(second_up.data() + h);  // NaN stays
        }
        float total = 0;
        for (int lane = 0; lane < LANES; lane++) total += sum[lane];
        return total;
    }
    // Hidden layer (BLOCK, hidden) from inputs (BLOCK, inputs), before ReLU.
    void into_hidden(const float* in, float* to) const {
        mlp::product(in, wide[0], first_down.data(), inputs, wide[1], to, wide[1]);
    }
    void back_to_inputs(const float* from, float* to) const {
        mlp::product(from, wide[1], first_up.data(), hidden, wide[0], to, wide[0]);
    }
};

struct Table {  // of a hash grid
    const float* entries;
    const int64_t *resolutions, *offsets;
    int levels;
};

typedef std::unique_ptr<float[]> Buffer;

inline Buffer buffer(size_t size) { return Buffer(new float[size]); }

// Rows [n, n + size) of `from` (width, `stride` apart) to a block (BLOCK, wide), zeros outside.
inline void read_rows(const float* from, int64_t stride, int width, int size, float* to, int wide) {
    std::memset(to, 0, sizeof(float) * size_t(BLOCK) * wide);
    for (int r = 0; r < size; r++) std::memcpy(to + r * wide, from + r * stride, sizeof(float) * width);
}

inline void write_rows(const float* from, int wide, int width, int size, float* to, int64_t stride) {
    for (int r = 0; r < size; r++) std::memcpy(to + r * stride, from + r * wide, sizeof(float) * width);
}

// The outputs at up to CHUNK positions, and the gradient of the first one: rows (size, outputs + 3). encoded: space for
// (size, inputs).
template <int F>
void outputs_and_gradient(const float* places, int64_t size, const Table& table, const Network& net, float* encoded,
                          float* out) {
    const int64_t width = net.inputs, stride = net.outputs + 3;
    const int* wide = net.wide;
    alignas(64) float in[BLOCK * mlp::MAX_WIDTH], hidden[BLOCK * mlp::MAX_WIDTH], other[BLOCK * mlp::MAX_WIDTH];
    grid::encode<F>(places, 0, size, table.entries, table.resolutions, table.offsets, table.levels, encoded);
    for (int64_t n = 0; n < size; n += BLOCK) {
        const int rows = int(std::min<int64_t>(BLOCK, size - n));
        read_rows(encoded + n * width, width, net.inputs, rows, in, wide[0]);
        net.into_hidden(in, hidden);
        net.outward(hidden, other);
        net.back_to_inputs(other, in);
        write_rows(in, wide[0], net.inputs, rows, encoded + n * width, width);  // the gradient by the encoding
        mlp::activate(hidden, BLOCK * wide[1], mlp::RELU);
        mlp::product(hidden, wide[1], net.second_down.data(), net.hidden, wide[2], other, wide[2]);
        write_rows(other, wide[2], net.outputs, rows, out + n * stride, stride);
    }
    Floats xyz[grid::CHUNK / LANES][3], sum[grid::CHUNK / LANES][3] = {};
    for (int64_t n = 0; n < size; n += LANES)
        grid::load_positions(places, n, grid::block(n, size), xyz[n / LANES]);
    for (int l = 0; l < table.levels; l++) {
        const grid::Level level = grid::level_of(table.resolutions, table.offsets, l);
        const auto run = level.dense ? grid::add_position_gradient<F, true> : grid::add_position_gradient<F, false>;
        run(level, xyz, size, table.entries, encoded + l * F, width, sum);
    }
    for (int64_t n = 0; n < size; n++)
        for (int axis = 0; axis < 3; axis++) out[n * stride + net.outputs + axis] = sum[n / LANES][axis][n % LANES];
}

// The first output alone, (size), at up to CHUNK positions. encoded: space for (size, inputs).
template <int F>
void first_outputs(const float* places, int64_t size, const Table& table, const Network& net, float* encoded,
                   float* out) {
    const int64_t width = net.inputs;
    alignas(64) float in[BLOCK * mlp::MAX_WIDTH], hidden[BLOCK * mlp::MAX_WIDTH];
    grid::encode<F>(places, 0, size, table.entries, table.resolutions, table.offsets, table.levels, encoded);
    for (int64_t n = 0; n < size; n += BLOCK) {
        const int rows = int(std::min<int64_t>(BLOCK, size - n));
        read_rows(encoded + n * width, width, net.inputs, rows, in, net.wide[0]);
        net.into_hidden(in, hidden);
        for (int r = 0; r < rows; r++) out[n + r] = net.first_output(hidden + r * net.wide[1]);
    }
}

}  // namespace surfaces
