// Tracing rays: marching, encoding and the density network in one call. See trace.py for the reference.
//
// A block of rays passes through all its waves on one thread, so that only samples reached by light leave the cache,
// and no thread waits for another between waves. A sample's values do not depend on the rest of its batch, so results
// do not depend on blocks or threads.
#include "traced/trace.h"

#include <numeric>

using namespace tracing;

namespace {

constexpr size_t KEPT = 1 << 25;  // floats kept per thread between calls: new memory costs page faults

struct Block {
    int slot = 0;
    int64_t begin = 0, count = 0;
};

struct Traced {  // traced results that the caller has not taken yet
    std::vector<Samples> samples;  // of each thread
    std::vector<Block> blocks;
    std::vector<int32_t> counts;  // (R) samples that light reached
    int64_t rays = 0, total = -1, inputs = 0, width = 0;
    bool keep = false;
};

Traced& traced() {
    static thread_local Traced of_caller;
    return of_caller;
}

}  // namespace

// Samples of all waves, as in march_wave and march_advance, with the density of a network on a hash grid
// (grid_density.h). `total`: number of samples reached by light, which trace_take returns. The other parameters are as
// in march_wave, hash_grid_forward and mlp_forward. keep: whether trace_take will be called with features.
EXPORT int trace_rays(const float* origins, const float* directions, const float* enter, const float* leave,
                      const float* first, const int64_t* slices, int64_t rays, const int64_t* limits, int waves,
                      const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                      int resolution, int boxes, float budget, const float* scale, const float* shift,
                      const float* around, const float* table, int features, const int64_t* resolutions,
                      const int64_t* offsets, int levels,
                      const int64_t* widths, int layers, const float* const* weights, int bf16, int keep, int threads,
                      int64_t* total) {
    return guarded([&] {
        const Path path{origins, directions, enter, leave,  first,      slices, limits, waves,
                        box,     step,       cone,  bits,   blocks,     resolution, boxes, budget};
        const Density density(scale, shift, around, table, features, resolutions, offsets, levels, widths, layers,
                              weights, bf16);
        Traced& all = traced();
        all.total = -1;
        all.inputs = density.inputs, all.width = density.width, all.rays = rays, all.keep = keep != 0;
        if (all.samples.size() < size_t(std::max(threads, 1))) all.samples.resize(size_t(std::max(threads, 1)));
        for (Samples& samples : all.samples) samples.clear();
        all.blocks.assign(size_t((rays + RAYS - 1) / RAYS), Block());
        all.counts.assign(size_t(rays), 0);
        for_chunks(threads, int64_t(all.blocks.size()), [&](int64_t b, int slot) {
            Samples& samples = all.samples[size_t(slot)];
            const int64_t begin = samples.used, base = b * RAYS;
            trace_block(path, density, base, std::min(rays, base + RAYS), all.keep, false, samples, &all.counts[base]);
            all.blocks[size_t(b)] = {slot, begin, samples.used - begin};
        });
        *total = all.total = std::accumulate(all.counts.begin(), all.counts.end(), int64_t(0));
    });
}

// The result of trace_rays, ray by ray: offsets (R + 1), starts, ends, owners and density (N), unit (N, 3), outputs (N,
// D) and, unless null, features (N, E).
EXPORT int trace_take(int64_t rays, int64_t total, int64_t* offsets, float* starts, float* ends, int64_t* owners,
                      float* unit, float* features, float* outputs, float* density, int threads) {
    return guarded([&] {
        Traced& all = traced();
        if (all.total != total || all.rays != rays || (features && !all.keep))
            throw std::invalid_argument("there is no such trace");
        offsets[0] = 0;
        for (int64_t r = 0; r < rays; r++) offsets[r + 1] = offsets[r] + all.counts[size_t(r)];
        for_chunks(threads, int64_t(all.blocks.size()), [&](int64_t b, int) {
            const Block& block = all.blocks[size_t(b)];
            const Samples& from = all.samples[size_t(block.slot)];
            int64_t at[RAYS];
            const int64_t base = b * RAYS;
            for (int64_t r = base; r < std::min(rays, base + RAYS); r++) at[r - base] = offsets[r];
            for (size_t n = size_t(block.begin); n < size_t(block.begin + block.count); n++) {
                if (!from.reached[n]) continue;
                const int64_t to = at[from.rays[n] - base]++;
                starts[to] = from.starts[n], ends[to] = from.ends[n], density[to] = from.density[n];
                owners[to] = from.rays[n];
                std::memcpy(unit + to * 3, &from.unit[n * 3], sizeof(float) * 3);
                std::memcpy(outputs + to * all.width, &from.outputs[n * size_t(all.width)],
                            sizeof(float) * size_t(all.width));
                if (features)
                    std::memcpy(features + to * all.inputs, &from.features[n * size_t(all.inputs)],
                                sizeof(float) * size_t(all.inputs));
            }
        });
        all.total = -1;
        for (Samples& samples : all.samples)
            if (samples.features.size() + samples.outputs.size() > KEPT) samples = Samples();
    });
}
