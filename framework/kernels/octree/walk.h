// The leaves of an octree along rays, in order. See ../layout.py for the structure, ../walk.py for the reference.
//
// A vector of rays walks together, one ray a lane; a ray that ends is replaced by the next, so no lane waits. Each step
// finds the largest known empty block around the ray's cell (or the cell, if it is a leaf) and moves to its far side.
#pragma once

#include "runtime/common.h"

#include <cmath>
#include <cstdint>
#include <limits>

namespace octree {

constexpr int BRICK = 8, OCTANT = 4;  // cells along an edge
constexpr float FARTHEST = 1 << 20;   // largest coordinate of an origin, in cells; see ../walk.py

struct Layout {
    const float* origin;    // (3) corner of the first cell
    float cell;             // edge of a cell
    const int64_t* size;    // (3) bricks along each axis
    const int32_t* bricks;  // (X Y Z) index of a brick, or minus the distance in bricks to the nearest one
    const int64_t* masks;   // (B, 8) leaves of each octant, a bit each
    const int32_t* firsts;  // (B, 8) index of each octant's first leaf
};

struct Beams {  // R rays
    const float *origins, *directions;  // (R, 3)
    const float *nears, *fars;          // (R)
};

// Leaves are spread over memory: without this, a walk mostly waits.
template <typename T>
inline void fetch(const T* from, int count = 1) {
    const char* bytes = reinterpret_cast<const char*>(from);
    for (int64_t byte = 0; byte < int64_t(count * sizeof(T)); byte += 64) __builtin_prefetch(bytes + byte);
    __builtin_prefetch(bytes + count * sizeof(T) - 1);
}

// The walk of one ray in each lane. `Light` follows what a ray has met:
//   start(lane, ray); finish(lane, ray); expect(leaf): it is met soon, and its values should be on their way.
//   meet(leaf, t0, t1, ends): a step of all lanes through leaves (-1: none) from t0 to t1; sets ends for rays that end.
template <typename Light>
class Walk {
public:
    Walk(const Layout& layout, const Beams& beams, Light& light) : g(layout), beams(beams), light(light) {
        for (int a = 0; a < 3; a++) last[a] = int32_t(g.size[a]) * BRICK - 1;
    }

    void run(int64_t begin, int64_t end) {
        next = begin, stop = end;
        int walking = 0;
        for (int lane = 0; lane < LANES; lane++) ray[lane] = -1, walking += take(lane);
        while (walking > 0) {
            for (int lane = 0; lane < LANES; lane++)
                if (ray[lane] >= 0) look(lane);
            advance();
            light.meet(leaf, before, after, ends);
            for (int lane = 0; lane < LANES; lane++) {
                if (ray[lane] < 0 || !(ends[lane] || t[lane] >= far[lane])) continue;
                light.finish(lane, ray[lane]);
                ray[lane] = -1;
                walking -= !take(lane);
            }
        }
    }

private:
    const Layout& g;
    const Beams& beams;
    Light& light;
    int64_t next = 0, stop = 0;
    int32_t last[3];
    alignas(64) int32_t cell[3][LANES], low[3][LANES], size[LANES], leaf[LANES], ends[LANES];
    alignas(64) float p[3][LANES], d[3][LANES], inverse[3][LANES];  // in cells; 1 / d
    alignas(64) float t[LANES], before[LANES], after[LANES], far[LANES];
    int64_t ray[LANES];

    // Starts the next ray that meets the grid in a lane; the others are finished. Returns whether there is one.
    bool take(int lane) {
        while (next < stop) {
            const int64_t r = next++;
            light.start(lane, r);
            if (enter(lane, r)) {
                ray[lane] = r;
                return true;
            }
            light.finish(lane, r);
        }
        t[lane] = far[lane] = 0, size[lane] = 1, leaf[lane] = -1;
        for (int a = 0; a < 3; a++) cell[a][lane] = low[a][lane] = 0, p[a][lane] = 0, d[a][lane] = inverse[a][lane] = 1;
        return false;
    }

    bool enter(int lane, int64_t r) {
        float begin = beams.nears[r] > 0 ? beams.nears[r] : 0, end = beams.fars[r];
        for (int a = 0; a < 3; a++) {
            const float from = (beams.origins[3 * r + a] - g.origin[a]) / g.cell;
            float along = beams.directions[3 * r + a] / g.cell;
            if (std::fabs(along) < 1e-12f) along = std::copysign(1e-12f, along);
            const float inv = 1 / along, one = (0 - from) * inv, two = (float(last[a] + 1) - from) * inv;
            begin = std::max(begin, std::min(one, two)), end = std::min(end, std::max(one, two));
            p[a][lane] = from, d[a][lane] = along, inverse[a][lane] = inv;
            if (!(std::fabs(from) < FARTHEST && std::fabs(along) < 1e9f)) return false;  // also NaN
        }
        if (!(begin < end)) return false;
        for (int a = 0; a < 3; a++) {
            const float at = p[a][lane] + begin * d[a][lane];
            cell[a][lane] = at > 0 ? std::min(int32_t(std::min(at, 1e9f)), last[a]) : 0;
        }
        t[lane] = begin, far[lane] = end;
        return true;
    }

    // The block around a lane's cell: all empty, or a leaf.
    void look(int lane) {
        const int32_t x = cell[0][lane], y = cell[1][lane], z = cell[2][lane];
        const int32_t i = x >> 3, j = y >> 3, k = z >> 3;
        const int32_t brick = g.bricks[(i * g.size[1] + j) * g.size[2] + k];
        leaf[lane] = -1;
        if (brick < 0) {
            low[0][lane] = (i + brick + 1) * BRICK, low[1][lane] = (j + brick + 1) * BRICK,
            low[2][lane] = (k + brick + 1) * BRICK, size[lane] = (-2 * brick - 1) * BRICK;
            return;
        }
        const int octant = (x >> 2 & 1) | (y >> 2 & 1) << 1 | (z >> 2 & 1) << 2;
        const uint64_t mask = uint64_t(g.masks[int64_t(brick) * 8 + octant]);
        if (mask == 0) {
            low[0][lane] = x & ~3, low[1][lane] = y & ~3, low[2][lane] = z & ~3, size[lane] = OCTANT;
            return;
        }
        const int bit = (x & 3) | (y & 3) << 2 | (z & 3) << 4;
        low[0][lane] = x, low[1][lane] = y, low[2][lane] = z, size[lane] = 1;
        if (!(mask >> bit & 1)) return;
        leaf[lane] = g.firsts[int64_t(brick) * 8 + octant] + __builtin_popcountll(mask & ((uint64_t(1) << bit) - 1));
        light.expect(leaf[lane]);
    }

    static Ints whole(const int32_t* from) {
        Ints out;
        std::memcpy(&out, from, sizeof out);
        return out;
    }

    // All lanes to the far side of their blocks.
    void advance() {
        const Ints edge = whole(size);
        const Floats now = load(t);
        Floats reach = load(far), exits[3];
        Ints sides[3], outside{};
        for (int a = 0; a < 3; a++) {
            const Ints from = whole(low[a]);
            sides[a] = load(d[a]) > 0 ? from + edge : from;
            exits[a] = (__builtin_convertvector(sides[a], Floats) - load(p[a])) * load(inverse[a]);
            reach = smaller(reach, exits[a]);
        }
        reach = larger(reach, now);  // rounding must not lead back
        store(before, now), store(after, reach);
        for (int a = 0; a < 3; a++) {
            const Ints from = whole(low[a]), top = from + edge - 1, zero{};
            const Floats along = load(d[a]);
            // The cell behind the side that the ray leaves by; on other axes the cell of the position, in the block.
            Ints at = __builtin_convertvector(smaller(larger(load(p[a]) + reach * along, splat(0)), splat(1e9f)), Ints);
            at = at < from ? from : at;
            at = at > top ? top : at;
            const Ints beyond = along > 0 ? sides[a] : sides[a] - 1;
            at = exits[a] <= reach ? beyond : at;
            outside |= (at < zero) | (at > last[a]);
            at = at < zero ? zero : at;
            at = at > last[a] ? zero + last[a] : at;
            std::memcpy(cell[a], &at, sizeof at);
        }
        store(t, outside ? load(far) : reach);
    }
};

}  // namespace octree
