// Rays through an occupancy grid, shared by waves.cpp (waves) and trace.cpp (traces). See waves.py.
#pragma once

#include "runtime/common.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace marching {


constexpr int BLOCK = 4;  // cells along an edge of the coarser level

// x, y, z and an unused lane.
typedef float Four __attribute__((vector_size(16)));
typedef int32_t FourInts __attribute__((vector_size(16)));

inline Four four(const float* from) { return Four{from[0], from[1], from[2], 0}; }

struct Grid {
    const uint8_t* bits;    // one bit per cell, 8 cells along z in a byte
    const uint8_t* blocks;  // one byte per block of 4^3 cells: distance, in blocks, to one with an occupied cell
    int resolution, side;

    // The cell in a box that is 2^level times as large.
    Grid outer(int level) const {
        const int64_t cells = int64_t(resolution) * resolution * resolution, its_blocks = int64_t(side) * side * side;
        return {bits + level * ((cells + 7) / 8), blocks + level * its_blocks, resolution, side};
    }
    bool occupied(FourInts c) const {
        const int64_t cell = (int64_t(c[0]) * resolution + c[1]) * resolution + c[2];
        return bits[cell >> 3] >> (cell & 7) & 1;
    }
    int distance(FourInts c) const {
        const FourInts b = c / BLOCK;
        return blocks[(b[0] * side + b[1]) * side + b[2]];
    }
};

// Start of step k of a ray: evenly spaced while step > cone * t, then growing by a factor of 1 + cone.
struct Steps {
    float first, step, inverse, cone;
    float even = std::numeric_limits<float>::infinity();  // steps before they grow

    Steps(float first, float step, float cone) : first(first), step(step), inverse(1 / step), cone(cone) {
        if (cone > 0) even = std::ceil(std::max(step / cone - first, 0.0f) / step);
    }
    float start(int32_t k) const {
        const float n = float(k);
        if (n <= even) return first + n * step;
        return (first + even * step) * std::pow(1 + cone, n - even);
    }
    // The last step that certainly ends before t.
    int32_t before(float t) const {
        float k = (t - first) * inverse;
        if (k > even) k = even + std::log(t / (first + even * step)) / std::log1p(cone);
        return int32_t(std::min(k, 2e9f)) - 1;
    }
};

// A ray in units of cells, from the grid's corner.
struct Ray {
    Four origin, direction, inverse;
    FourInts forward;  // -1 where the direction is positive

    Ray(const float* o, const float* d, const float* box, int resolution) {
        const Four low = four(box), scale = float(resolution) / (four(box + 3) - low + Four{0, 0, 0, 1});
        origin = (four(o) - low) * scale;
        direction = four(d) * scale;
        forward = direction > 0;
        // Along an axis without motion, the face behind is infinitely far ahead.
        inverse = direction == 0 ? Four{} - std::numeric_limits<float>::infinity() : 1 / direction;
    }
    FourInts cell(float t, int resolution) const {
        const FourInts c = __builtin_convertvector(origin + t * direction, FourInts), zero = {};
        const FourInts last = zero + (resolution - 1), positive = c < 0 ? zero : c;
        return positive > last ? last : positive;
    }
    // The same ray in cells of a box that is 2^level times as large.
    Ray outer(int level, int resolution) const {
        const float size = std::ldexp(1.0f, -level), half = float(resolution) / 2;
        Ray ray = *this;
        ray.origin = (origin - half) * size + half;
        ray.direction = direction * size;
        ray.inverse = inverse / size;
        return ray;
    }
    // The smallest nested box that contains the position at distance t, or the largest box.
    int level(float t, int resolution, int levels) const {
        const Four across = (origin + t * direction - float(resolution) / 2) / (float(resolution) / 2);
        const float farthest = std::max({std::abs(across[0]), std::abs(across[1]), std::abs(across[2])});
        uint32_t bits;  // farthest < 2^level, and not less than half of it
        std::memcpy(&bits, &farthest, sizeof bits);
        return std::clamp(int(bits >> 23) - 126, 0, levels - 1);
    }
    // Distance where the ray leaves the cube of `size` cells that contains cell c, plus `more` cells around it.
    float leave(FourInts c, int size, int more) const {
        const FourInts corner = (c & -size) + (forward ? FourInts{} + (size + more) : FourInts{} - more);
        const Four t = (__builtin_convertvector(corner, Four) - origin) * inverse;
        float nearest = std::numeric_limits<float>::infinity();
        for (int a = 0; a < 3; a++) nearest = std::min(nearest, t[a]);  // the order of operands drops 0 * infinity
        return nearest;
    }
};

// Appends the starts and ends of up to `limit` steps; returns their number, and the step to continue from. `smallest`
// and `first` are the ray and the grid in the smallest nested box.
inline int march_ray(const Ray& smallest, const Steps& steps, const Grid& first, int levels, float enter, float leave, int limit,
              int32_t& next, std::vector<float>& starts, std::vector<float>& ends) {
    int found = 0, level = 0;
    int32_t k = next;
    Ray ray = smallest;
    Grid grid = first;
    float face = std::numeric_limits<float>::infinity();  // where the ray leaves the box, if there are larger boxes
    float start = steps.start(k);
    while (found < limit) {
        const float end = steps.start(k + 1), middle = (start + end) / 2;
        if (!(middle < leave)) break;
        if (levels > 1) {
            const int here = smallest.level(middle, first.resolution, levels);
            if (here != level || face == std::numeric_limits<float>::infinity()) {
                level = here, ray = smallest.outer(level, first.resolution), grid = first.outer(level);
                face = ray.leave(FourInts{}, grid.resolution, 0);
            }
        }
        const FourInts c = ray.cell(middle, grid.resolution);
        const int distance = grid.distance(c);
        if (distance == 0 && grid.occupied(c)) {
            if (middle >= enter) {
                starts.push_back(start);
                ends.push_back(end);
                found++;
            }
            k++, start = end;
        } else {
            const float clear = distance == 0 ? ray.leave(c, 1, 0) : ray.leave(c, BLOCK, (distance - 1) * BLOCK);
            const int32_t on = steps.before(std::min(clear, face));
            start = on > k + 1 ? steps.start(on) : end;
            k = std::max(k + 1, on);
        }
    }
    next = k;
    return found;
}

}  // namespace marching
