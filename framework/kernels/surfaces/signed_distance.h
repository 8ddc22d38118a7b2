// A signed distance: a first shape plus the first output of a small network on a hash grid. See signed_distance.py for
// the reference.
#pragma once

#include "surfaces/first_shape.h"
#include "surfaces/network.h"

namespace surfaces {

// Memory that is used again from chunk to chunk.
struct Space {
    std::vector<float> unit, encoded, rows;
};

struct SignedDistance {
    FirstShape first;
    const float* shift;  // of positions in the unit box, after scaling
    Table table;
    Network net;

    // Distances (count) at positions (count, 3), scene coordinates; CHUNK at most.
    template <int F>
    void values(const float* positions, int64_t count, Space& space, float* out) const {
        prepare(positions, count, space);
        first_outputs<F>(space.unit.data(), count, table, net, space.encoded.data(), out);
        for (int64_t n = 0; n < count; n++) out[n] = first.distance(positions + n * 3, out[n]);
    }
    // Distances, divided by `safety` and by the length of the gradient where that is above 1.
    template <int F>
    void reach(const float* positions, int64_t count, float safety, Space& space, float* out) const {
        const int64_t stride = net.outputs + 3;
        prepare(positions, count, space);
        if (space.rows.size() < size_t(count * stride)) space.rows.resize(size_t(count * stride));
        outputs_and_gradient<F>(space.unit.data(), count, table, net, space.encoded.data(), space.rows.data());
        for (int64_t n = 0; n < count; n++) {
            const float* row = space.rows.data() + n * stride;
            float gradient[3];
            const float distance = first.at(positions + n * 3, row[0], row + net.outputs, gradient);
            const float slope = std::sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1] +
                                          gradient[2] * gradient[2]);
            out[n] = distance / (safety * (slope < 1 ? 1 : slope));  // NaN stays
        }
    }

private:
    void prepare(const float* positions, int64_t count, Space& space) const {
        if (space.unit.size() < size_t(count) * 3) space.unit.resize(size_t(count) * 3);
        if (space.encoded.size() < size_t(count * net.inputs)) space.encoded.resize(size_t(count * net.inputs));
        for (int64_t n = 0; n < count; n++)
            for (int axis = 0; axis < 3; axis++)
                space.unit[size_t(n * 3 + axis)] = positions[n * 3 + axis] * first.scale[axis] + shift[axis];
    }
};

}  // namespace surfaces
