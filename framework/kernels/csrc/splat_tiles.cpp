// Which Gaussians each tile of an image shows, from front to back. See ../splat_tiles.py.
#include "splat.h"

#include <algorithm>
#include <vector>

namespace {

constexpr int64_t GRAIN = 2048;  // Gaussians in a chunk

struct Grid {
    int columns, rows;
    Grid(int width, int height) : columns((width + TILE - 1) / TILE), rows((height + TILE - 1) / TILE) {}
};

// Tiles [left, right) x [top, bottom) that the box around a Gaussian touches by a pixel's centre.
struct Span {
    int left, right, top, bottom;
    Span(const float* g, const Grid& grid) {
        left = first(g[X] - g[REACH_X], grid.columns), right = last(g[X] + g[REACH_X], grid.columns);
        top = first(g[Y] - g[REACH_Y], grid.rows), bottom = last(g[Y] + g[REACH_Y], grid.rows);
    }
    // Centres lie at 0.5, 1.5, ...: a tile's go from 0.5 to TILE - 0.5 after its edge.
    static int first(float from, int count) {
        const float tile = std::ceil((from - (TILE - 0.5f)) / TILE);
        return tile < 0 ? 0 : (tile > count ? count : int(tile));
    }
    static int last(float to, int count) {
        const float tile = std::floor((to - 0.5f) / TILE) + 1;
        return tile < 0 ? 0 : (tile > count ? count : int(tile));
    }
};

// Whether an ellipse comes within CUT on a tile: the least of a quadratic form over a rectangle.
bool touches(const float* g, int column, int row) {
    const float x0 = column * TILE + 0.5f - g[X], x1 = x0 + (TILE - 1), y0 = row * TILE + 0.5f - g[Y], y1 = y0 + (TILE - 1);
    const float near_x = x0 > 0 ? x0 : (x1 < 0 ? x1 : 0), near_y = y0 > 0 ? y0 : (y1 < 0 ? y1 : 0);
    if (near_x == 0 && near_y == 0) return true;
    const float ux = g[U_X], uy = g[U_Y], vy = g[V_Y], yy = uy * uy + vy * vy;
    float least = 3e38f;
    if (near_x != 0) {  // along the vertical edge that faces the centre
        const float y = std::min(std::max(-ux * uy * near_x / yy, y0), y1), u = ux * near_x + uy * y, v = vy * y;
        least = u * u + v * v;
    }
    if (near_y != 0) {
        const float x = std::min(std::max(-uy * near_y / ux, x0), x1), u = ux * x + uy * near_y, v = vy * near_y;
        least = std::min(least, u * u + v * v);
    }
    return least <= g[CUT] * 1.0001f;
}

template <typename Body>
void for_tiles(const float* g, const Grid& grid, const Body& body) {
    const Span span(g, grid);
    const bool one = span.right - span.left <= 1 && span.bottom - span.top <= 1;
    for (int row = span.top; row < span.bottom; row++)
        for (int column = span.left; column < span.right; column++)
            if (one || touches(g, column, row)) body(row * grid.columns + column);
}

}  // namespace

// The visible Gaussians by their distance, nearest first, and those of the same distance by index; `order` has room
// for `count`. A radix sort by the bits of a positive float. Returns how many there are.
EXPORT int splat_sort(const float* records, int64_t count, int32_t* order, int64_t* visible) {
    return guarded([&] {
        constexpr int BITS = 11, BUCKETS = 1 << BITS, PASSES = 3;
        std::vector<uint64_t> items, others;  // the key above the index
        std::vector<int64_t> starts(size_t(PASSES * BUCKETS), 0);
        items.reserve(size_t(count));
        for (int64_t g = 0; g < count; g++) {
            if (!(records[g * RECORD + CUT] > 0)) continue;
            uint32_t key;
            std::memcpy(&key, records + g * RECORD + DISTANCE, sizeof key);
            items.push_back(uint64_t(key) << 32 | uint32_t(g));
            for (int pass = 0; pass < PASSES; pass++)
                starts[size_t(pass * BUCKETS + int(key >> (pass * BITS) & (BUCKETS - 1)))]++;
        }
        others.resize(items.size());
        for (int pass = 0; pass < PASSES; pass++) {
            int64_t* start = starts.data() + pass * BUCKETS;
            int64_t sum = 0;
            for (int b = 0; b < BUCKETS; b++) {
                const int64_t inside = start[b];
                start[b] = sum, sum += inside;
            }
            for (const uint64_t item : items) others[size_t(start[item >> (32 + pass * BITS) & (BUCKETS - 1)]++)] = item;
            items.swap(others);
        }
        for (size_t i = 0; i < items.size(); i++) order[i] = int32_t(uint32_t(items[i]));
        *visible = int64_t(items.size());
    });
}

// The most entries that the tiles' lists can have: one for each tile that the box around a Gaussian touches.
EXPORT int splat_bound(const float* records, int64_t count, int width, int height, int threads, int64_t* bound) {
    return guarded([&] {
        const Grid grid(width, height);
        std::vector<int64_t> sums(size_t((count + GRAIN - 1) / GRAIN), 0);
        for_chunks(threads, int64_t(sums.size()), [&](int64_t chunk, int) {
            for (int64_t g = chunk * GRAIN; g < std::min(count, (chunk + 1) * GRAIN); g++)
                if (records[g * RECORD + CUT] > 0) {
                    const Span span(records + g * RECORD, grid);
                    sums[size_t(chunk)] += int64_t(std::max(span.right - span.left, 0)) * std::max(span.bottom - span.top, 0);
                }
        });
        *bound = 0;
        for (const int64_t some : sums) *bound += some;
        if (*bound > INT32_MAX) throw std::invalid_argument("more than 2^31 Gaussians on the image's tiles");
    });
}

// The lists: tile t's entries are [offsets[t], offsets[t + 1]), from front to back. Each says which Gaussian, and its
// slot: the place of the entry where they are sorted by Gaussian; Gaussian g's are from firsts[g]. There is room for
// `bound` entries. Returns how many there are.
EXPORT int splat_bin(const float* records, int64_t count, const int32_t* order, int64_t visible, int width, int height,
                     int64_t bound, int32_t* firsts, int32_t* offsets, int32_t* ids, int32_t* slots, int threads,
                     int64_t* entries) {
    return guarded([&] {
        const Grid grid(width, height);
        const int64_t tiles = int64_t(grid.columns) * grid.rows;
        // The tiles of each Gaussian, in the order in which they lie in memory.
        std::vector<std::vector<int32_t>> found(size_t((count + GRAIN - 1) / GRAIN));
        firsts[0] = 0;
        for_chunks(threads, int64_t(found.size()), [&](int64_t chunk, int) {
            std::vector<int32_t>& own = found[size_t(chunk)];
            own.reserve(size_t(4 * GRAIN));
            for (int64_t g = chunk * GRAIN; g < std::min(count, (chunk + 1) * GRAIN); g++) {
                const size_t before = own.size();
                if (records[g * RECORD + CUT] > 0) for_tiles(records + g * RECORD, grid, [&](int tile) { own.push_back(tile); });
                firsts[g + 1] = int32_t(own.size() - before);
            }
        });
        for (int64_t g = 0; g < count; g++) firsts[g + 1] += firsts[g];
        *entries = firsts[count];
        if (*entries > bound) throw std::invalid_argument("more entries than there is room for");
        std::vector<int32_t> tile_of;
        tile_of.reserve(size_t(*entries));
        for (const auto& own : found) tile_of.insert(tile_of.end(), own.begin(), own.end());
        // Dealt in the order of distance: how many of each tile a chunk has, where they go, and there.
        const int64_t chunks = (visible + GRAIN - 1) / GRAIN;
        std::vector<int32_t> counts(size_t(chunks * tiles), 0);
        for_chunks(threads, chunks, [&](int64_t chunk, int) {
            int32_t* own = counts.data() + chunk * tiles;
            for (int64_t i = chunk * GRAIN; i < std::min(visible, (chunk + 1) * GRAIN); i++) {
                check_index(order[i], count, "Gaussians");
                for (int32_t slot = firsts[order[i]]; slot < firsts[order[i] + 1]; slot++) own[tile_of[size_t(slot)]]++;
            }
        });
        int32_t sum = 0;
        for (int64_t tile = 0; tile < tiles; tile++) {
            offsets[tile] = sum;
            for (int64_t chunk = 0; chunk < chunks; chunk++) {
                int32_t& start = counts[size_t(chunk * tiles + tile)];
                const int32_t inside = start;
                start = sum, sum += inside;
            }
        }
        offsets[tiles] = sum;
        if (sum != *entries) throw std::invalid_argument("the order is not of these Gaussians");
        for_chunks(threads, chunks, [&](int64_t chunk, int) {
            int32_t* next = counts.data() + chunk * tiles;
            for (int64_t i = chunk * GRAIN; i < std::min(visible, (chunk + 1) * GRAIN); i++)
                for (int32_t slot = firsts[order[i]]; slot < firsts[order[i] + 1]; slot++) {
                    const int32_t at = next[tile_of[size_t(slot)]]++;
                    ids[at] = order[i], slots[at] = slot;
                }
        });
    });
}
