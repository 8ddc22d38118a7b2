// Tracing rays: marching, encoding and the density network in one call. See ../trace.py for the reference.
//
// A chunk of rays goes through all of its waves on one thread, so that nothing but the samples that light reached leaves
// the cache, and no thread waits for another between waves. A sample's values do not depend on what it is computed with,
// so neither do results on chunks or threads.
#include "hash_grid.h"
#include "march.h"
#include "mlp.h"

using namespace marching;

namespace {

constexpr int64_t RAYS = 256;       // of a chunk
constexpr size_t KEPT = 1 << 25;    // floats that a thread's samples keep between calls, for fresh memory costs faults

struct Store {  // samples that a thread has evaluated
    std::vector<float> starts, ends, unit, features, outputs, density;
    std::vector<int32_t> rays;
    std::vector<uint8_t> reached;
    int64_t used = 0;

    void room(int64_t count, int64_t inputs, int64_t width, bool keep) {
        const size_t all = size_t(used + count);
        for (auto [values, size] : {std::pair{&unit, all * 3}, {&outputs, all * width}, {&density, all},
                                    {&features, (keep ? all : size_t(count)) * inputs}})
            if (values->size() < size) values->resize(size + size / 2);
    }
};

struct Chunk {
    int slot = 0;
    int64_t begin = 0, count = 0, kept = 0;
};

struct Traced {  // what a caller has traced and not yet taken
    std::vector<Store> stores;
    std::vector<Chunk> chunks;
    std::vector<int32_t> counts;  // (R) samples that light reached
    int64_t rays = 0, total = -1, inputs = 0, width = 0;
    bool keep = false;
};

Traced& traced() {
    static thread_local Traced of_caller;
    return of_caller;
}

}  // namespace

// Samples of all waves, as march_wave and march_advance find them, with the density of a network on a hash grid at
// positions * scale + shift. `total`: samples that light reached, which trace_take returns. The other parameters are as
// in march_wave, hash_grid_forward and mlp_forward. keep: whether trace_take will be asked for features.
EXPORT int trace_rays(const float* origins, const float* directions, const float* enter, const float* leave,
                      const float* first, const int64_t* slices, int64_t rays, const int64_t* limits, int waves,
                      const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                      int resolution, int boxes, float budget, const float* scale, const float* shift,
                      const float* table, int features, const int64_t* resolutions, const int64_t* offsets, int levels,
                      const int64_t* widths, int layers, const float* const* weights, const float* const* biases,
                      int bf16, int keep, int threads, int64_t* total) {
    return guarded([&] {
        const int side = (resolution + BLOCK - 1) / BLOCK;
        const int64_t bytes = (int64_t(resolution) * resolution * resolution + 7) / 8;
        Traced& all = traced();
        all.total = -1;
        all.inputs = int64_t(levels) * features, all.width = widths[layers], all.rays = rays, all.keep = keep != 0;
        if (widths[0] != all.inputs) throw std::invalid_argument("the network does not fit the grid");
        const auto net = bf16 ? mlp::forward_bf16_of(widths, layers, weights, biases)
                              : mlp::forward_of(widths, layers, weights, biases);
        auto encode = grid::encode<2>;
        switch (features) {
            case 1: encode = grid::encode<1>; break;
            case 2: break;
            case 4: encode = grid::encode<4>; break;
            case 8: encode = grid::encode<8>; break;
            default: throw std::invalid_argument("hash grid: an entry has 1, 2, 4 or 8 features");
        }
        if (all.stores.size() < size_t(std::max(threads, 1))) all.stores.resize(size_t(std::max(threads, 1)));
        for (Store& store : all.stores) store.used = 0, store.starts.clear(), store.ends.clear();
        for (Store& store : all.stores) store.rays.clear(), store.reached.clear();
        all.chunks.assign(size_t((rays + RAYS - 1) / RAYS), Chunk());
        all.counts.assign(size_t(rays), 0);
        for_chunks(threads, int64_t(all.chunks.size()), [&](int64_t c, int slot) {
            Store& store = all.stores[size_t(slot)];
            Chunk& chunk = all.chunks[size_t(c)];
            chunk.slot = slot, chunk.begin = store.used;
            int32_t alive[RAYS], next[RAYS] = {}, counts[RAYS];
            float spent[RAYS] = {};
            int living = 0;
            const int64_t base = c * RAYS, last = std::min(rays, base + RAYS);
            for (int64_t r = base; r < last; r++)
                if (leave[r] > enter[r]) alive[living++] = int32_t(r - base);
            for (int wave = 0; living > 0; wave++) {
                const int limit = int(limits[std::min(wave, waves - 1)]);
                const int64_t from = store.used;
                for (int i = 0; i < living; i++) {
                    const int64_t r = base + alive[i], slice = slices ? slices[r] : 0;
                    const Grid cells{bits + slice * bytes, blocks + slice * side * side * side, resolution, side};
                    const Ray ray(origins + r * 3, directions + r * 3, box, resolution);
                    const Steps steps(first[r], step, cone);
                    counts[i] = march_ray(ray, steps, cells, boxes, enter[r], leave[r], limit, next[alive[i]],
                                          store.starts, store.ends);
                    store.rays.insert(store.rays.end(), size_t(counts[i]), int32_t(r));
                }
                const int64_t count = int64_t(store.starts.size()) - from;
                store.room(count, all.inputs, all.width, all.keep);
                float* unit = store.unit.data() + from * 3;
                for (int64_t n = 0; n < count; n++) {
                    const int64_t r = store.rays[size_t(from + n)];
                    const float t = (store.starts[size_t(from + n)] + store.ends[size_t(from + n)]) / 2;
                    for (int a = 0; a < 3; a++)
                        unit[n * 3 + a] = (origins[r * 3 + a] + t * directions[r * 3 + a]) * scale[a] + shift[a];
                }
                float* encoded = store.features.data() + (all.keep ? from * all.inputs : 0);
                for (int64_t n = 0; n < count; n += grid::CHUNK)
                    encode(unit, n, std::min(count, n + grid::CHUNK), table, resolutions, offsets, levels, encoded);
                float* density = store.density.data() + from;
                net->run(encoded, count, store.outputs.data() + from * all.width, density);
                int on = 0;
                int64_t n = from;
                for (int i = 0; i < living; i++) {
                    const int ray = alive[i];
                    float tau = spent[ray];
                    for (int s = 0; s < counts[i]; s++, n++) {
                        const bool reached = !(tau >= budget);  // NaN goes on: a broken field must be seen
                        store.reached.push_back(reached);
                        all.counts[size_t(base + ray)] += reached;
                        chunk.kept += reached;
                        tau += store.density[size_t(n)] * (store.ends[size_t(n)] - store.starts[size_t(n)]);
                    }
                    spent[ray] = tau;
                    if (counts[i] == limit && !(tau >= budget)) alive[on++] = ray;
                }
                living = on;
                store.used += count;
            }
            chunk.count = store.used - chunk.begin;
        });
        int64_t sum = 0;
        for (const Chunk& chunk : all.chunks) sum += chunk.kept;
        *total = all.total = sum;
    });
}

// What trace_rays has found, ray by ray: offsets (R + 1), starts, ends, owners and density (N), unit (N, 3), outputs
// (N, D) and, unless null, features (N, E).
EXPORT int trace_take(int64_t rays, int64_t total, int64_t* offsets, float* starts, float* ends, int64_t* owners,
                      float* unit, float* features, float* outputs, float* density, int threads) {
    return guarded([&] {
        Traced& all = traced();
        if (all.total != total || all.rays != rays || (features && !all.keep))
            throw std::invalid_argument("there is no such trace");
        offsets[0] = 0;
        for (int64_t r = 0; r < rays; r++) offsets[r + 1] = offsets[r] + all.counts[size_t(r)];
        for_chunks(threads, int64_t(all.chunks.size()), [&](int64_t c, int) {
            const Chunk& chunk = all.chunks[size_t(c)];
            const Store& store = all.stores[size_t(chunk.slot)];
            int64_t at[RAYS];
            const int64_t base = c * RAYS;
            for (int64_t r = base; r < std::min(rays, base + RAYS); r++) at[r - base] = offsets[r];
            for (size_t n = size_t(chunk.begin); n < size_t(chunk.begin + chunk.count); n++) {
                if (!store.reached[n]) continue;
                const int64_t to = at[store.rays[n] - base]++;
                starts[to] = store.starts[n], ends[to] = store.ends[n], density[to] = store.density[n];
                owners[to] = store.rays[n];
                std::memcpy(unit + to * 3, &store.unit[n * 3], sizeof(float) * 3);
                std::memcpy(outputs + to * all.width, &store.outputs[n * size_t(all.width)], sizeof(float) * size_t(all.width));
                if (features)
                    std::memcpy(features + to * all.inputs, &store.features[n * size_t(all.inputs)],
                                sizeof(float) * size_t(all.inputs));
            }
        });
        all.total = -1;
        for (Store& store : all.stores)
            if (store.features.size() + store.outputs.size() > KEPT) store = Store();
    });
}
