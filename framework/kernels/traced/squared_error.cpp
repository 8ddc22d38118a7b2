// The colours of traced rays, and their squared error with its gradient, each in one call. See squared_error.py and
// colors.py for the references.
//
// A block of rays stays on one thread and in cache: through trace_block, the colour network, compositing and the error,
// and back through both networks with the recorded activations. Only the gradient of the encoding, for the hash table,
// and the sums of the weights' gradients leave the cache.
#include "encodings/harmonics.h"
#include "traced/trace.h"

#include <atomic>

using namespace tracing;

namespace {

constexpr int64_t BLOCK_RAYS = 64;  // their samples fit the L2 cache; with 256 a step takes 1.1 times as long
constexpr int64_t PARTS = 64;     // at most, each with its own sums
constexpr size_t KEPT = 1 << 25;  // floats kept per thread between calls: new memory costs page faults

struct Shown {  // by rays: colour over the background (R, 3), opacity, first moment of t, and median of t
    const float *background, *fars;
    float *rgb, *opacity, *moment, *median;
};

struct Pixels {  // of `per_pixel` consecutive rays each
    const float *background, *target, *weights;
    int64_t count, per_pixel;
    float* rgb;
};

struct Thinning {
    float floor;
    uint64_t seed;
};

struct Networks {
    const Density& density;
    const mlp::Layers& color;
    int64_t inputs;  // of the colour network: the density network's outputs, and harmonics of the direction
    int harmonics;
};

struct Part {  // of the rays, processed by a thread
    int slot = 0;
    int64_t begin = 0, count = 0;  // range of its gradients within the thread's
    int64_t samples = 0;
    double error = 0;
};

template <typename Value>
Value* room(std::vector<Value>& values, size_t count) {
    if (values.size() < count) values.resize(count * 2);
    return values.data();
}

struct Scratch {  // of a thread
    Samples samples;
    std::vector<int64_t> order, live;
    std::vector<float> values, inputs, rgb, by_rgb;
    std::vector<char> records;
    std::vector<float> units, by_encoded;  // the results to be taken
    int64_t used = 0;
};

// Pseudo-random bits from an integer: SplitMix64 (Steele et al. 2014).
inline uint64_t scrambled(uint64_t x) {
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
    x = (x ^ x >> 27) * 0x94d049bb133111ebu;
    return x ^ x >> 31;
}

// A block of rays, forward and backward. Samples are those reached by light, ray by ray.
struct Block {
    const Path& path;
    const Networks& nets;
    Scratch& own;
    const int64_t base, rays;
    const bool learns;  // whether activations are recorded for a backward pass

    int64_t first[RAYS + 1] = {}, count = 0;  // of each ray's samples; of all samples
    int64_t* order = nullptr;                 // index of each among the evaluated samples
    // Of each sample: its optical depth and the one in front of it, the derivative by sigma, its weight, the
    // transmittance behind it, and the gradient of its log-density.
    float *tau, *depth, *slope, *weight, *behind, *by_log;
    float *rgb, *by_rgb;  // and the gradient before the sigmoid
    float grads[RAYS * 3], opacity[RAYS];

    Block(const Path& path, const Networks& nets, Scratch& own, int64_t base, int64_t rays, bool learns)
        : path(path), nets(nets), own(own), base(base), rays(rays), learns(learns) {}

    void trace() {
        Samples& samples = own.samples;
        int32_t counts[RAYS] = {};
        int64_t at[RAYS];
        samples.clear();
        trace_block(path, nets.density, base, base + rays, false, learns, samples, counts);
        for (int64_t r = 0; r < rays; r++) first[r + 1] = first[r] + counts[r], at[r] = first[r];
        count = first[rays];
        order = room(own.order, size_t(count));
        for (int64_t n = 0; n < samples.used; n++)
            if (samples.reached[size_t(n)]) order[at[samples.rays[size_t(n)] - base]++] = n;
        const size_t wide = size_t(count + LANES - 1) / LANES * LANES;
        float* values = room(own.values, wide * 6);
        for (float** each : {&tau, &depth, &slope, &weight, &behind, &by_log}) *each = values, values += wide;
    }

    void shade() {
        const int64_t width = nets.density.width;
        float* inputs = room(own.inputs, size_t(count * nets.inputs));
        float basis[16] = {FIRST_HARMONIC};
        for (int64_t r = 0; r < rays; r++) {
            const float* d = path.directions + (base + r) * 3;
            harmonics(d[0], d[1], d[2], nets.harmonics - 1, basis + 1);
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                float* to = inputs + n * nets.inputs;
                std::memcpy(to, &own.samples.outputs[size_t(order[n] * width)], sizeof(float) * size_t(width));
                std::memcpy(to + width, basis, sizeof(float) * size_t(nets.harmonics));
            }
        }
        rgb = room(own.rgb, size_t(count) * 3);
        if (learns) by_rgb = room(own.by_rgb, size_t(count) * 3);
        char* records = learns ? room(own.records, size_t(count) * nets.color.record()) : nullptr;
        nets.color.forward(inputs, count, mlp::SIGMOID, rgb, nullptr, records);
    }

    // As in compositing.cpp, with vectorised exponentials.
    void weigh() {
        for (int64_t r = 0; r < rays; r++) {
            float sum = 0;
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                const size_t s = size_t(order[n]);
                const float sigma = own.samples.density[s], delta = own.samples.ends[s] - own.samples.starts[s];
                depth[n] = sum;
                sum += tau[n] = optical_depth(sigma, delta);
                slope[n] = depth_slope(sigma, delta);
            }
        }
        for (int64_t n = 0; n < count; n += LANES) {  // rows have space for a whole last vector
            const Floats before = load(depth + n), here = load(tau + n);
            store(weight + n, exponential(-before) * opacity_of(here));
            store(behind + n, exponential(-(before + here)));
        }
    }

    void show(const Shown& to) const {
        for (int64_t r = 0; r < rays; r++) {
            float sum[3] = {}, total = 0, mean = 0, half = to.fars[base + r];
            bool found = false;
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                const size_t s = size_t(order[n]);
                const float t = (own.samples.starts[s] + own.samples.ends[s]) / 2;
                total += weight[n], mean += weight[n] * t;
                for (int c = 0; c < 3; c++) sum[c] += weight[n] * rgb[n * 3 + c];
                if (!found && behind[n] <= 0.5f) half = t < half ? t : half, found = true;
            }
            const float left = 1 - total < 0 ? 0 : 1 - total;
            for (int c = 0; c < 3; c++)
                to.rgb[(base + r) * 3 + c] = sum[c] + left * to.background[(base + r) * 3 + c];
            to.opacity[base + r] = total, to.moment[base + r] = mean, to.median[base + r] = half;
        }
    }

    // Returns the squared error of the pixels.
    double composite(const Pixels& pixels) {
        float colors[RAYS * 3];
        for (int64_t r = 0; r < rays; r++) {
            float sum[3] = {}, total = 0;
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                total += weight[n];
                for (int c = 0; c < 3; c++) sum[c] += weight[n] * rgb[n * 3 + c];
            }
            const float left = 1 - total < 0 ? 0 : 1 - total;
            opacity[r] = total;
            for (int c = 0; c < 3; c++) colors[r * 3 + c] = sum[c] + left * pixels.background[(base + r) * 3 + c];
        }
        double error = 0;
        for (int64_t r = 0; r < rays; r += pixels.per_pixel)
            error += pixel_error(pixels, r, colors + r * 3, grads + r * 3);
        return error;
    }

    // The squared error of the pixel of ray r and the following rays, times its weight and summed over channels. Writes
    // its colour, and the derivative of the mean over all pixels and channels to each ray's `grad`.
    double pixel_error(const Pixels& pixels, int64_t r, const float* colors, float* grad) const {
        const int64_t each = pixels.per_pixel, p = (base + r) / each;
        const float factor = pixels.weights ? pixels.weights[p] : 1;
        double error = 0;
        for (int c = 0; c < 3; c++) {
            float sum = 0;
            for (int64_t k = 0; k < each; k++) sum += colors[k * 3 + c];
            const float mean = sum / float(each), apart = mean - pixels.target[p * 3 + c];
            pixels.rgb[p * 3 + c] = mean;
            error += double(factor) * apart * apart;
            const float slope = 2 * factor * apart / float(double(pixels.count) * 3 * double(each));
            for (int64_t k = 0; k < each; k++) grad[k * 3 + c] = slope;
        }
        return error;
    }

    // Back to the density and colour of each sample.
    void to_samples(const Pixels& pixels) {
        for (int64_t r = 0; r < rays; r++) {
            const float *g = grads + r * 3, *back = pixels.background + (base + r) * 3;
            float own_background = 0, after = 0;
            if (1 - opacity[r] >= 0)
                for (int c = 0; c < 3; c++) own_background -= g[c] * back[c];
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                by_log[n] = own_background;  // the gradient of the weight, at first
                for (int c = 0; c < 3; c++) by_log[n] += g[c] * rgb[n * 3 + c];
                after += by_log[n] * weight[n];
            }
            for (int64_t n = first[r]; n < first[r + 1]; n++) {
                after -= by_log[n] * weight[n];
                const float by_tau = by_log[n] * behind[n] - after;
                by_log[n] = slope[n] == 0 ? 0 : slope[n] * by_tau * own.samples.density[size_t(order[n])];
                for (int c = 0; c < 3; c++) {
                    const float y = rgb[n * 3 + c];
                    by_rgb[n * 3 + c] = weight[n] * g[c] * y * (1 - y);
                }
            }
        }
    }

    // Selects the samples with a gradient, which continue through the networks. If a gradient is below `floor`
    // times the mean, the sample is kept with a proportional probability, and its gradient is scaled up accordingly.
    int64_t thin(const Thinning& thinning) {
        int64_t *live = room(own.live, size_t(count)), living = 0;
        float* size = depth;
        double sum = 0;
        for (int64_t n = 0; n < count; n++) {
            const float* c = by_rgb + n * 3;
            sum += size[n] = std::fabs(by_log[n]) + std::fabs(c[0]) + std::fabs(c[1]) + std::fabs(c[2]);
        }
        const float bound = count ? thinning.floor * float(sum / double(count)) : 0;
        for (int64_t n = 0; n < count; n++) {
            if (size[n] == 0) continue;
            if (size[n] < bound) {  // false for NaN, which must be noticed
                const float chance = size[n] / bound;
                const uint64_t bits = scrambled(thinning.seed ^ uint64_t(base) << 32 ^ uint64_t(n));
                if (!(float(bits >> 40) * 0x1p-24f < chance)) continue;
                by_log[n] /= chance;
                for (int c = 0; c < 3; c++) by_rgb[n * 3 + c] /= chance;
            }
            live[living++] = n;
        }
        return living;
    }

    // Back through both networks, for the first `living` of own.live.
    void to_weights(int64_t living, float* density_sums, float* color_sums) {
        const int64_t width = nets.density.width, encoded = nets.density.inputs;
        float* units = room(own.units, size_t(own.used + living) * 3) + own.used * 3;
        float* by_encoded = room(own.by_encoded, size_t((own.used + living) * encoded)) + own.used * encoded;
        float of_rgb[mlp::BLOCK * 3], of_inputs[mlp::BLOCK * mlp::MAX_WIDTH], of_outputs[mlp::BLOCK * mlp::MAX_WIDTH];
        for (int64_t next = 0; next < living; next += mlp::BLOCK) {
            const int size = int(std::min<int64_t>(mlp::BLOCK, living - next));
            const int64_t* rows = &own.live[size_t(next)];
            int64_t evaluated[mlp::BLOCK];
            for (int i = 0; i < size; i++) {
                evaluated[i] = order[rows[i]];
                std::memcpy(of_rgb + i * 3, by_rgb + rows[i] * 3, sizeof(float) * 3);
                std::memcpy(units + (next + i) * 3, &own.samples.unit[size_t(evaluated[i]) * 3], sizeof(float) * 3);
            }
            nets.color.backward(own.records.data(), rows, size, of_rgb, color_sums, of_inputs);
            for (int i = 0; i < size; i++) {
                std::memcpy(of_outputs + i * width, of_inputs + i * nets.inputs, sizeof(float) * size_t(width));
                of_outputs[i * width] += by_log[rows[i]];
            }
            nets.density.net->backward(own.samples.records.data(), evaluated, size, of_outputs, density_sums,
                                       by_encoded + next * encoded);
        }
        own.used += living;
    }
};

struct Learnt {  // results that the caller has not taken yet
    std::vector<Scratch> scratch;  // of each thread
    std::vector<Part> parts;
    std::vector<float> density_sums, color_sums;
    int64_t total = -1, inputs = 0;
};

Learnt& learnt() {
    static thread_local Learnt of_caller;
    return of_caller;
}

std::unique_ptr<mlp::Layers> color_network(const int64_t* widths, int layers, const float* const* weights, int bf16) {
    return bf16 ? mlp::layers_bf16_of(widths, layers, weights) : mlp::layers_of(widths, layers, weights);
}

Networks networks(const Density& density, const mlp::Layers& color, const int64_t* widths, int layers, int bands) {
    if (bands < 0 || bands > 4 || widths[0] != density.width + bands * bands || widths[layers] != 3)
        throw std::invalid_argument("the colour network does not fit");
    return {density, color, widths[0], bands * bands};
}

}  // namespace

// The rays, their grid and the density are as in trace_rays. The colour is a network on the density network's outputs
// and `bands` bands of harmonics of the direction. background (R, 3); target (P, 3) and pixel_weights (P), which may be
// null, for pixels of `per_pixel` consecutive rays. floor, seed: see Block::thin. Writes rgb (P, 3), the weighted mean
// square `error` (1), the gradients of the weights of both networks, and `samples` (1): number of samples reached by
// light. `total`: number of samples with a gradient, which traced_error_take returns.
EXPORT int traced_error(const float* origins, const float* directions, const float* enter, const float* leave,
                        const float* first, const int64_t* slices, int64_t rays, const int64_t* limits, int waves,
                        const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                        int resolution, int boxes, float budget, const float* scale, const float* shift,
                        const float* around, const float* table, int features, const int64_t* resolutions,
                        const int64_t* offsets, int levels, const int64_t* widths, int layers,
                        const float* const* weights, int bf16,
                        const int64_t* color_widths, int color_layers, const float* const* color_weights, int bands,
                        const float* background, const float* target, const float* pixel_weights, int64_t per_pixel,
                        float floor, int64_t seed, float* rgb, float* error, float* const* weight_grads,
                        float* const* color_weight_grads, int64_t* samples, int threads, int64_t* total) {
    return guarded([&] {
        const Path path{origins, directions, enter, leave,  first,      slices, limits, waves,
                        box,     step,       cone,  bits,   blocks,     resolution, boxes, budget};
        const Density density(scale, shift, around, table, features, resolutions, offsets, levels, widths, layers,
                              weights, bf16);
        const auto color = color_network(color_widths, color_layers, color_weights, bf16);
        const Networks nets = networks(density, *color, color_widths, color_layers, bands);
        if (per_pixel < 1 || per_pixel > RAYS || rays % per_pixel)
            throw std::invalid_argument("a pixel has 1 to 256 rays, all of them here");
        const Pixels pixels{background, target, pixel_weights, rays / per_pixel, per_pixel, rgb};
        const Thinning thinning{floor, scrambled(uint64_t(seed))};
        Learnt& all = learnt();
        all.total = -1, all.inputs = density.inputs;
        if (all.scratch.size() < size_t(std::max(threads, 1))) all.scratch.resize(size_t(std::max(threads, 1)));
        for (Scratch& scratch : all.scratch) scratch.used = 0;
        const int64_t size = std::max<int64_t>(BLOCK_RAYS / per_pixel, 1) * per_pixel, count = (rays + size - 1) / size;
        const int64_t each = (count + PARTS - 1) / PARTS, parts = each ? (count + each - 1) / each : 0;
        float* density_sums = room(all.density_sums, density.net->sums() * size_t(parts));
        float* color_sums = room(all.color_sums, color->sums() * size_t(parts));
        all.parts.assign(size_t(parts), Part());
        for_chunks(threads, parts, [&](int64_t p, int slot) {
            Scratch& scratch = all.scratch[size_t(slot)];
            Part part{slot, scratch.used};
            float* of_density = density_sums + size_t(p) * density.net->sums();
            float* of_color = color_sums + size_t(p) * color->sums();
            std::fill_n(of_density, density.net->sums(), 0.0f), std::fill_n(of_color, color->sums(), 0.0f);
            for (int64_t b = p * each; b < std::min(count, (p + 1) * each); b++) {
                Block block(path, nets, scratch, b * size, std::min(rays - b * size, size), true);
                block.trace();
                block.shade();
                block.weigh();
                part.error += block.composite(pixels);
                block.to_samples(pixels);
                block.to_weights(block.thin(thinning), of_density, of_color);
                part.samples += block.count;
            }
            part.count = scratch.used - part.begin;
            all.parts[size_t(p)] = part;
        });
        density.net->write(density_sums, parts, threads, weight_grads);
        color->write(color_sums, parts, threads, color_weight_grads);
        double sum = 0;
        *samples = *total = 0;
        for (const Part& part : all.parts) sum += part.error, *samples += part.samples, *total += part.count;
        *error = float(sum / (3 * double(pixels.count)));
        all.total = *total;
    });
}

// For the samples with a gradient: their positions, unit (N, 3), and the gradient of their encoding (N, E).
EXPORT int traced_error_take(int64_t total, float* unit, float* grad, int threads) {
    return guarded([&] {
        Learnt& all = learnt();
        if (all.total != total) throw std::invalid_argument("there is no such trace");
        std::vector<int64_t> begins;
        int64_t sum = 0;
        for (const Part& part : all.parts) begins.push_back(sum), sum += part.count;
        for_chunks(threads, int64_t(all.parts.size()), [&](int64_t p, int) {
            const Part& part = all.parts[size_t(p)];
            const Scratch& from = all.scratch[size_t(part.slot)];
            std::copy_n(from.units.data() + part.begin * 3, part.count * 3, unit + begins[size_t(p)] * 3);
            std::copy_n(from.by_encoded.data() + part.begin * all.inputs, part.count * all.inputs,
                        grad + begins[size_t(p)] * all.inputs);
        });
        all.total = -1;
        for (Scratch& scratch : all.scratch)
            if (scratch.by_encoded.size() > KEPT) scratch = Scratch();
    });
}

// The colours of rays. The arguments up to `bands` are as in traced_error; background (R, 3), fars (R). Writes colour
// over the background (R, 3), opacity, first moment of t, and median of t (R). `samples`: number of samples reached by
// light.
EXPORT int traced_colors(const float* origins, const float* directions, const float* enter, const float* leave,
                         const float* first, const int64_t* slices, int64_t rays, const int64_t* limits, int waves,
                         const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                         int resolution, int boxes, float budget, const float* scale, const float* shift,
                         const float* around, const float* table, int features, const int64_t* resolutions,
                         const int64_t* offsets, int levels, const int64_t* widths, int layers,
                         const float* const* weights, int bf16, const int64_t* color_widths, int color_layers,
                         const float* const* color_weights, int bands, const float* background, const float* fars,
                         float* rgb, float* opacity, float* moment, float* median, int threads, int64_t* samples) {
    return guarded([&] {
        const Path path{origins, directions, enter, leave,  first,      slices, limits, waves,
                        box,     step,       cone,  bits,   blocks,     resolution, boxes, budget};
        const Density density(scale, shift, around, table, features, resolutions, offsets, levels, widths, layers,
                              weights, bf16);
        const auto color = color_network(color_widths, color_layers, color_weights, bf16);
        const Networks nets = networks(density, *color, color_widths, color_layers, bands);
        const Shown shown{background, fars, rgb, opacity, moment, median};
        std::vector<Scratch>& scratch = learnt().scratch;
        if (scratch.size() < size_t(std::max(threads, 1))) scratch.resize(size_t(std::max(threads, 1)));
        std::atomic<int64_t> reached{0};
        for_chunks(threads, (rays + BLOCK_RAYS - 1) / BLOCK_RAYS, [&](int64_t b, int slot) {
            const int64_t base = b * BLOCK_RAYS;
            Block block(path, nets, scratch[size_t(slot)], base, std::min(rays - base, BLOCK_RAYS), false);
            block.trace();
            block.shade();
            block.weigh();
            block.show(shown);
            reached += block.count;
        });
        *samples = reached;
        for (Scratch& each : scratch) {
            const Samples& held = each.samples;
            if (held.features.size() + held.outputs.size() + each.inputs.size() > KEPT) each = Scratch();
        }
    });
}
