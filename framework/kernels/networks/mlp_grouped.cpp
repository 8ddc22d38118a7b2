// Many small networks of the same shape, each for some of the rows. See grouped.py for the reference.
//
// Rows are sorted by network. The rows of a network pass through its layers in blocks, while its weights are in the
// cache. A network without rows costs nothing. A thread takes a piece of one network's rows at a time; the pieces do
// not depend on the threads, and the sums of a network's pieces are added in order, so the gradient has the same bits
// for any number of threads.
#include "networks/mlp_float32.h"

using namespace mlp;

namespace {

constexpr int64_t PIECE = 32 * BLOCK;  // rows of a piece, unless a limit below requires more

struct Groups {  // rows sorted by network
    const int64_t* order;     // rows, network by network
    const int32_t* networks;  // the networks that have rows
    const int64_t* starts;    // of each network's rows in `order`, and the end
    int64_t count;            // networks that have rows
};

struct Piece {
    int64_t group, begin, end;  // begin and end in the groups' order
    int64_t shared;             // place among the sums of networks with several pieces; -1 if it is the only piece
};

struct Pieces {
    std::vector<Piece> all;
    int64_t shared = 0;  // pieces of networks with several

    Pieces(const Groups& groups, int64_t most) {
        all.reserve(size_t(groups.count));
        for (int64_t g = 0; g < groups.count; g++) {
            const int64_t end = groups.starts[g + 1];
            const bool alone = end - groups.starts[g] <= most;
            for (int64_t begin = groups.starts[g]; begin < end; begin += most)
                all.push_back({g, begin, std::min(end, begin + most), alone ? -1 : shared++});
        }
    }
    int64_t count() const { return int64_t(all.size()); }
};

// A table with a row of parameters for each network: per layer the weights (outputs, inputs) and the biases (outputs).
struct Layout {
    int layers;
    int64_t size = 0;  // floats of a row
    int64_t weight[MAX_LAYERS], bias[MAX_LAYERS];

    Layout(const int64_t* widths, int layers) : layers(layers) {
        for (int l = 0; l < layers; l++) {
            weight[l] = size;
            bias[l] = weight[l] + widths[l] * widths[l + 1];
            size = bias[l] + widths[l + 1];
        }
    }
};

template <typename Value>
struct Parameters {  // those of one network in a row of a table
    Value* weights[MAX_LAYERS] = {};
    Value* biases[MAX_LAYERS] = {};

    Parameters(const Layout& layout, Value* row) {
        for (int l = 0; l < layout.layers; l++) weights[l] = row + layout.weight[l], biases[l] = row + layout.bias[l];
    }
};

// The network that each thread works with; the next piece often belongs to the same one.
class Current {
    const Layout& layout;
    const float* table;
    std::vector<Float::Network> networks;
    std::vector<int64_t> held;

public:
    Current(const int64_t* widths, const Layout& layout, const float* table, int64_t threads)
        : layout(layout), table(table), networks(size_t(threads), Float::Network(widths, layout.layers)),
          held(size_t(threads), -1) {}

    const Float::Network& get(int64_t network, int slot) {
        if (held[size_t(slot)] != network) {
            const Parameters<const float> own(layout, table + network * layout.size);
            networks[size_t(slot)].take(own.weights, own.biases);
            held[size_t(slot)] = network;
        }
        return networks[size_t(slot)];
    }
    const Float::Network& any() const { return networks[0]; }
};

int64_t slots(int threads, const Pieces& pieces) {
    return std::max<int64_t>(std::min<int64_t>(threads, pieces.count()), 1);
}

int in_steps(int rows) { return (rows + ROW_STEP - 1) / ROW_STEP * ROW_STEP; }

void run_forward(const Groups& groups, const Inputs& input, const float* table, const int64_t* widths, int layers,
                 int activation, float* out, float* density, int threads) {
    const Layout layout(widths, layers);
    const Pieces pieces(groups, PIECE);
    Current current(widths, layout, table, slots(threads, pieces));
    const int outputs = int(widths[layers]), columns = padded(outputs);
    for_chunks(threads, pieces.count(), [&](int64_t p, int slot) {
        const Piece& piece = pieces.all[size_t(p)];
        const int64_t network = groups.networks[piece.group];
        const Float::Network& net = current.get(network, slot);
        Float::Block block;
        for (int64_t first = piece.begin; first < piece.end; first += BLOCK) {
            const int size = int(std::min<int64_t>(piece.end - first, BLOCK)), count = in_steps(size);
            const int64_t* rows = groups.order + first;
            Float::read_input(net, input, rows, size, block);
            Float::run_forward(net, block, count);
            float* last = block.output(net);
            if (density) {
                float values[BLOCK];
                write_density(last, columns, size, values);
                for (int r = 0; r < size; r++) density[rows[r]] = values[r], last[r * columns] = float(network);
            }
            activate(last, count * columns, activation);
            for (int r = 0; r < size; r++)
                std::memcpy(out + rows[r] * outputs, last + r * columns, sizeof(float) * outputs);
        }
    });
}

void run_backward(const Groups& groups, const Inputs& input, const float* table, const int64_t* widths, int layers,
                  int activation, const Incoming& incoming, float* const* input_grads, float* table_grad,
                  int threads) {
    constexpr int64_t MOST_SHARED = 1 << 22;  // about half of the floats of all sums of networks with several pieces
    const Layout layout(widths, layers);
    int columns[MAX_LAYERS + 1];
    for (int l = 0; l <= layers; l++) columns[l] = padded(int(widths[l]));
    const Sums places(layers, columns);
    const int64_t size = int64_t(places.size), count = groups.count ? groups.starts[groups.count] : 0;
    const Pieces pieces(groups, std::max(PIECE, count * size / MOST_SHARED));
    Current current(widths, layout, table, slots(threads, pieces));
    std::vector<float> own(size_t(slots(threads, pieces) * size)), shared(size_t(pieces.shared * size));
    bool to_input = false;
    for (int p = 0; p < input.parts; p++) to_input |= input_grads[p] != nullptr;
    const auto write = [&](int64_t group, float* sums, int64_t parts, int using_threads) {
        const Parameters<float> grads(layout, table_grad + group * layout.size);
        places.write(sums, parts, using_threads, current.any().width, grads.weights, grads.biases);
    };

    for_chunks(threads, pieces.count(), [&](int64_t p, int slot) {
        const Piece& piece = pieces.all[size_t(p)];
        const Float::Network& net = current.get(groups.networks[piece.group], slot);
        const bool alone = piece.shared < 0;
        float* sums = alone ? own.data() + slot * size : shared.data() + piece.shared * size;
        if (alone) std::fill_n(sums, size, 0.0f);
        Float::Block block;
        Float::Gradient gradient;
        for (int64_t next = piece.begin; next < piece.end;) {
            int64_t rows[BLOCK];
            const int live = live_rows(incoming, input_grads, input, groups.order, next, piece.end, rows);
            if (live == 0) break;
            const int in_use = in_steps(live);
            Float::read_input(net, input, rows, live, block);
            Float::run_forward(net, block, in_use);
            float* start = Float::start(block, gradient);
            read_output_gradient(incoming, columns[layers], rows, live, activation, block.output(net), start);
            for (int r = 0; incoming.density && r < live; r++)  // the first output is only the density's
                start[r * columns[layers]] =
                    incoming.density_grad ? incoming.density_grad[rows[r]] * incoming.density[rows[r]] : 0;
            const float* dx = Float::run_backward(net, block, gradient, places, sums, in_use, to_input);
            if (to_input) write_input_gradient(dx, columns[0], input, rows, live, input_grads);
        }
        if (alone && table_grad) write(piece.group, sums, 1, 1);
    });

    for (size_t p = 0; table_grad && p < pieces.all.size();) {
        const Piece& piece = pieces.all[p];
        int64_t parts = 1;
        while (p + size_t(parts) < pieces.all.size() && pieces.all[p + size_t(parts)].group == piece.group) parts++;
        if (piece.shared >= 0) write(piece.group, shared.data() + piece.shared * size, parts, threads);
        p += size_t(parts);
    }
}

}  // namespace

// Sorts rows by their networks, `owners` (count); rows of a network keep their order. Writes the sorted rows, `order`
// (count), the networks that have rows, `used` (groups), and the start of each network's rows in `order`, and the end,
// `starts` (groups + 1). `groups`: number of networks that have rows.
EXPORT int group_rows(const int64_t* owners, int64_t count, int64_t networks, int64_t* order, int32_t* used,
                      int64_t* starts, int64_t* groups) {
    return guarded([&] {
        if (networks > INT32_MAX) throw std::invalid_argument("there are more than 2^31 - 1 networks");
        std::vector<int64_t> next(size_t(networks), 0);  // first the numbers of rows, then the place of the next row
        for (int64_t n = 0; n < count; n++) {
            check_index(owners[n], networks, "networks");
            next[size_t(owners[n])]++;
        }
        int64_t place = 0, found = 0;
        for (int64_t network = 0; network < networks; network++) {
            const int64_t rows = next[size_t(network)];
            next[size_t(network)] = place;
            if (rows == 0) continue;
            used[found] = int32_t(network);
            starts[found++] = place;
            place += rows;
        }
        starts[found] = place;
        for (int64_t n = 0; n < count; n++) order[next[size_t(owners[n])]++] = n;
        *groups = found;
    });
}

// The input is `parts` arrays (rows, part_widths[p]) side by side, with rows part_strides[p] apart. order, networks and
// starts come from group_rows. table (networks, parameters): a row for each network, as in Layout.
// widths: of the input and every layer. out (rows, outputs). density (rows), or null: exp of the first output,
// clamped at exp(15); the number of the network then takes the place of the first output.
EXPORT int grouped_mlp_forward(const float* const* inputs, const int64_t* part_widths, const int64_t* part_strides,
                               int parts, const int64_t* order, const int32_t* networks, const int64_t* starts,
                               int64_t groups, const float* table, const int64_t* widths, int layers, int activation,
                               float* out, float* density, int threads) {
    return guarded([&] {
        check_sizes(widths, layers);
        run_forward({order, networks, starts, groups}, {parts, inputs, part_widths, part_strides}, table, widths,
                    layers, activation, out, density, threads);
    });
}

// The gradients of the output, `grad`, and of the density may be null. If there is a density, the gradient of the first
// output is not used. Writes the gradients of the inputs (null parts are skipped) and, unless it is null, the gradients
// of the table's rows of `networks`: table_grad (groups, parameters).
EXPORT int grouped_mlp_backward(const float* const* inputs, const int64_t* part_widths, const int64_t* part_strides,
                                int parts, const int64_t* order, const int32_t* networks, const int64_t* starts,
                                int64_t groups, const float* table, const int64_t* widths, int layers, int activation,
                                const float* grad, const float* density, const float* density_grad,
                                float* const* input_grads, float* table_grad, int threads) {
    return guarded([&] {
        check_sizes(widths, layers);
        run_backward({order, networks, starts, groups}, {parts, inputs, part_widths, part_strides}, table, widths,
                     layers, activation, {grad, density, density_grad, int(widths[layers])}, input_grads, table_grad,
                     threads);
    });
}
