// A batch of training pixels: rays through them, and their colours over a background. See ../../cameras/cameras.py,
// ../../data/pixels/batch.py.
#include "runtime/common.h"
#include "images/lens.h"

#include <algorithm>
#include <cmath>

static int64_t image_of(int64_t pixel, const int64_t* offsets, int64_t images) {
    return std::upper_bound(offsets, offsets + images + 1, pixel) - offsets - 1;
}

enum Model { PINHOLE, OPENCV, FISHEYE };

// Converts (x, y) in normalised image coordinates to a unit direction, and to the radians between rays one unit apart.
static inline float look(int model, double x, double y, const double* lens, float* local) {
    double area;
    straighten(x, y, lens, x, y, area);
    area = area > 1e-3 ? area : 1e-3;
    if (model == FISHEYE) {
        const double angle = std::sqrt(x * x + y * y), shorter = angle > 1e-9 ? std::sin(angle) / angle : 1;
        local[0] = float(x * shorter), local[1] = float(-y * shorter), local[2] = float(-std::cos(angle));
        return float(std::sqrt((shorter > 0 ? shorter : 0) / area));
    }
    const double length = std::sqrt(x * x + y * y + 1);
    local[0] = float(x / length), local[1] = float(-y / length), local[2] = float(-1 / length);
    return float(1 / (length * std::sqrt(area)));
}

// flat (P): pixel indices over all images, which start at offsets (M + 1); places (K, 2): column and row from a pixel's
// centre. poses (M, 3, 4); fx, fy, cx, cy (M); widths (M); lenses (M, LENS_SIZE), null for pinholes. Writes P * K rays,
// the K rays of a pixel consecutively.
EXPORT int camera_rays(int model, const int64_t* flat, int64_t count, const float* places, int64_t per_pixel,
                       const int64_t* offsets, int64_t images, const int64_t* widths, const float* poses,
                       const float* fx, const float* fy, const float* cx, const float* cy, const double* lenses,
                       float* origins, float* directions, float* radii, int64_t* cameras, int threads) {
    return guarded([&] {
        const float radius = 2 / std::sqrt(12.0f);
        for_each(threads, count, 1024, [&](int64_t p) {
            check_index(flat[p], offsets[images], "pixels");
            const int64_t image = image_of(flat[p], offsets, images), within = flat[p] - offsets[image];
            const float column = float(within % widths[image]) + 0.5f - cx[image];
            const float row = float(within / widths[image]) + 0.5f - cy[image];
            const float* pose = poses + image * 12;
            for (int64_t k = 0; k < per_pixel; k++) {
                const int64_t r = p * per_pixel + k;
                const float x = (column + places[k * 2]) / fx[image], y = (row + places[k * 2 + 1]) / fy[image];
                float local[3];
                if (model == PINHOLE) {
                    const float length = std::sqrt(x * x + y * y + 1);
                    local[0] = x / length, local[1] = -y / length, local[2] = -1 / length;
                    radii[r] = radius / (fx[image] * length);
                } else {
                    radii[r] = radius / fx[image] * look(model, x, y, lenses + image * LENS_SIZE, local);
                }
                for (int a = 0; a < 3; a++) {
                    origins[r * 3 + a] = pose[a * 4 + 3];
                    directions[r * 3 + a] =
                        pose[a * 4] * local[0] + pose[a * 4 + 1] * local[1] + pose[a * 4 + 2] * local[2];
                }
                cameras[r] = image;
            }
        });
    });
}

// pixels (all, channels) uint8; background (P, 3). Writes the colours over the background, and opacities.
EXPORT int gather_colors(const int64_t* flat, int64_t count, const uint8_t* pixels, int64_t num_pixels, int channels,
                         const float* background, float* rgb, float* alpha, int threads) {
    return guarded([&] {
        for_each(threads, count, 4096, [&](int64_t p) {
            check_index(flat[p], num_pixels, "pixels");
            const uint8_t* pixel = pixels + flat[p] * channels;
            const float cover = channels == 4 ? float(pixel[3]) / 255 : 1;
            for (int c = 0; c < 3; c++)
                rgb[p * 3 + c] = float(pixel[c]) / 255 * cover + background[p * 3 + c] * (1 - cover);
            alpha[p] = cover;
        });
    });
}

// An image (count, channels) uint8 over one background (3). Writes the colours and, of 4 channels, the opacities.
EXPORT int view_colors(const uint8_t* pixels, int64_t count, int channels, const float* background, float* rgb,
                       float* alpha, int threads) {
    return guarded([&] {
        if (channels != 3 && channels != 4) throw std::invalid_argument("a pixel has 3 or 4 channels");
        float shades[256];
        for (int i = 0; i < 256; i++) shades[i] = float(i) / 255;
        for_each(threads, count, 8192, [&](int64_t p) {
            const uint8_t* pixel = pixels + p * channels;
            const float cover = channels == 4 ? shades[pixel[3]] : 1;
            for (int c = 0; c < 3; c++) rgb[p * 3 + c] = shades[pixel[c]] * cover + background[c] * (1 - cover);
            if (channels == 4) alpha[p] = cover;
        });
    });
}
