// The leaves of an octree along rays, in order. See layout.py for the structure, walk.py for the reference.
//
// A vector of rays walks together, one ray a lane; a ray that ends is replaced by the next, so no lane waits. Each step
// finds the largest known empty block around the ray's cell (or the cell, if it is a leaf) and moves to its far side.
// Each ray is in one grid at a time, the finest that shows it there.
#pragma once

#include "runtime/common.h"

#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>

namespace octree {

constexpr int BRICK = 8, OCTANT = 4;  // cells along an edge
constexpr int MAX_LEVELS = 24;        // grids around one another; see layout.py
constexpr float FARTHEST = 1 << 20;   // largest coordinate of an origin, in cells; see walk.py

struct Grid {
    const float* origin;    // (3) corner of the first cell
    float cell;             // edge of a cell
    const int64_t* size;    // (3) bricks along each axis
    const int32_t* bricks;  // (X Y Z) index of a brick, or minus the distance in bricks to the nearest one
    const int64_t* masks;   // (B, 8) leaves of each octant, a bit each
    const int32_t* firsts;  // (B, 8) index of each octant's first leaf, within the grid
    int32_t first;          // index of the grid's first leaf
};

struct Layout {  // nested grids; each has cells of twice the edge of the one before
    Grid grids[MAX_LEVELS];
    int count;

    Layout(int levels, float cell, const float* const* origins, const int64_t* sizes, const int32_t* const* bricks,
           const int64_t* const* masks, const int32_t* const* firsts, const int64_t* leaves)
        : count(levels) {
        if (levels < 1 || levels > MAX_LEVELS) throw std::invalid_argument("an octree has 1 to 24 levels");
        for (int l = 0; l < levels; l++, cell *= 2)
            grids[l] = {origins[l], cell, sizes + 3 * l, bricks[l], masks[l], firsts[l], int32_t(leaves[l])};
    }
};

struct Beams {  // R rays
    const float *origins, *directions;  // (R, 3)
    const float *nears, *fars;          // (R)
    const float* smallest;              // (R) smallest edge of cells, per unit of distance; null for none
};

struct Passage {  // a step of all lanes
    alignas(64) int32_t leaf[LANES] = {}, level[LANES] = {};  // leaf: -1 for none
    alignas(64) float from[LANES] = {}, to[LANES] = {};       // distances
    alignas(64) float per_cell[LANES] = {};                   // 1 / edge of the level's cells
};

// Leaves are spread over memory: without this, a walk mostly waits.
template <typename T>
inline void fetch(const T* from, int count = 1) {
    const char* bytes = reinterpret_cast<const char*>(from);
    for (int64_t byte = 0; byte < int64_t(count * sizeof(T)); byte += 64) __builtin_prefetch(bytes + byte);
    __builtin_prefetch(bytes + count * sizeof(T) - 1);
}

// The walk of one ray in each lane. `Light` follows the leaves that a ray meets:
//   start(lane, ray); finish(lane, ray); expect(leaf): it is met soon, and its values should be on their way.
//   meet(passage, ends): a step of all lanes through leaves; sets ends for rays that end.
template <typename Light>
class Walk {
public:
    Walk(const Layout& layout, const Beams& beams, Light& light) : layout(layout), beams(beams), light(light) {}

    void run(int64_t begin, int64_t end) {
        next = begin, stop = end;
        int walking = 0;
        for (int lane = 0; lane < LANES; lane++) ray[lane] = -1, walking += take(lane);
        while (walking > 0) {
            for (int lane = 0; lane < LANES; lane++)
                if (ray[lane] >= 0) look(lane);
            advance();
            light.meet(passage, ends);
            for (int lane = 0; lane < LANES; lane++) {
                if (ray[lane] < 0 || !(ends[lane] || t[lane] >= far[lane])) continue;
                if (!ends[lane] && layout.count > 1 && enter(lane, ray[lane], t[lane])) continue;
                light.finish(lane, ray[lane]);
                ray[lane] = -1;
                walking -= !take(lane);
            }
        }
    }

private:
    const Layout& layout;
    const Beams& beams;
    Light& light;
    Passage passage;
    int64_t next = 0, stop = 0;
    alignas(64) int32_t cell[3][LANES], low[3][LANES], last[3][LANES] = {}, size[LANES], ends[LANES];
    alignas(64) float p[3][LANES], d[3][LANES], inverse[3][LANES];  // in cells; 1 / d
    alignas(64) float t[LANES], far[LANES];  // far: where the ray leaves its grid, or ends
    const Grid* grid[LANES];
    int64_t ray[LANES];

    // Starts the next ray that meets a grid in a lane; the others are finished. Returns whether there is one.
    bool take(int lane) {
        while (next < stop) {
            const int64_t r = next++;
            light.start(lane, r);
            if (enter(lane, r, -1)) {
                ray[lane] = r;
                return true;
            }
            light.finish(lane, r);
        }
        t[lane] = far[lane] = 0, size[lane] = 1, passage.leaf[lane] = -1;
        for (int a = 0; a < 3; a++) cell[a][lane] = low[a][lane] = 0, p[a][lane] = 0, d[a][lane] = inverse[a][lane] = 1;
        return false;
    }

    // Puts a ray into a grid: at distance `now` into the finest that shows it there or, if none does, into the next one
    // that it meets. Returns whether there is one.
    bool enter(int lane, int64_t r, float now) {
        constexpr float NEVER = std::numeric_limits<float>::infinity();
        float begin[MAX_LEVELS], end[MAX_LEVELS];
        for (int l = layout.count; l-- > 0;) {
            clip(lane, r, l, begin[l], end[l]);
            if (l == layout.count - 1 && !(begin[l] < end[l])) return false;  // its box contains the others
        }
        for (;;) {
            float closest = NEVER;  // where a finer grid begins
            for (int l = 0; l < layout.count; l++) {
                if (!(begin[l] < end[l]) || now >= end[l]) continue;
                if (begin[l] <= now) {
                    if (l > 0) place(lane, r, l);  // the finest was placed last
                    put(lane, l, now, std::min(end[l], closest));
                    return true;
                }
                closest = std::min(closest, begin[l]);
            }
            if (closest == NEVER) return false;
            now = closest;
        }
    }

    // Describes a ray in a level's cells. Returns whether float32 can.
    bool place(int lane, int64_t r, int level) {
        const Grid& g = layout.grids[level];
        bool good = true;
        for (int a = 0; a < 3; a++) {
            const float from = (beams.origins[3 * r + a] - g.origin[a]) / g.cell;
            float along = beams.directions[3 * r + a] / g.cell;
            if (std::fabs(along) < 1e-12f) along = std::copysign(1e-12f, along);
            p[a][lane] = from, d[a][lane] = along, inverse[a][lane] = 1 / along;
            last[a][lane] = int32_t(g.size[a]) * BRICK - 1;
            good = good && std::fabs(from) < FARTHEST && std::fabs(along) < 1e9f;  // not NaN
        }
        return good;
    }

    // Where a level may show a ray: in its box, and while its cells are not too small.
    void clip(int lane, int64_t r, int level, float& begin, float& end) {
        const bool good = place(lane, r, level);
        begin = beams.nears[r] > 0 ? beams.nears[r] : 0, end = beams.fars[r];
        for (int a = 0; a < 3; a++) {
            const float from = p[a][lane], inv = inverse[a][lane];
            const float one = (0 - from) * inv, two = (float(last[a][lane] + 1) - from) * inv;
            begin = std::max(begin, std::min(one, two)), end = std::min(end, std::max(one, two));
        }
        const float edge = layout.grids[level].cell;
        if (beams.smallest && level < layout.count - 1) end = std::min(end, edge / beams.smallest[r]);
        if (!good) end = -1;
    }

    void put(int lane, int level, float now, float until) {
        grid[lane] = &layout.grids[level];
        for (int a = 0; a < 3; a++) {
            const float at = p[a][lane] + now * d[a][lane];
            cell[a][lane] = at > 0 ? std::min(int32_t(std::min(at, 1e9f)), last[a][lane]) : 0;
        }
        passage.level[lane] = level, passage.per_cell[lane] = 1 / grid[lane]->cell;
        t[lane] = now, far[lane] = until;
    }

    // The block around a lane's cell: all empty, or a leaf.
    void look(int lane) {
        const Grid& g = *grid[lane];
        int32_t& leaf = passage.leaf[lane];
        const int32_t x = cell[0][lane], y = cell[1][lane], z = cell[2][lane];
        const int32_t i = x >> 3, j = y >> 3, k = z >> 3;
        const int32_t brick = g.bricks[(i * g.size[1] + j) * g.size[2] + k];
        leaf = -1;
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
        const int32_t before = g.firsts[int64_t(brick) * 8 + octant] + g.first;
        leaf = before + __builtin_popcountll(mask & ((uint64_t(1) << bit) - 1));
        light.expect(leaf);
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
        store(passage.from, now), store(passage.to, reach);
        for (int a = 0; a < 3; a++) {
            const Ints from = whole(low[a]), top = from + edge - 1, most = whole(last[a]), zero{};
            const Floats along = load(d[a]);
            // The cell behind the side that the ray leaves by; on other axes the cell of the position, in the block.
            Ints at = __builtin_convertvector(smaller(larger(load(p[a]) + reach * along, splat(0)), splat(1e9f)), Ints);
            at = at < from ? from : at;
            at = at > top ? top : at;
            const Ints beyond = along > 0 ? sides[a] : sides[a] - 1;
            at = exits[a] <= reach ? beyond : at;
            outside |= (at < zero) | (at > most);
            at = at < zero ? zero : at;
            at = at > most ? most : at;
            std::memcpy(cell[a], &at, sizeof at);
        }
        store(t, outside ? load(far) : reach);
    }
};

}  // namespace octree
