// The camera of an image of Gaussians, from the numbers of SplatCamera.plain. See project.py.
#pragma once

#include "images/lens.h"
#include "splats/splat.h"

namespace {

struct Camera {
    float r[3][3], t[3], fx, fy, cx, cy, width, height, near, blur;
    bool antialiased;
    enum Lens { NONE, OPENCV, FISHEYE, EQUIRECTANGULAR } lens;
    bool unscented;                     // Gaussians are projected by sigma points
    float center[3];                    // of the camera, scene coordinates
    float low_x, high_x, low_y, high_y; // limits of x / z and y / z in the Jacobian
    double coefficients[LENS_SIZE];

    explicit Camera(const double* from) {
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) r[i][j] = float(from[i * 3 + j]);
            t[i] = float(from[9 + i]);
        }
        fx = float(from[12]), fy = float(from[13]), cx = float(from[14]), cy = float(from[15]);
        width = float(from[16]), height = float(from[17]), near = float(from[18]), blur = float(from[19]);
        antialiased = from[20] != 0, lens = Lens(int(from[21]));
        std::memcpy(coefficients, from + 22, sizeof coefficients);
        unscented = from[22 + LENS_SIZE] != 0;
        for (int j = 0; j < 3; j++) center[j] = -(r[0][j] * t[0] + r[1][j] * t[1] + r[2][j] * t[2]);
        const float over = 0.15f;  // of the image's size
        low_x = (-over * width - cx) / fx, high_x = ((1 + over) * width - cx) / fx;
        low_y = (-over * height - cy) / fy, high_y = ((1 + over) * height - cy) / fy;
        // A fisheye's Jacobian is bounded by itself: angles do not grow as tangents do.
        if (lens == FISHEYE) low_x = low_y = -INFINITY, high_x = high_y = INFINITY;
    }
    // Whether points beside and behind the camera may be shown.
    bool all_around() const { return unscented && lens >= FISHEYE; }
};

}  // namespace
