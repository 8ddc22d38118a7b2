// Tests of cells of space and of pixels against photographs with alpha. See silhouettes.py for the references.
#include "runtime/common.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace {

// A pinhole camera and its photograph: pose (3, 4), and sums (height + 1, width + 1) of opaque pixels.
struct Photograph {
    const float* pose;
    float fx, fy, cx, cy;
    const int32_t* sums;
    int64_t height, width;
    int closed;  // whether space outside the frame is empty

    int32_t opaque_pixels(int64_t x0, int64_t x1, int64_t y0, int64_t y1) const {
        const int64_t stride = width + 1;
        return sums[y1 * stride + x1] - sums[y1 * stride + x0] - sums[y0 * stride + x1] + sums[y0 * stride + x0];
    }
};

struct Rectangle {
    int64_t x0, x1, y0, y1;
};

// Rectangles of LANES balls in a photograph, one pixel larger on each side.
struct Footprints {
    Floats depth;  // of the centres, along the camera's axis
    Ints whole;    // balls in front of the camera and wholly in the frame (anywhere if closed)
    Ints x0, x1, y0, y1;

    // For the balls with `count` centres (count, 3); the last one fills all further lanes.
    Footprints(const Photograph& photograph, const float* centers, int64_t count, float radius) {
        float from[3][LANES];
        for (int64_t lane = 0; lane < LANES; lane++)
            for (int a = 0; a < 3; a++)
                from[a][lane] = centers[std::min(lane, count - 1) * 3 + a] - photograph.pose[4 * a + 3];
        const Floats x = load(from[0]), y = load(from[1]), z = load(from[2]);
        const float* pose = photograph.pose;
        const Floats right = x * pose[0] + y * pose[4] + z * pose[8], up = x * pose[1] + y * pose[5] + z * pose[9];
        depth = -(x * pose[2] + y * pose[6] + z * pose[10]);
        const Floats nearest = depth - radius, safe = larger(nearest, splat(1e-6f));
        const Floats column = photograph.cx + photograph.fx * right / depth;
        const Floats row = photograph.cy - photograph.fy * up / depth;
        const Floats a = right / safe, b = up / safe;
        const Floats reach = radius / safe * std::max(photograph.fx, photograph.fy) * (1 + a * a + b * b) + 1;
        const Floats width = splat(float(photograph.width)), height = splat(float(photograph.height));
        const Floats left = column - reach, end = column + reach, top = row - reach, bottom = row + reach;
        whole = nearest > 0;
        if (!photograph.closed) whole &= (left >= 0) & (end <= width) & (top >= 0) & (bottom <= height);
        x0 = below(left, width), x1 = above(end, width), y0 = below(top, height), y1 = above(bottom, height);
    }

   private:
    static Floats inside(Floats edge, Floats limit) { return smaller(larger(edge, splat(0)), limit); }  // NaN is 0

    static Ints below(Floats edge, Floats limit) { return __builtin_convertvector(inside(edge, limit), Ints); }

    static Ints above(Floats edge, Floats limit) {
        const Floats value = inside(edge, limit);
        const Ints floored = __builtin_convertvector(value, Ints);
        return floored - (__builtin_convertvector(floored, Floats) < value);  // true is -1
    }
};

}  // namespace

// sums (height + 1, width + 1) of opaque (height, width): number of pixels above and to the left of a pixel's corner.
EXPORT int opaque_sums(const uint8_t* opaque, int64_t height, int64_t width, int32_t* sums) {
    const int64_t stride = width + 1;
    std::memset(sums, 0, sizeof(int32_t) * size_t(stride));
    for (int64_t y = 0; y < height; y++) {
        int32_t in_row = 0;
        sums[(y + 1) * stride] = 0;
        for (int64_t x = 0; x < width; x++) {
            in_row += opaque[y * width + x] != 0;
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + in_row;
        }
    }
    return DONE;
}

// held (count): cleared for balls that the photograph shows completely and empty (every = 1), or set for balls with
// matter in their direction, and for balls around the camera's plane (every = 0).
EXPORT int hold_balls(const float* centers, int64_t count, float radius, const float* pose, float fx, float fy,
                      float cx, float cy, const int32_t* sums, int64_t height, int64_t width, int closed, int every,
                      uint8_t* held, int threads) {
    return guarded([&] {
        const Photograph photograph{pose, fx, fy, cx, cy, sums, height, width, closed};
        for_ranges(threads, count, 4096, [&](int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; n += LANES) {
                const int64_t count = std::min<int64_t>(LANES, end - n);
                if (std::find(held + n, held + n + count, uint8_t(every)) == held + n + count) continue;
                const Footprints f(photograph, centers + n * 3, count, radius);
                for (int64_t i = 0; i < count; i++) {
                    if (held[n + i] != every) continue;
                    const bool clear = photograph.opaque_pixels(f.x0[i], f.x1[i], f.y0[i], f.y1[i]) <= 0;
                    const bool changes = every                 ? f.whole[i] && clear
                                         : f.depth[i] > radius ? !clear
                                                               : !(f.depth[i] <= -radius);  // NaN may be anywhere
                    if (changes) held[n + i] = uint8_t(!every);
                }
            }
        });
    });
}

// near (height, width): whether an opaque pixel lies within twice the largest reach of a ball, or the pixel may show a
// ball that is not completely in the photograph.
EXPORT int pixels_near_balls(const float* centers, int64_t count, float radius, const float* pose, float fx, float fy,
                             float cx, float cy, const int32_t* sums, int64_t height, int64_t width, int closed,
                             uint8_t* near, int threads) {
    return guarded([&] {
        const Photograph photograph{pose, fx, fy, cx, cy, sums, height, width, closed};
        constexpr int64_t GRAIN = 4096;
        struct Part {
            float nearest = std::numeric_limits<float>::infinity();
            bool around_camera = false;
            std::vector<Rectangle> cut;
        };
        std::vector<Part> parts(size_t((count + GRAIN - 1) / GRAIN));
        for_ranges(threads, count, GRAIN, [&](int64_t begin, int64_t end) {
            Part& part = parts[size_t(begin / GRAIN)];
            for (int64_t n = begin; n < end; n += LANES) {
                const int64_t count = std::min<int64_t>(LANES, end - n);
                const Footprints f(photograph, centers + n * 3, count, radius);
                for (int64_t i = 0; i < count; i++) {
                    part.nearest = std::min(part.nearest, f.depth[i]);
                    if (f.whole[i] || f.x1[i] <= f.x0[i] || f.y1[i] <= f.y0[i] || f.depth[i] <= -radius) continue;
                    part.around_camera |= f.depth[i] <= radius;
                    part.cut.push_back({f.x0[i], f.x1[i], f.y0[i], f.y1[i]});
                }
            }
        });
        float nearest = std::numeric_limits<float>::infinity();
        bool around_camera = false, any_cut = false;
        for (const Part& part : parts) {
            nearest = std::min(nearest, part.nearest);
            around_camera |= part.around_camera;
            any_cut |= !part.cut.empty();
        }
        if (around_camera) {
            std::memset(near, 1, size_t(height * width));
            return;
        }
        nearest = count ? nearest - radius : 1;
        const float focal = std::max(fx, fy), x = float(width) / 2, y = float(height) / 2;
        const float slant = 1 + (x * x + y * y) / (focal * focal);
        const double wanted = nearest > 0 ? double(2 * radius / nearest * focal * slant) + 5 : INFINITY;
        const int64_t reach = int64_t(std::min(wanted, double(std::max(height, width))));
        for_each(threads, height, 64, [&](int64_t row) {
            const int64_t y0 = std::max<int64_t>(row - reach, 0), y1 = std::min(row + reach + 1, height);
            for (int64_t column = 0; column < width; column++) {
                const int64_t x0 = std::max<int64_t>(column - reach, 0), x1 = std::min(column + reach + 1, width);
                near[row * width + column] = photograph.opaque_pixels(x0, x1, y0, y1) > 0;
            }
        });
        if (!any_cut) return;
        const int64_t stride = width + 1;
        std::vector<int32_t> marks(size_t(stride * (height + 1)), 0);  // their sums count the balls over a pixel
        for (const Part& part : parts)
            for (const Rectangle& f : part.cut) {
                marks[size_t(f.y0 * stride + f.x0)]++;
                marks[size_t(f.y0 * stride + f.x1)]--;
                marks[size_t(f.y1 * stride + f.x0)]--;
                marks[size_t(f.y1 * stride + f.x1)]++;
            }
        std::vector<int32_t> covered(size_t(width), 0);
        for (int64_t row = 0; row < height; row++) {
            int32_t in_row = 0;
            for (int64_t column = 0; column < width; column++) {
                in_row += marks[size_t(row * stride + column)];
                covered[size_t(column)] += in_row;
                near[row * width + column] |= covered[size_t(column)] > 0;
            }
        }
    });
}
