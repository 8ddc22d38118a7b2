// What photographs with alpha say about cells of space and about their own pixels. See ../silhouettes.py for the
// references.
#include "common.h"

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

    int32_t opaque_pixels(int64_t x0, int64_t x1, int64_t y0, int64_t y1) const {
        const int64_t stride = width + 1;
        return sums[y1 * stride + x1] - sums[y1 * stride + x0] - sums[y0 * stride + x1] + sums[y0 * stride + x0];
    }
};

// Where a photograph shows a ball, to a pixel more on each side.
struct Footprint {
    float depth;  // of the centre, along the camera's axis
    bool whole;   // it lies in the photograph whole, in front of the camera
    int64_t x0, x1, y0, y1;

    Footprint(const Photograph& photograph, const float* center, float radius) {
        const float* pose = photograph.pose;
        const float from[3] = {center[0] - pose[3], center[1] - pose[7], center[2] - pose[11]};
        float local[2];
        for (int a = 0; a < 2; a++) local[a] = from[0] * pose[a] + from[1] * pose[4 + a] + from[2] * pose[8 + a];
        depth = -(from[0] * pose[2] + from[1] * pose[6] + from[2] * pose[10]);
        const float nearest = depth - radius, safe = nearest < 1e-6f ? 1e-6f : nearest;
        const float column = photograph.cx + photograph.fx * local[0] / depth;
        const float row = photograph.cy - photograph.fy * local[1] / depth;
        const float a = local[0] / safe, b = local[1] / safe;
        const float reach = radius / safe * std::max(photograph.fx, photograph.fy) * (1 + a * a + b * b) + 1;
        const float edge[4] = {std::floor(column - reach), std::ceil(column + reach), std::floor(row - reach),
                               std::ceil(row + reach)};
        const float limit[4] = {float(photograph.width), float(photograph.width), float(photograph.height),
                                float(photograph.height)};
        whole = nearest > 0;
        int64_t clamped[4];
        for (int i = 0; i < 4; i++) {
            whole = whole && edge[i] >= 0 && edge[i] <= limit[i];
            clamped[i] = edge[i] >= limit[i] ? int64_t(limit[i]) : edge[i] > 0 ? int64_t(edge[i]) : 0;  // NaN is 0
        }
        x0 = clamped[0], x1 = clamped[1], y0 = clamped[2], y1 = clamped[3];
    }
};

}  // namespace

// sums (height + 1, width + 1) of opaque (height, width): how many pixels lie above and left of a pixel's corner.
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

// held (count): clears it for balls that the photograph shows whole and empty (every = 1), or sets it for balls in whose
// direction it shows matter, and for balls around the camera's plane (every = 0).
EXPORT int hold_balls(const float* centers, int64_t count, float radius, const float* pose, float fx, float fy,
                      float cx, float cy, const int32_t* sums, int64_t height, int64_t width, int every, uint8_t* held,
                      int threads) {
    return guarded([&] {
        const Photograph photograph{pose, fx, fy, cx, cy, sums, height, width};
        for_ranges(threads, count, 4096, [&](int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; n++) {
                if (held[n] != every) continue;
                const Footprint f(photograph, centers + n * 3, radius);
                const bool clear = photograph.opaque_pixels(f.x0, f.x1, f.y0, f.y1) <= 0;
                if (every ? f.whole && clear : f.depth > radius ? !clear : !(f.depth <= -radius)) held[n] = uint8_t(!every);
            }
        });
    });
}

// near (height, width): whether an opaque pixel lies within twice the largest reach of a ball, or a ball that the
// photograph does not show whole may be seen through the pixel.
EXPORT int pixels_near_balls(const float* centers, int64_t count, float radius, const float* pose, float fx, float fy,
                             float cx, float cy, const int32_t* sums, int64_t height, int64_t width, uint8_t* near,
                             int threads) {
    return guarded([&] {
        const Photograph photograph{pose, fx, fy, cx, cy, sums, height, width};
        constexpr int64_t GRAIN = 4096;
        struct Part {
            float nearest = std::numeric_limits<float>::infinity();
            bool around_camera = false;
            std::vector<Footprint> cut;
        };
        std::vector<Part> parts(size_t((count + GRAIN - 1) / GRAIN));
        for_ranges(threads, count, GRAIN, [&](int64_t begin, int64_t end) {
            Part& part = parts[size_t(begin / GRAIN)];
            for (int64_t n = begin; n < end; n++) {
                const Footprint f(photograph, centers + n * 3, radius);
                part.nearest = std::min(part.nearest, f.depth);
                if (f.whole || f.x1 <= f.x0 || f.y1 <= f.y0 || f.depth <= -radius) continue;
                part.around_camera |= f.depth <= radius;
                part.cut.push_back(f);
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
        std::vector<int32_t> marks(size_t(stride * (height + 1)), 0);  // whose sums say how many balls cover a pixel
        for (const Part& part : parts)
            for (const Footprint& f : part.cut) {
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
