// Tracing of blocks of rays: marching, encoding and the density network. Shared by trace.cpp and traced_error.cpp.
#pragma once

#include "grids/grid_density.h"
#include "march/waves.h"

namespace tracing {

constexpr int64_t RAYS = 256;  // of a block

struct Path {  // rays, and the grid of occupied cells; see march_wave
    const float *origins, *directions, *enter, *leave, *first;
    const int64_t* slices;
    const int64_t* limits;
    int waves;
    const float* box;
    float step, cone;
    const uint8_t *bits, *blocks;
    int resolution, boxes;
    float budget;
};

struct Samples {  // evaluated by a thread
    std::vector<float> starts, ends, unit, features, outputs, density;
    std::vector<char> records;  // of the network, if they are kept
    std::vector<int32_t> rays;
    std::vector<uint8_t> reached;
    int64_t used = 0;

    void clear() {
        used = 0;
        starts.clear(), ends.clear(), rays.clear(), reached.clear();
    }
    void room(int64_t count, const Density& of, bool features_too, bool records_too) {
        const size_t all = size_t(used + count);
        for (auto [values, size] : {std::pair{&unit, all * 3}, {&outputs, all * of.width}, {&density, all},
                                    {&features, (features_too ? all : size_t(count)) * of.inputs}})
            if (values->size() < size) values->resize(size + size / 2);
        const size_t bytes = records_too ? all * of.net->record() : 0;
        if (records.size() < bytes) records.resize(bytes + bytes / 2);
    }
};

// Appends the samples of rays [base, last), RAYS at most, with the features and network records to be kept; adds the
// number of samples reached by light to `reached` of each ray.
inline void trace_block(const Path& path, const Density& of, int64_t base, int64_t last, bool features, bool records,
                        Samples& to, int32_t* reached) {
    const int side = (path.resolution + marching::BLOCK - 1) / marching::BLOCK;
    const int64_t bytes = (int64_t(path.resolution) * path.resolution * path.resolution + 7) / 8;
    int32_t alive[RAYS], next[RAYS] = {}, counts[RAYS];
    float spent[RAYS] = {};
    int living = 0;
    for (int64_t r = base; r < last; r++)
        if (path.leave[r] > path.enter[r]) alive[living++] = int32_t(r - base);
    for (int wave = 0; living > 0; wave++) {
        const int limit = int(path.limits[std::min(wave, path.waves - 1)]);
        const int64_t from = to.used;
        for (int i = 0; i < living; i++) {
            const int64_t r = base + alive[i], slice = path.slices ? path.slices[r] : 0;
            const marching::Grid cells{path.bits + slice * bytes, path.blocks + slice * side * side * side,
                                       path.resolution, side};
            const marching::Ray ray(path.origins + r * 3, path.directions + r * 3, path.box, path.resolution);
            const marching::Steps steps(path.first[r], path.step, path.cone);
            counts[i] = march_ray(ray, steps, cells, path.boxes, path.enter[r], path.leave[r], limit, next[alive[i]],
                                  to.starts, to.ends);
            to.rays.insert(to.rays.end(), size_t(counts[i]), int32_t(r));
        }
        const int64_t count = int64_t(to.starts.size()) - from;
        to.room(count, of, features, records);
        float* unit = to.unit.data() + from * 3;
        for (int64_t n = 0; n < count; n++) {
            const int64_t r = to.rays[size_t(from + n)];
            const float t = (to.starts[size_t(from + n)] + to.ends[size_t(from + n)]) / 2;
            of.place(path.origins + r * 3, path.directions + r * 3, t, unit + n * 3);
        }
        float* encoded = to.features.data() + (features ? from * of.inputs : 0);
        of.evaluate(unit, count, encoded, to.outputs.data() + from * of.width, to.density.data() + from,
                    records ? to.records.data() + size_t(from) * of.net->record() : nullptr);
        int on = 0;
        int64_t n = from;
        for (int i = 0; i < living; i++) {
            const int ray = alive[i];
            float tau = spent[ray];
            for (int s = 0; s < counts[i]; s++, n++) {
                const bool lit = !(tau >= path.budget);  // NaN continues, so that a broken field is noticed
                to.reached.push_back(lit);
                reached[ray] += lit;
                tau += to.density[size_t(n)] * (to.ends[size_t(n)] - to.starts[size_t(n)]);
            }
            spent[ray] = tau;
            if (counts[i] == limit && !(tau >= path.budget)) alive[on++] = ray;
        }
        living = on;
        to.used += count;
    }
}

}  // namespace tracing
