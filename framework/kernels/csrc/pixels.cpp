// A batch of training pixels: colours over a background, and rays through their centres. See ../pixels.py.
#include "common.h"

#include <algorithm>
#include <cmath>

// flat (R): pixel indices into all images, which start at offsets (M + 1). poses (M, 3, 4); fx, fy, cx, cy (M);
// widths (M). pixels (P, channels) uint8; background (R, 3).
EXPORT void draw_pinhole(const int64_t* flat, int64_t rays, const int64_t* offsets, int64_t images,
                         const int64_t* widths, const float* poses, const float* fx, const float* fy, const float* cx,
                         const float* cy, const uint8_t* pixels, int channels, const float* background,
                         float* origins, float* directions, float* radii, int64_t* cameras, float* rgb, float* alpha,
                         int threads) {
    const float radius = 2 / std::sqrt(12.0f);
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t r = 0; r < rays; r++) {
        const int64_t image = std::upper_bound(offsets, offsets + images + 1, flat[r]) - offsets - 1;
        const int64_t within = flat[r] - offsets[image], row = within / widths[image], column = within % widths[image];
        const float x = (float(column) + 0.5f - cx[image]) / fx[image], y = (float(row) + 0.5f - cy[image]) / fy[image];
        const float length = std::sqrt(x * x + y * y + 1), local[3] = {x / length, -y / length, -1 / length};
        const float* pose = poses + image * 12;
        for (int a = 0; a < 3; a++) {
            origins[r * 3 + a] = pose[a * 4 + 3];
            directions[r * 3 + a] = pose[a * 4] * local[0] + pose[a * 4 + 1] * local[1] + pose[a * 4 + 2] * local[2];
        }
        radii[r] = radius / (fx[image] * length);
        cameras[r] = image;
        const uint8_t* pixel = pixels + flat[r] * channels;
        const float cover = channels == 4 ? float(pixel[3]) / 255 : 1;
        for (int c = 0; c < 3; c++)
            rgb[r * 3 + c] = float(pixel[c]) / 255 * cover + background[r * 3 + c] * (1 - cover);
        if (alpha) alpha[r] = cover;
    }
}
