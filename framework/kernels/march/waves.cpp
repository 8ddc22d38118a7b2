// Marching rays through an occupancy grid, one wave at a time. See waves.py for the reference.
//
// A ray's candidates are the steps first + k * step (growing with distance beyond step / cone). A wave finds the next
// `limit` candidates of every active ray that have their middle in an occupied cell; blocks of 4^3 empty cells are
// skipped at once. With nested boxes, each twice as large, the smallest box that contains the middle decides. The
// middle of a larger box covers the smaller ones, so a box can be traversed by its own blocks up to its faces.
#include "march/waves.h"

using namespace marching;

// One bit per cell, and for each block of 4^3 cells its distance (the largest over the axes, in blocks, at most 255) to
// a block with an occupied cell; computed from one byte per cell.
EXPORT int pack_occupancy(const uint8_t* occupied, int resolution, uint8_t* bits, uint8_t* blocks) {
    const int64_t cells = int64_t(resolution) * resolution * resolution, side = (resolution + BLOCK - 1) / BLOCK;
    std::memset(bits, 0, size_t((cells + 7) / 8));
    std::memset(blocks, 0, size_t(side * side * side));
    for (int64_t cell = 0; cell < cells; cell++) {
        uint64_t eight = 1;
        if (cell % 8 == 0 && cell + 8 <= cells) std::memcpy(&eight, occupied + cell, 8);
        if (eight == 0) cell += 7;
        if (eight == 0 || !occupied[cell]) continue;
        bits[cell >> 3] |= uint8_t(1 << (cell & 7));
        const int64_t x = cell / resolution / resolution, y = cell / resolution % resolution, z = cell % resolution;
        blocks[(x / BLOCK * side + y / BLOCK) * side + z / BLOCK] = 1;
    }
    for (int64_t b = 0; b < side * side * side; b++) blocks[b] = blocks[b] ? 0 : 255;
    // The chessboard distance is exact after one pass forward and one back over all 26 neighbours (Rosenfeld, Pfaltz 1968).
    for (int pass = 0; pass < 2; pass++)
        for (int64_t i = 0; i < side * side * side; i++) {
            const int64_t b = pass ? side * side * side - 1 - i : i;
            const int64_t at[3] = {b / side / side, b / side % side, b % side};
            int nearest = blocks[b];
            for (int m = 0; m < 13; m++) {  // the half that this pass has visited
                const int n = pass ? 26 - m : m;
                const int64_t x = at[0] + n / 9 - 1, y = at[1] + n / 3 % 3 - 1, z = at[2] + n % 3 - 1;
                if (x < 0 || y < 0 || z < 0 || x >= side || y >= side || z >= side) continue;
                nearest = std::min(nearest, blocks[(x * side + y) * side + z] + 1);
            }
            blocks[b] = uint8_t(std::min<int>(blocks[b], nearest));
        }
    return DONE;
}

// Marks the cells with an opacity over one step of at least `threshold`, or the mean opacity if it is less. `elsewhere`
// replaces the mean if it is larger. The grid of densities is multiplied by `decay` first. NaN cells are marked and
// left out of the mean.
EXPORT int refresh_occupancy(float* density, int64_t cells, float decay, float step, float threshold,
                             float elsewhere, uint8_t* occupied, int threads) {
    return guarded([&] {
        constexpr int64_t RUN = 32768;
        const int64_t runs = (cells + RUN - 1) / RUN;
        std::vector<double> opacity(size_t(runs), 0.0);  // per run, so that the sum does not depend on the threads
        std::vector<int64_t> known(size_t(runs), 0);     // cells of each run that are not NaN
        for_ranges(threads, cells, RUN, [&](int64_t i, int64_t end) {
            double& of_run = opacity[size_t(i / RUN)];
            int64_t& numbers_in_run = known[size_t(i / RUN)];
            const float fade = decay, length = step;  // copies, because a store might alias captured values
            Floats sum = splat(0);
            Ints numbers = {};
            for (; i + LANES <= end; i += LANES) {
                const Floats value = load(density + i) * fade, alpha = opacity_of(value * length);
                store(density + i, value);
                sum += alpha == alpha ? alpha : splat(0);
                numbers -= alpha == alpha;  // true is -1
            }
            for (int lane = 0; lane < LANES; lane++) {
                of_run += sum[lane];
                numbers_in_run += numbers[lane];
            }
            for (; i < end; i++) {
                const float alpha = -std::expm1((density[i] *= fade) * -length);
                if (std::isnan(alpha)) continue;
                of_run += alpha;
                numbers_in_run++;
            }
        });
        double total = 0, count = 0;
        for (double part : opacity) total += part;
        for (int64_t part : known) count += double(part);
        constexpr double ROUNDING = 1e-5;  // see occupancy.py
        const float mean = float(total / count * (1 - ROUNDING));
        const float least = std::min(threshold, std::max(mean, elsewhere));  // the threshold if all are NaN
        const float density_threshold = -std::log1p(-std::min(least, 1 - 1e-7f)) / step;
        for_ranges(threads, cells, 4 * RUN, [&](int64_t begin, int64_t end) {
            const float limit = density_threshold;
            for (int64_t i = begin; i < end; i++) occupied[i] = !(density[i] < limit);
        });
    });
}

// The distances where each ray enters and leaves the box, and its first step: `enter` minus a fraction of a step.
// `hits`: number of rays that hit the box; their indices are written to `alive`.
EXPORT int march_begin(const float* origins, const float* directions, const float* nears, const float* fars,
                       const float* shift, int64_t rays, const float* box, float step, float* enter, float* leave,
                       float* first, int64_t* alive, int threads, int64_t* hits) {
    return guarded([&] {
        for_each(threads, rays, 4096, [&](int64_t r) {
            float from = 0, to = std::numeric_limits<float>::infinity();
            bool nowhere = false;
            for (int a = 0; a < 3; a++) {
                const float o = origins[r * 3 + a], d = directions[r * 3 + a];
                if (d == 0) {
                    if (o < box[a] || o > box[3 + a]) to = -1;
                    nowhere |= std::isnan(o);
                    continue;
                }
                const float one = (box[a] - o) / d, two = (box[3 + a] - o) / d;
                nowhere |= std::isnan(one) || std::isnan(two);
                from = std::max(from, std::min(one, two));
                to = std::min(to, std::max(one, two));
            }
            if (nowhere && std::isinf(fars[r])) to = -1;  // an infinite march would not end; else the colour is NaN
            enter[r] = std::max(from, nears[r]);
            leave[r] = std::min(to, fars[r]);
            first[r] = enter[r] - (shift ? shift[r] * step : 0);
        });
        int64_t found = 0;
        for (int64_t r = 0; r < rays; r++)
            if (leave[r] > enter[r]) alive[found++] = r;
        *hits = found;
    });
}

// The next samples of each active ray, packed ray by ray. `total`: their number N. box, resolution, levels: the
// smallest nested box, cells along an axis of each box, and number of boxes. slices (R): the time slice of each ray in
// a grid of one box; null if there is one slice. next (R): the step to continue from, updated here; counts (A): samples
// of each active ray. starts, ends (N), owners (N), positions (N, 3) have space for A * limit.
EXPORT int march_wave(const float* origins, const float* directions, const float* enter, const float* leave,
                      const float* first, const int64_t* slices, int32_t* next, const int64_t* alive, int64_t living,
                      int limit, const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                      int resolution, int levels, int32_t* counts, float* starts, float* ends, int64_t* owners,
                      float* positions, int threads, int64_t* total) {
    struct Found {
        std::vector<float> starts, ends;
    };
    struct Chunk {  // of rays: its samples start at found[slot][begin] and are copied to `at`
        int slot;
        int64_t begin, count, at;
    };
    return guarded([&] {
        constexpr int64_t RAYS = 512;
        const int side = (resolution + BLOCK - 1) / BLOCK;
        const int64_t bytes = (int64_t(resolution) * resolution * resolution + 7) / 8;  // of the bits of a slice
        static thread_local std::vector<Found> kept;  // reused: new memory costs page faults
        std::vector<Found>& found = kept;             // the caller's, on whichever thread the search runs
        if (found.size() < size_t(threads)) found.resize(size_t(threads));
        for (Found& of_slot : found) of_slot.starts.clear(), of_slot.ends.clear();
        std::vector<Chunk> chunks(size_t((living + RAYS - 1) / RAYS));
        for_chunks(threads, int64_t(chunks.size()), [&](int64_t c, int slot) {
            Found& mine = found[size_t(slot)];
            const int64_t before = int64_t(mine.starts.size()), last = std::min(living, (c + 1) * RAYS);
            for (int64_t i = c * RAYS; i < last; i++) {
                const int64_t r = alive[i], slice = slices ? slices[r] : 0;
                const Grid grid{bits + slice * bytes, blocks + slice * side * side * side, resolution, side};
                const Ray ray(origins + r * 3, directions + r * 3, box, resolution);
                const Steps steps(first[r], step, cone);
                counts[i] = march_ray(ray, steps, grid, levels, enter[r], leave[r], limit, next[r], mine.starts,
                                      mine.ends);
            }
            chunks[size_t(c)] = {slot, before, int64_t(mine.starts.size()) - before, 0};
        });
        int64_t all = 0;
        for (Chunk& chunk : chunks) {
            chunk.at = all;
            all += chunk.count;
        }
        for_chunks(threads, int64_t(chunks.size()), [&](int64_t c, int) {
            const Chunk& chunk = chunks[size_t(c)];
            const Found& from = found[size_t(chunk.slot)];
            std::copy_n(from.starts.begin() + chunk.begin, chunk.count, starts + chunk.at);
            std::copy_n(from.ends.begin() + chunk.begin, chunk.count, ends + chunk.at);
            const int64_t last = std::min(living, (c + 1) * RAYS);
            for (int64_t i = c * RAYS, n = chunk.at; i < last; i++) {
                const int64_t r = alive[i];
                for (int s = 0; s < counts[i]; s++, n++) {
                    owners[n] = r;
                    const float t = (starts[n] + ends[n]) / 2;
                    for (int a = 0; a < 3; a++) positions[n * 3 + a] = origins[r * 3 + a] + t * directions[r * 3 + a];
                }
            }
        });
        *total = all;
    });
}

// Called when a wave's densities are known. Adds to the optical depth `spent` (R) of each active ray, marks the samples
// that light still reached, and writes the rays that continue. `left`: number of these.
EXPORT int march_advance(const int64_t* alive, int64_t living, const int32_t* counts, int limit, const float* sigma,
                         const float* starts, const float* ends, float budget, float* spent, uint8_t* reached,
                         int64_t* going_on, int64_t* left) {
    int64_t n = 0, on = 0;
    for (int64_t i = 0; i < living; i++) {
        const int64_t r = alive[i];
        float tau = spent[r];
        for (int s = 0; s < counts[i]; s++, n++) {
            reached[n] = !(tau >= budget);  // NaN continues, so that a broken field is noticed
            tau += sigma[n] * (ends[n] - starts[n]);
        }
        spent[r] = tau;
        if (counts[i] == limit && !(tau >= budget)) going_on[on++] = r;
    }
    *left = on;
    return DONE;
}

// The order (M) that sorts the reached samples of all waves ray by ray, and offsets (R + 1). `kept`: M.
EXPORT int sort_by_ray(const int64_t* owners, const uint8_t* reached, int64_t count, int64_t rays, int64_t* order,
                       int64_t* offsets, int64_t* kept) {
    return guarded([&] {
        std::fill(offsets, offsets + rays + 1, 0);
        for (int64_t n = 0; n < count; n++) {
            check_index(owners[n], rays, "rays");
            offsets[owners[n] + 1] += reached[n];
        }
        for (int64_t r = 0; r < rays; r++) offsets[r + 1] += offsets[r];
        std::vector<int64_t> at(offsets, offsets + rays);
        for (int64_t n = 0; n < count; n++)
            if (reached[n]) order[at[size_t(owners[n])]++] = n;
        *kept = offsets[rays];
    });
}

// Rows of `arrays` arrays, each in `parts` consecutive parts; ends holds the number of rows up to the end of each part.
// Row order[m] of array a, with bytes[a] bytes, becomes row m of out[a]. part[a * parts + p].
EXPORT int gather_rows(const uint8_t* const* part, const int64_t* bytes, int arrays, const int64_t* ends, int parts,
                       const int64_t* order, int64_t count, uint8_t* const* out, int threads) {
    return guarded([&] {
        for_each(threads, count, 1024, [&](int64_t m) {
            check_index(order[m], parts ? ends[parts - 1] : 0, "rows");
            const int64_t p = std::upper_bound(ends, ends + parts, order[m]) - ends;
            const int64_t row = p ? order[m] - ends[p - 1] : order[m];
            for (int a = 0; a < arrays; a++)
                std::memcpy(out[a] + m * bytes[a], part[a * parts + p] + row * bytes[a], size_t(bytes[a]));
        });
    });
}
