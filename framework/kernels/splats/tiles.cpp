// Lists of the Gaussians of each tile, from front to back. See tiles.py.
#include "splats/splat.h"

#include <algorithm>
#include <memory>
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
        return tile > 0 ? (tile > count ? count : int(tile)) : 0;  // NaN too
    }
    static int last(float to, int count) {
        const float tile = std::floor((to - 0.5f) / TILE) + 1;
        return tile < count ? (tile > 0 ? int(tile) : 0) : count;  // NaN too
    }
};

// Calls `body` with each tile that meets a Gaussian's ellipse, by the rectangle of its pixel centres. In a row these
// tiles are adjacent: from the leftmost to the rightmost point of the ellipse within the row.
template <typename Body>
void for_tiles(const float* g, const Grid& grid, const Body& body) {
    const Span span(g, grid);
    if (span.right - span.left <= 1 && span.bottom - span.top <= 1) {
        if (span.left < span.right && span.top < span.bottom) body(span.top * grid.columns + span.left);
        return;
    }
    // At a height y the ellipse reaches from (-u_y y - root) / u_x to (-u_y y + root) / u_x, root = sqrt(cut - (v_y y)^2).
    const float ux = g[U_X], uy = g[U_Y], vy = g[V_Y], cut = g[CUT] * 1.0001f;
    const float top = std::sqrt(cut) / vy, rightmost = -uy / (std::sqrt(uy * uy + vy * vy) + 1e-30f) * top;  // heights
    const auto x = [&](float y, float sign) {
        return g[X] + (-uy * y + sign * std::sqrt(std::max(cut - vy * vy * y * y, 0.0f))) / ux;
    };
    for (int row = span.top; row < span.bottom; row++) {
        const float first_y = row * TILE + 0.5f - g[Y];
        const float low = std::max(first_y, -top), high = std::min(first_y + (TILE - 1), top);
        if (low > high) continue;
        const float left = x(std::min(std::max(-rightmost, low), high), -1), right = x(std::min(std::max(rightmost, low), high), 1);
        const int from = std::max(Span::first(left, grid.columns), span.left), to = std::min(Span::last(right, grid.columns), span.right);
        for (int column = from; column < to; column++) body(row * grid.columns + column);
    }
}

}  // namespace

// Sorts the visible Gaussians by key (such as distance), then by index: a radix sort by the bits of a positive float.
// `order` has room for `count`, and keys are `stride` apart. Returns the number of visible Gaussians.
EXPORT int splat_sort(const float* records, int64_t count, const float* keys, int64_t stride, int32_t* order,
                      int64_t* visible) {
    return guarded([&] {
        constexpr int BITS = 11, BUCKETS = 1 << BITS, PASSES = 3;
        std::vector<uint64_t> items, others;  // the key above the index
        std::vector<int64_t> starts(size_t(PASSES * BUCKETS), 0);
        items.reserve(size_t(count));
        for (int64_t g = 0; g < count; g++) {
            if (!(records[g * RECORD + CUT] > 0)) continue;
            uint32_t key;
            std::memcpy(&key, keys + g * stride, sizeof key);
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

// Maximum number of entries of the tiles' lists: one for each tile that the box around a Gaussian touches.
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

// The lists: tile t's entries are [offsets[t], offsets[t + 1]), from front to back. Each has its Gaussian's index, and
// its slot: the place of the entry if all are sorted by Gaussian; Gaussian g's are from firsts[g]. There is room for
// `bound` entries. Without `slots` they are left out. Returns the number of entries.
EXPORT int splat_bin(const float* records, int64_t count, const int32_t* order, int64_t visible, int width, int height,
                     int64_t bound, int32_t* firsts, int32_t* offsets, int32_t* ids, int32_t* slots, int threads,
                     int64_t* entries) {
    return guarded([&] {
        const Grid grid(width, height);
        const int64_t tiles = int64_t(grid.columns) * grid.rows;
        // The tiles of each Gaussian, in memory order.
        std::vector<std::vector<int32_t>> found(size_t((count + GRAIN - 1) / GRAIN));
        firsts[0] = 0;
        for_chunks(threads, int64_t(found.size()), [&](int64_t chunk, int) {
            std::vector<int32_t>& own = found[size_t(chunk)];
            own.reserve(size_t(4 * GRAIN));
            for (int64_t g = chunk * GRAIN; g < std::min(count, (chunk + 1) * GRAIN); g++) {
                if (records[g * RECORD + CUT] > 0) for_tiles(records + g * RECORD, grid, [&](int tile) { own.push_back(tile); });
                firsts[g + 1] = int32_t(own.size());  // entries of the chunk's Gaussians
            }
        });
        std::vector<int64_t> before(found.size() + 1, 0);
        for (size_t chunk = 0; chunk < found.size(); chunk++) before[chunk + 1] = before[chunk] + int64_t(found[chunk].size());
        *entries = before.back();
        if (*entries > bound) throw std::invalid_argument("more entries than there is room for");
        const std::unique_ptr<int32_t[]> tile_of(new int32_t[size_t(*entries)]);
        for_chunks(threads, int64_t(found.size()), [&](int64_t chunk, int) {
            const auto& own = found[size_t(chunk)];
            std::copy(own.begin(), own.end(), tile_of.get() + before[size_t(chunk)]);
            for (int64_t g = chunk * GRAIN; g < std::min(count, (chunk + 1) * GRAIN); g++)
                firsts[g + 1] += int32_t(before[size_t(chunk)]);
        });
        // Entries are dealt out in the order of distance: each part counts its entries of each tile, finds their
        // places, and writes them. There are few parts, because each has a count for every tile.
        const int64_t parts = std::min<int64_t>((visible + GRAIN - 1) / GRAIN, 4 * threads);
        const auto part_of = [&](int64_t part, const auto& body) {
            for (int64_t i = visible * part / parts; i < visible * (part + 1) / parts; i++) body(order[i]);
        };
        std::vector<int32_t> counts(size_t(parts * tiles), 0);
        for_chunks(threads, parts, [&](int64_t part, int) {
            int32_t* own = counts.data() + part * tiles;
            part_of(part, [&](int32_t g) {
                check_index(g, count, "Gaussians");
                for (int32_t slot = firsts[g]; slot < firsts[g + 1]; slot++) own[tile_of[size_t(slot)]]++;
            });
        });
        int32_t sum = 0;
        for (int64_t tile = 0; tile < tiles; tile++) {
            offsets[tile] = sum;
            for (int64_t part = 0; part < parts; part++) {
                int32_t& start = counts[size_t(part * tiles + tile)];
                const int32_t inside = start;
                start = sum, sum += inside;
            }
        }
        offsets[tiles] = sum;
        if (sum != *entries) throw std::invalid_argument("the order is not of these Gaussians");
        for_chunks(threads, parts, [&](int64_t part, int) {
            int32_t* next = counts.data() + part * tiles;
            part_of(part, [&](int32_t g) {
                for (int32_t slot = firsts[g]; slot < firsts[g + 1]; slot++) {
                    const int32_t at = next[tile_of[size_t(slot)]]++;
                    ids[at] = g;
                    if (slots) slots[at] = slot;
                }
            });
        });
    });
}
