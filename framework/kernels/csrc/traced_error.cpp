// The squared error of what traced rays show, and its gradient, in one call. See ../traced_error.py for the reference.
//
// A block of rays goes all the way on one thread while it is in cache: through trace_block, the colour network,
// compositing and the error, and back through both networks, whose activations were recorded on the way there. What
// leaves the cache is the gradient of the encoding, for the hash table, and the sums of the weights' gradients.
#include "harmonics.h"
#include "trace.h"

#include <cstdlib>

using namespace tracing;

namespace {

constexpr int64_t PARTS = 64;  // at most; each has sums of its own
constexpr size_t KEPT = 1 << 25;  // floats that a thread keeps between calls

struct Part {
    int slot = 0;
    int64_t begin = 0, count = 0;  // of its gradients among those of the thread
    int64_t samples = 0;
    double error = 0;
};

struct Scratch {  // of a thread
    Samples samples;
    std::vector<float> units, gradients;  // of the encoding, of all blocks of the thread, where it is not zero
    int64_t used = 0;
    std::vector<int64_t> order, live;           // of a block's samples that light reached, ray by ray
    std::vector<float> values;                  // of each of these; see Values
    std::vector<float> inputs, rgb, rgb_grad;   // of the colour network
    std::vector<char> records;

    void room(int64_t count, int64_t width, size_t record) {
        const size_t all = size_t(count + LANES);
        if (order.size() < all) order.resize(all * 2), live.resize(all * 2);
        if (values.size() < all * 6) values.resize(all * 12);
        if (rgb.size() < all * 3) rgb.resize(all * 6), rgb_grad.resize(all * 6);
        if (inputs.size() < all * width) inputs.resize(all * width * 2);
        if (records.size() < all * record) records.resize(all * record * 2);
    }
};

struct State {  // what a caller has computed and not yet taken
    std::vector<Scratch> scratch;  // of each thread
    std::vector<Part> parts;
    std::vector<float> density_sums, color_sums;
    int64_t total = -1, inputs = 0;
};

State& state() {
    static thread_local State of_caller;
    return of_caller;
}

struct Pixels {  // of `per_pixel` consecutive rays each
    const float *background, *target, *weights;
    int64_t count, per_pixel;
    float* rgb;
};

// The squared error of one pixel, times its weight and summed over channels; writes its colour and, to each ray's
// `grad`, the derivative of the mean over all pixels and channels.
double pixel_error(const Pixels& pixels, int64_t p, const float* colors, float* grad) {
    double error = 0;
    const float weight = pixels.weights ? pixels.weights[p] : 1;
    for (int c = 0; c < 3; c++) {
        float sum = 0;
        for (int64_t k = 0; k < pixels.per_pixel; k++) sum += colors[k * 3 + c];
        const float rgb = sum / float(pixels.per_pixel), apart = rgb - pixels.target[p * 3 + c];
        pixels.rgb[p * 3 + c] = rgb;
        error += double(weight) * apart * apart;
        const float slope = 2 * weight * apart / float(double(pixels.count) * 3 * double(pixels.per_pixel));
        for (int64_t k = 0; k < pixels.per_pixel; k++) grad[k * 3 + c] = slope;
    }
    return error;
}

struct Thinning {
    float floor;
    uint64_t seed;
};

// Pseudo-random bits of a number: SplitMix64 (Steele et al. 2014).
inline uint64_t scrambled(uint64_t x) {
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
    x = (x ^ x >> 27) * 0x94d049bb133111ebu;
    return x ^ x >> 31;
}

// Which of a block's samples go on to the backward pass: those with a gradient, but of samples whose gradient is below
// `floor` times the mean a share in proportion to it, whose gradient is enlarged as much, so that its expectation stays.
int64_t thin(int64_t count, float* through, float* rgb_grad, float* size, float floor, uint64_t seed, int64_t* live) {
    double sum = 0;
    for (int64_t n = 0; n < count; n++) {
        const float* c = rgb_grad + n * 3;
        sum += size[n] = std::fabs(through[n]) + std::fabs(c[0]) + std::fabs(c[1]) + std::fabs(c[2]);
    }
    const float bound = count ? floor * float(sum / double(count)) : 0;
    int64_t living = 0;
    for (int64_t n = 0; n < count; n++) {
        if (size[n] == 0) continue;
        if (size[n] < bound) {  // false for NaN, which must be seen
            const float chance = size[n] / bound;
            if (!(float(scrambled(seed << 20 ^ uint64_t(n)) >> 40) * 0x1p-24f < chance)) continue;
            through[n] /= chance;
            for (int c = 0; c < 3; c++) rgb_grad[n * 3 + c] /= chance;
        }
        live[living++] = n;
    }
    return living;
}

struct Networks {
    const Density& density;
    const mlp::Layers& color;
    int64_t inputs;  // of the colour network: outputs of the density's, and harmonics of the direction
    int harmonics;
};

// Rays [base, last): whole pixels, RAYS at most.
void learn_block(const Path& path, const Networks& nets, const Pixels& pixels, const Thinning& thinning, int64_t base,
                 int64_t last, Scratch& own, Part& part, float* density_sums, float* color_sums) {
    Samples& samples = own.samples;
    samples.clear();
    int32_t counts[RAYS] = {};
    trace_block(path, nets.density, base, last, false, true, samples, counts);
    int64_t first[RAYS + 1] = {}, at[RAYS];
    const int64_t rays = last - base, width = nets.density.width;
    for (int64_t r = 0; r < rays; r++) first[r + 1] = first[r] + counts[r], at[r] = first[r];
    const int64_t count = first[rays];
    own.room(count, nets.inputs, nets.color.record());
    for (int64_t n = 0; n < samples.used; n++)
        if (samples.reached[size_t(n)]) own.order[size_t(at[samples.rays[size_t(n)] - base]++)] = n;
    part.samples += count;

    for (int64_t r = 0; r < rays; r++) {
        float harmonics[16];
        if (nets.harmonics) harmonics_of(path.directions + (base + r) * 3, nets.harmonics, harmonics);
        for (int64_t n = first[r]; n < first[r + 1]; n++) {
            float* to = &own.inputs[size_t(n * nets.inputs)];
            std::memcpy(to, &samples.outputs[size_t(own.order[size_t(n)] * width)], sizeof(float) * size_t(width));
            std::memcpy(to + width, harmonics, sizeof(float) * size_t(nets.harmonics));
        }
    }
    nets.color.forward(own.inputs.data(), count, mlp::SIGMOID, own.rgb.data(), nullptr, own.records.data());

    // As in compositing.cpp, with the exponentials of a whole vector at once.
    const int64_t wide = (count + LANES - 1) / LANES * LANES;
    float *depth = own.values.data(), *tau = depth + wide, *weight = tau + wide, *behind = weight + wide;
    float *slope = behind + wide, *through = slope + wide;  // of depth by sigma; the gradient of the logarithm of sigma
    const float *rgb = own.rgb.data();
    float* rgb_grad = own.rgb_grad.data();
    std::fill(depth + count, depth + wide, 0.0f), std::fill(tau + count, tau + wide, 0.0f);
    for (int64_t r = 0; r < rays; r++) {
        float sum = 0;
        for (int64_t n = first[r]; n < first[r + 1]; n++) {
            const size_t s = size_t(own.order[size_t(n)]);
            const float sigma = samples.density[s], delta = samples.ends[s] - samples.starts[s];
            depth[n] = sum;
            sum += tau[n] = optical_depth(sigma, delta);
            slope[n] = depth_slope(sigma, delta);
        }
    }
    for (int64_t n = 0; n < wide; n += LANES) {
        const Floats before = load(depth + n), own_depth = load(tau + n);
        store(weight + n, exponential(-before) * opacity_of(own_depth));
        store(behind + n, exponential(-(before + own_depth)));
    }
    float colors[RAYS * 3], opacity[RAYS], grads[RAYS * 3];
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
    for (int64_t r = 0; r < rays; r += pixels.per_pixel)
        part.error += pixel_error(pixels, (base + r) / pixels.per_pixel, colors + r * 3, grads + r * 3);

    for (int64_t r = 0; r < rays; r++) {
        const float *g = grads + r * 3, *back = pixels.background + (base + r) * 3;
        float base_grad = 0, after = 0;
        if (1 - opacity[r] >= 0)
            for (int c = 0; c < 3; c++) base_grad -= g[c] * back[c];
        for (int64_t n = first[r]; n < first[r + 1]; n++) {
            float by_weight = base_grad;
            for (int c = 0; c < 3; c++) by_weight += g[c] * rgb[n * 3 + c];
            after += by_weight * weight[n];
            through[n] = by_weight;
        }
        for (int64_t n = first[r]; n < first[r + 1]; n++) {
            const float by_weight = through[n], sigma = samples.density[size_t(own.order[size_t(n)])];
            after -= by_weight * weight[n];
            through[n] = slope[n] == 0 ? 0 : slope[n] * (by_weight * behind[n] - after) * sigma;
            for (int c = 0; c < 3; c++) {
                const float y = rgb[n * 3 + c];
                rgb_grad[n * 3 + c] = weight[n] * g[c] * y * (1 - y);
            }
        }
    }
    const int64_t living = thin(count, through, rgb_grad, depth, thinning.floor, thinning.seed + uint64_t(base), own.live.data());

    const int64_t encoded = nets.density.inputs;
    const size_t all = size_t(own.used + living);
    if (own.units.size() < all * 3) own.units.resize(all * 6);
    if (own.gradients.size() < all * encoded) own.gradients.resize(all * encoded * 2);
    alignas(64) float of_rgb[mlp::BLOCK * 3], of_inputs[mlp::BLOCK * mlp::MAX_WIDTH], of_outputs[mlp::BLOCK * mlp::MAX_WIDTH];
    for (int64_t next = 0; next < living; next += mlp::BLOCK) {
        const int size = int(std::min<int64_t>(mlp::BLOCK, living - next));
        const int64_t* rows = &own.live[size_t(next)];
        int64_t places[mlp::BLOCK];
        for (int i = 0; i < size; i++) {
            places[i] = own.order[size_t(rows[i])];
            std::memcpy(of_rgb + i * 3, rgb_grad + rows[i] * 3, sizeof(float) * 3);
        }
        nets.color.backward(own.records.data(), rows, size, of_rgb, color_sums, of_inputs);
        for (int i = 0; i < size; i++) {
            std::memcpy(of_outputs + i * width, of_inputs + i * nets.inputs, sizeof(float) * size_t(width));
            of_outputs[i * width] += through[rows[i]];
            std::memcpy(&own.units[size_t(own.used + i) * 3], &samples.unit[size_t(places[i]) * 3], sizeof(float) * 3);
        }
        nets.density.net->backward(samples.records.data(), places, size, of_outputs, density_sums,
                                   &own.gradients[size_t(own.used * encoded)]);
        own.used += size;
    }
}

}  // namespace

// The rays, their grid and the density are as in trace_rays. The colour is a network on the density network's outputs
// and `bands` bands of harmonics of the direction. background (R, 3); target (P, 3) and weights (P), which may be null,
// of the pixels of `per_pixel` consecutive rays. Writes rgb (P, 3), the weighted mean of squares `error` (1), and the
// gradients of the weights of both networks. samples (1): those that light reached. `total`: those with a gradient,
// which traced_error_take returns.
EXPORT int traced_error(const float* origins, const float* directions, const float* enter, const float* leave,
                        const float* first, const int64_t* slices, int64_t rays, const int64_t* limits, int waves,
                        const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                        int resolution, int boxes, float budget, const float* scale, const float* shift,
                        const float* table, int features, const int64_t* resolutions, const int64_t* offsets,
                        int levels, const int64_t* widths, int layers, const float* const* weights, int bf16,
                        const int64_t* color_widths, int color_layers, const float* const* color_weights, int bands,
                        const float* background, const float* target, const float* pixel_weights, int64_t per_pixel,
                        float thin, int64_t seed, float* rgb, float* error, float* const* weight_grads, float* const* color_weight_grads,
                        int64_t* samples, int threads, int64_t* total) {
    return guarded([&] {
        const Path path{origins, directions, enter, leave,  first,      slices, limits, waves,
                        box,     step,       cone,  bits,   blocks,     resolution, boxes, budget};
        const Density density(scale, shift, table, features, resolutions, offsets, levels, widths, layers, weights, bf16);
        const auto color = bf16 ? mlp::layers_bf16_of(color_widths, color_layers, color_weights)
                                : mlp::layers_of(color_widths, color_layers, color_weights);
        const Networks nets{density, *color, color_widths[0], bands * bands};
        if (bands < 0 || bands > 4 || nets.inputs != density.width + nets.harmonics || color_widths[color_layers] != 3)
            throw std::invalid_argument("the colour network does not fit");
        if (per_pixel < 1 || per_pixel > RAYS || rays % per_pixel)
            throw std::invalid_argument("a pixel has 1 to 256 rays, all of them here");
        const Pixels pixels{background, target, pixel_weights, rays / per_pixel, per_pixel, rgb};
        State& all = state();
        all.total = -1, all.inputs = density.inputs;
        if (all.scratch.size() < size_t(std::max(threads, 1))) all.scratch.resize(size_t(std::max(threads, 1)));
        for (Scratch& scratch : all.scratch) scratch.used = 0;
        static const int64_t WANTED = getenv("BLK") ? atoi(getenv("BLK")) : 256;
        const int64_t size = std::max<int64_t>(WANTED / per_pixel, 1) * per_pixel, count = (rays + size - 1) / size;  // of rays in a block
        const int64_t each = (count + PARTS - 1) / PARTS, parts = each ? (count + each - 1) / each : 0;
        all.parts.assign(size_t(parts), Part());
        if (all.density_sums.size() < density.net->sums() * size_t(parts))
            all.density_sums.resize(density.net->sums() * size_t(parts));
        if (all.color_sums.size() < color->sums() * size_t(parts)) all.color_sums.resize(color->sums() * size_t(parts));
        for_chunks(threads, parts, [&](int64_t p, int slot) {
            Scratch& scratch = all.scratch[size_t(slot)];
            Part part{slot, scratch.used};
            float* density_sums = all.density_sums.data() + size_t(p) * density.net->sums();
            float* color_sums = all.color_sums.data() + size_t(p) * color->sums();
            std::fill_n(density_sums, density.net->sums(), 0.0f), std::fill_n(color_sums, color->sums(), 0.0f);
            for (int64_t b = p * each; b < std::min(count, (p + 1) * each); b++)
                learn_block(path, nets, pixels, {thin, uint64_t(seed)}, b * size, std::min(rays, (b + 1) * size), scratch, part, density_sums,
                            color_sums);
            part.count = scratch.used - part.begin;
            all.parts[size_t(p)] = part;
        });
        density.net->write(all.density_sums.data(), parts, threads, weight_grads);
        color->write(all.color_sums.data(), parts, threads, color_weight_grads);
        double sum = 0;
        *samples = *total = 0;
        for (const Part& part : all.parts) sum += part.error, *samples += part.samples, *total += part.count;
        *error = float(sum / (3 * double(pixels.count)));
        all.total = *total;
    });
}

// Of the samples with a gradient: where they are, unit (N, 3), and the gradient of their encoding (N, E).
EXPORT int traced_error_take(int64_t total, float* unit, float* grad, int threads) {
    return guarded([&] {
        State& all = state();
        if (all.total != total) throw std::invalid_argument("there is no such trace");
        std::vector<int64_t> begins;
        int64_t sum = 0;
        for (const Part& part : all.parts) begins.push_back(sum), sum += part.count;
        for_chunks(threads, int64_t(all.parts.size()), [&](int64_t p, int) {
            const Part& part = all.parts[size_t(p)];
            const Scratch& from = all.scratch[size_t(part.slot)];
            std::copy_n(from.units.data() + part.begin * 3, part.count * 3, unit + begins[size_t(p)] * 3);
            std::copy_n(from.gradients.data() + part.begin * all.inputs, part.count * all.inputs,
                        grad + begins[size_t(p)] * all.inputs);
        });
        all.total = -1;
        for (Scratch& scratch : all.scratch)
            if (scratch.gradients.size() > KEPT) scratch = Scratch();
    });
}
