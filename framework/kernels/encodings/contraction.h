// The contraction of unbounded space: mip-NeRF 360, equation 10. See contraction.py for the reference.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

// A position from the centre in half edges, x = (position - centre) * scale, as place / unit. unit is 1, except far
// away, where squares would overflow: there it is a power of two that scales everything down.
struct Contracted {
    float place[3], unit, factor, norm;  // the contracted position is factor * place; norm = max(1, |x|) * unit

    Contracted(const float* position, const float* centre, const float* scale) {
        constexpr float LARGEST = std::numeric_limits<float>::max();
        float farthest = 0, squared = 0;
        for (int c = 0; c < 3; c++) {
            const float x = (position[c] - centre[c]) * scale[c];
            place[c] = x > LARGEST ? LARGEST : x < -LARGEST ? -LARGEST : x;  // infinity has no direction
            farthest = std::max(farthest, std::fabs(place[c]));
        }
        unit = farthest > 1e12f ? 0x1p-83f : 1.0f;  // from 1e12 to 3e38 becomes from 1e-13 to 4e13
        for (int c = 0; c < 3; c++) {
            place[c] *= unit;
            squared += place[c] * place[c];
        }
        norm = std::sqrt(squared);
        norm = norm < unit ? unit : norm;  // NaN stays
        factor = (2 * norm - unit) / (norm * norm);
    }

    // The contracted position in the unit cube; its ball of radius 1/2 stands for the ball of radius 2.
    void write(float* to) const {
        for (int c = 0; c < 3; c++) to[c] = 0.25f * place[c] * factor + 0.5f;
    }
};
