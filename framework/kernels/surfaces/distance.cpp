// A network on a hash grid with the gradient of its first output, forward and backward. See distance.py for the
// reference and the equations.
#include "grids/hash_grid_tangent.h"
#include "surfaces/network.h"

using namespace grid;
using namespace surfaces;

namespace {

template <int F>
void forward(const float* positions, int64_t count, const Table& table, const Network& net, float* out, int threads) {
    const int64_t stride = net.outputs + 3;
    for_ranges(threads, count, CHUNK, [&](int64_t begin, int64_t end) {
        const Buffer encoded = buffer(size_t((end - begin) * net.inputs));
        outputs_and_gradient<F>(positions + begin * 3, end - begin, table, net, encoded.get(), out + begin * stride);
    });
}

struct Work {  // of one block
    alignas(64) float value[BLOCK * mlp::MAX_WIDTH], along[BLOCK * mlp::MAX_WIDTH];
    alignas(64) float hidden[BLOCK * mlp::MAX_WIDTH], slope[BLOCK * mlp::MAX_WIDTH];
    alignas(64) float outward[BLOCK * mlp::MAX_WIDTH], grad[BLOCK * mlp::MAX_WIDTH], of_hidden[BLOCK * mlp::MAX_WIDTH];
};

// One block of rows: adds to the sums of both layers, and writes the gradients by the encoding and by its derivative.
void backward_block(const Network& net, const mlp::Sums& places, Work& w, float* sums) {
    const int* wide = net.wide;
    net.into_hidden(w.value, w.hidden);
    net.into_hidden(w.along, w.slope);
    net.outward(w.hidden, w.outward);
    mlp::product(w.grad, wide[2], net.second_up.data(), net.outputs, wide[1], w.of_hidden, wide[1]);
    for (int i = 0; i < BLOCK * wide[1]; i += LANES) {
        const auto active = load(w.hidden + i) > 0;
        store(w.of_hidden + i, active ? load(w.of_hidden + i) : splat(0));
        store(w.slope + i, active ? load(w.slope + i) : splat(0));
        store(w.hidden + i, active ? load(w.hidden + i) : splat(0));
    }
    float *of_first = sums + places.first[0], *of_second = sums + places.first[1];
    mlp::outer_product(w.hidden, wide[1], w.grad, wide[2], wide[1], of_second, wide[2]);
    for (int r = 0; r < BLOCK; r++)
        for (int h = 0; h < net.hidden; h++) of_second[h * wide[2]] += w.slope[r * wide[1] + h];
    mlp::outer_product(w.value, wide[0], w.of_hidden, wide[1], wide[0], of_first, wide[1]);
    mlp::outer_product(w.along, wide[0], w.outward, wide[1], wide[0], of_first, wide[1]);
    net.back_to_inputs(w.of_hidden, w.value);
    net.back_to_inputs(w.outward, w.along);
}

template <int F>
void backward(const float* points, const float* grads, int64_t count, const float* table, const int64_t* resolutions,
              const int64_t* offsets, int levels, const Network& net, float* of_encoding, float* of_first,
              float* of_second, int threads) {
    const int64_t width = net.inputs, stride = net.outputs + 3;
    const mlp::WeightSums sums(count, 2, net.wide, threads);
    for_chunks(threads, sums.parts, [&](int64_t part, int) {
        sums.clear(part);
        const auto work = std::make_unique<Work>();
        const Buffer encoded = buffer(size_t(CHUNK * width * 2)), places = buffer(CHUNK * POINT);
        std::vector<int64_t> rows;
        const int64_t begin = sums.begin(part), end = sums.end(part);
        std::memset(of_encoding + begin * width * 2, 0, sizeof(float) * size_t((end - begin) * width * 2));
        rows_with_gradient(grads + begin * stride, end - begin, stride, rows);
        for (int64_t first = 0; first < int64_t(rows.size()); first += CHUNK) {
            const int64_t size = std::min<int64_t>(CHUNK, int64_t(rows.size()) - first);
            for (int64_t n = 0; n < size; n++)
                std::memcpy(places.get() + n * POINT, points + (begin + rows[first + n]) * POINT, sizeof(float) * POINT);
            encode_both<F>(places.get(), size, table, resolutions, offsets, levels, encoded.get());
            for (int64_t n = 0; n < size; n += BLOCK) {
                const int here = int(std::min<int64_t>(BLOCK, size - n));
                const float* from = encoded.get() + n * width * 2;
                read_rows(from, width * 2, net.inputs, here, work->value, net.wide[0]);
                read_rows(from + width, width * 2, net.inputs, here, work->along, net.wide[0]);
                std::memset(work->grad, 0, sizeof(float) * size_t(BLOCK) * net.wide[2]);
                for (int r = 0; r < here; r++)
                    std::memcpy(work->grad + r * net.wide[2], grads + (begin + rows[first + n + r]) * stride,
                                sizeof(float) * net.outputs);
                backward_block(net, sums, *work, sums.of(part));
                for (int r = 0; r < here; r++) {
                    float* to = of_encoding + (begin + rows[first + n + r]) * width * 2;
                    std::memcpy(to, work->value + r * net.wide[0], sizeof(float) * width);
                    std::memcpy(to + width, work->along + r * net.wide[0], sizeof(float) * width);
                }
            }
        }
    });
    const int widths[] = {net.inputs, net.hidden, net.outputs};
    float* const to[] = {of_first, of_second};
    sums.write(widths, to, nullptr);
}

}  // namespace

// out: (count, outputs + 3), the outputs and the gradient of the first one.
EXPORT int distance_network_forward(const float* positions, int64_t count, const float* table, int features,
                                    const int64_t* resolutions, const int64_t* offsets, int levels, const float* first,
                                    int hidden, const float* second, int outputs, float* out, int threads) {
    return guarded([&] {
        const Network net(levels * features, hidden, outputs, first, second);
        const Table hash{table, resolutions, offsets, levels};
#define CALL(F) forward<F>(positions, count, hash, net, out, threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}

// points: (count, 6), positions and the gradients by the gradient. grads: (count, outputs + 3). of_encoding: (count,
// 2 * levels * features), by the features and by their derivatives.
EXPORT int distance_network_backward(const float* points, const float* grads, int64_t count, const float* table,
                                     int features, const int64_t* resolutions, const int64_t* offsets, int levels,
                                     const float* first, int hidden, const float* second, int outputs,
                                     float* of_encoding, float* of_first, float* of_second, int threads) {
    return guarded([&] {
        const Network net(levels * features, hidden, outputs, first, second);
#define CALL(F)                                                                                                  \
    backward<F>(points, grads, count, table, resolutions, offsets, levels, net, of_encoding, of_first, of_second, \
                threads)
        FOR_FEATURES(features, CALL)
#undef CALL
    });
}
