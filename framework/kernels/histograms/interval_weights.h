// Weights of a ray's intervals (NeRF, equation 3), with vectorised exponentials.
#pragma once

#include "runtime/common.h"

#include <vector>

class Weights {
    int64_t bins;
    std::vector<float> before, here;  // of each interval: optical depth in front of it, and its own

public:
    explicit Weights(int64_t bins)
        : bins(bins), before(size_t(bins + LANES - 1) / LANES * LANES), here(before.size()) {}

    // `weights` (bins) of densities (bins) between distances (bins + 1).
    void of_ray(const float* sigma, const float* t, float* weights) {
        float depth = 0;
        for (int64_t i = 0; i < bins; i++) {
            before[size_t(i)] = depth;
            depth += here[size_t(i)] = optical_depth(sigma[i], t[i + 1] - t[i]);
        }
        for (int64_t i = 0; i < bins; i += LANES) {
            const Floats in_front = load(&before[size_t(i)]);
            store(&here[size_t(i)], exponential(-in_front) * opacity_of(load(&here[size_t(i)])));
        }
        if (bins > 0) std::memcpy(weights, here.data(), sizeof(float) * size_t(bins));
    }
};
