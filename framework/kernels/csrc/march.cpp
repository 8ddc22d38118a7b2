// Marching rays through an occupancy grid, a wave at a time. See ../march.py for the reference.
//
// A ray's candidates are the steps first + k * step (growing with distance beyond step / cone). A wave finds the next
// `limit` candidates of every living ray whose middle lies in an occupied cell; blocks of 8^3 empty cells are crossed
// at once.
#include "common.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace {

constexpr int BLOCK = 8;  // cells along an edge of the coarser level

struct Grid {
    const uint8_t* bits;    // one bit a cell, 8 cells along z in a byte
    const uint8_t* blocks;  // one byte a block of 8^3 cells: whether any of them is occupied
    int resolution;

    bool occupied(const int* c) const {
        const int64_t cell = (int64_t(c[0]) * resolution + c[1]) * resolution + c[2];
        return bits[cell >> 3] >> (cell & 7) & 1;
    }
    bool block_occupied(const int* c) const {
        const int64_t side = (resolution + BLOCK - 1) / BLOCK;
        return blocks[(int64_t(c[0] / BLOCK) * side + c[1] / BLOCK) * side + c[2] / BLOCK];
    }
};

// Where step k of a ray starts: evenly spaced while step > cone * t, then growing by a factor of 1 + cone.
struct Steps {
    float first, step, cone;
    int64_t even;  // steps before they grow

    Steps(float first, float step, float cone) : first(first), step(step), cone(cone) {
        even = std::numeric_limits<int64_t>::max();
        if (cone > 0) even = int64_t(std::ceil(std::max(step / cone - first, 0.0f) / step));
    }
    float start(int64_t k) const {
        if (k <= even) return first + float(k) * step;
        return (first + float(even) * step) * std::pow(1 + cone, float(k - even));
    }
    // The first step that may end beyond t; one too early rather than too late.
    int64_t reaching(float t) const {
        const float k = (t - first) / step;
        if (k <= float(even)) return int64_t(k) - 1;
        const float base = first + float(even) * step;
        return even + int64_t(std::log(std::max(t / base, 1.0f)) / std::log1p(cone)) - 1;
    }
};

struct Ray {
    const float *origin, *direction;
    float inverse[3];

    Ray(const float* origin, const float* direction) : origin(origin), direction(direction) {
        for (int a = 0; a < 3; a++) inverse[a] = 1 / direction[a];
    }
    float at(int axis, float t) const { return origin[axis] + t * direction[axis]; }
};

struct Frame {
    float low[3], scale[3], cell[3];
    int resolution;

    Frame(const float* box, int resolution) : resolution(resolution) {
        for (int a = 0; a < 3; a++) {
            low[a] = box[a];
            scale[a] = float(resolution) / (box[3 + a] - box[a]);
            cell[a] = (box[3 + a] - box[a]) / float(resolution);
        }
    }
    void find(const Ray& ray, float t, int* c) const {
        for (int a = 0; a < 3; a++) {
            const int index = int((ray.at(a, t) - low[a]) * scale[a]);
            c[a] = index < 0 ? 0 : index >= resolution ? resolution - 1 : index;
        }
    }
    // Distance at which the ray leaves the cube of `size` cells that cell c lies in.
    float leave(const Ray& ray, const int* c, int size) const {
        float nearest = std::numeric_limits<float>::infinity();
        for (int a = 0; a < 3; a++) {
            if (ray.direction[a] == 0) continue;
            const int corner = c[a] / size * size + (ray.direction[a] > 0 ? size : 0);
            nearest = std::min(nearest, (low[a] + float(corner) * cell[a] - ray.origin[a]) * ray.inverse[a]);
        }
        return nearest;
    }
};

// Appends the starts and lengths of up to `limit` steps; returns how many, and the step to go on from.
int march_ray(const Ray& ray, const Steps& steps, const Frame& frame, const Grid& grid, float enter, float leave,
              int limit, int32_t& next, std::vector<float>& starts, std::vector<float>& ends) {
    int found = 0;
    int64_t k = next;
    while (found < limit) {
        const float start = steps.start(k), end = steps.start(k + 1), middle = (start + end) / 2;
        if (!(middle < leave)) break;
        int c[3];
        frame.find(ray, middle, c);
        const bool near_occupied = grid.block_occupied(c);
        if (near_occupied && grid.occupied(c)) {
            if (middle >= enter) {
                starts.push_back(start);
                ends.push_back(end);
                found++;
            }
            k++;
        } else {
            k = std::max(k + 1, steps.reaching(frame.leave(ray, c, near_occupied ? 1 : BLOCK)));
        }
    }
    next = int32_t(std::min<int64_t>(k, std::numeric_limits<int32_t>::max()));
    return found;
}

}  // namespace

// One bit a cell, and one byte a block of 8^3 cells, from one byte a cell.
EXPORT void pack_occupancy(const uint8_t* occupied, int resolution, uint8_t* bits, uint8_t* blocks) {
    const int64_t cells = int64_t(resolution) * resolution * resolution, side = (resolution + BLOCK - 1) / BLOCK;
    std::memset(bits, 0, size_t((cells + 7) / 8));
    std::memset(blocks, 0, size_t(side * side * side));
    for (int64_t cell = 0; cell < cells; cell++) {
        if (!occupied[cell]) continue;
        bits[cell >> 3] |= uint8_t(1 << (cell & 7));
        const int64_t x = cell / resolution / resolution, y = cell / resolution % resolution, z = cell % resolution;
        blocks[(x / BLOCK * side + y / BLOCK) * side + z / BLOCK] = 1;
    }
}

// Where each ray enters and leaves the box, and its first step: `enter` less a share of a step. Returns the number of
// rays that hit the box, whose indices are written to `alive`.
EXPORT int64_t march_begin(const float* origins, const float* directions, const float* nears, const float* fars,
                           const float* shift, int64_t rays, const float* box, float step, float* enter, float* leave,
                           float* first, int64_t* alive, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t r = 0; r < rays; r++) {
        float from = 0, to = std::numeric_limits<float>::infinity();
        for (int a = 0; a < 3; a++) {
            const float o = origins[r * 3 + a], d = directions[r * 3 + a];
            if (d == 0) {
                if (o < box[a] || o > box[3 + a]) to = -1;
                continue;
            }
            const float one = (box[a] - o) / d, two = (box[3 + a] - o) / d;
            from = std::max(from, std::min(one, two));
            to = std::min(to, std::max(one, two));
        }
        enter[r] = std::max(from, nears[r]);
        leave[r] = std::min(to, fars[r]);
        first[r] = enter[r] - (shift ? shift[r] * step : 0);
    }
    int64_t hits = 0;
    for (int64_t r = 0; r < rays; r++)
        if (leave[r] > enter[r]) alive[hits++] = r;
    return hits;
}

// The next samples of each living ray, packed ray by ray. Returns their number N.
// next (R): the step to go on from, kept up here; counts (A): samples of each living ray.
// starts, ends (N), owners (N), positions (N, 3) have room for A * limit.
EXPORT int64_t march_wave(const float* origins, const float* directions, const float* enter, const float* leave,
                          const float* first, int32_t* next, const int64_t* alive, int64_t living, int limit,
                          const float* box, float step, float cone, const uint8_t* bits, const uint8_t* blocks,
                          int resolution, int32_t* counts, float* starts, float* ends, int64_t* owners,
                          float* positions, int threads) {
    const Grid grid{bits, blocks, resolution};
    const Frame frame(box, resolution);
    std::vector<int64_t> totals(threads + 1, 0);
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = thread_index();
        const Part part(living, me, threads);
        std::vector<float> my_starts, my_ends;
        my_starts.reserve(size_t(part.end - part.begin) * limit);
        my_ends.reserve(size_t(part.end - part.begin) * limit);
        for (int64_t i = part.begin; i < part.end; i++) {
            const int64_t r = alive[i];
            const Ray ray(origins + r * 3, directions + r * 3);
            const Steps steps(first[r], step, cone);
            counts[i] = march_ray(ray, steps, frame, grid, enter[r], leave[r], limit, next[r], my_starts, my_ends);
        }
        totals[me + 1] = int64_t(my_starts.size());
#pragma omp barrier
        int64_t at = 0;
        for (int t = 0; t < me; t++) at += totals[t + 1];
        std::copy(my_starts.begin(), my_starts.end(), starts + at);
        std::copy(my_ends.begin(), my_ends.end(), ends + at);
        for (int64_t i = part.begin, n = at; i < part.end; i++) {
            const int64_t r = alive[i];
            for (int s = 0; s < counts[i]; s++, n++) {
                owners[n] = r;
                const float t = (starts[n] + ends[n]) / 2;
                for (int a = 0; a < 3; a++) positions[n * 3 + a] = origins[r * 3 + a] + t * directions[r * 3 + a];
            }
        }
    }
    int64_t total = 0;
    for (int64_t t : totals) total += t;
    return total;
}

// After a wave's densities are known: adds to the optical depth `spent` (R) of each living ray, marks the samples that
// light still reached, and writes the rays that go on. Returns the number of those.
EXPORT int64_t march_advance(const int64_t* alive, int64_t living, const int32_t* counts, int limit,
                             const float* sigma, const float* starts, const float* ends, float budget, float* spent,
                             uint8_t* reached, int64_t* going_on) {
    int64_t n = 0, left = 0;
    for (int64_t i = 0; i < living; i++) {
        const int64_t r = alive[i];
        float tau = spent[r];
        for (int s = 0; s < counts[i]; s++, n++) {
            reached[n] = !(tau >= budget);  // NaN goes on: a broken field must be seen
            tau += sigma[n] * (ends[n] - starts[n]);
        }
        spent[r] = tau;
        if (counts[i] == limit && !(tau >= budget)) going_on[left++] = r;
    }
    return left;
}

// Order (M) in which the reached samples of all waves stand ray by ray, and offsets (R + 1). Returns M.
EXPORT int64_t sort_by_ray(const int64_t* owners, const uint8_t* reached, int64_t count, int64_t rays, int64_t* order,
                           int64_t* offsets) {
    std::fill(offsets, offsets + rays + 1, 0);
    for (int64_t n = 0; n < count; n++) offsets[owners[n] + 1] += reached[n];
    for (int64_t r = 0; r < rays; r++) offsets[r + 1] += offsets[r];
    std::vector<int64_t> at(offsets, offsets + rays);
    for (int64_t n = 0; n < count; n++)
        if (reached[n]) order[at[owners[n]]++] = n;
    return offsets[rays];
}
