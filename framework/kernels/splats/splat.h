// The layout of a Gaussian on the image, shared by the splatting kernels. See project.py.
#pragma once

#include "runtime/common.h"

#include <cmath>

// A Gaussian on the image. Its alpha at an offset (dx, dy) from the centre is opacity exp(-(u^2 + v^2)) with
// u = U_X dx + U_Y dy and v = V_Y dy: half of the inverse covariance as a product of triangular matrices, so that
// squares cannot cancel.
enum Record {
    X, Y,            // centre, pixels
    U_X, U_Y, V_Y,   // 1 / pixels
    OPACITY,
    CUT,             // alpha is below MIN_ALPHA beyond this u^2 + v^2; at most 0 if invisible
    REACH_X,         // half the width of the ellipse u^2 + v^2 = CUT, pixels
    RED, GREEN, BLUE,
    DISTANCE,        // of the centre from the camera
    NORMAL_X, NORMAL_Y, NORMAL_Z,
    REACH_Y,         // half the height
    RECORD           // values of a record
};

constexpr float MIN_ALPHA = 1.0f / 255, MAX_ALPHA = 0.999f;
constexpr float OPAQUE = 1e-4f;  // a Gaussian counts only in front of this transmittance
constexpr int TILE = 16;         // pixels along a tile's edge

static inline Floats square_root(Floats x) {
    float values[LANES];
    store(values, x);
    for (int i = 0; i < LANES; i++) values[i] = std::sqrt(values[i]);
    return load(values);
}
