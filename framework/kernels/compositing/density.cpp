// Volume rendering of packed samples, forward and backward. See density.py for the reference and the equations.
#include "runtime/common.h"

#include <cmath>

// Per ray: colour over the background, opacity, first moment of t, and median t (the far end of the ray if the
// transmittance stays above 0.5). Per sample: the weight. points may be null for the middles of intervals.
EXPORT int composite_forward(const float* sigma, const float* rgb, const float* starts, const float* ends,
                             const float* points, const int64_t* offsets, int64_t rays, int64_t samples,
                             const float* background, const float* fars,
                             float* color, float* opacity, float* moment, float* median, float* weights,
                             int threads) {
    return guarded([&] {
        for_each(threads, rays, 128, [&](int64_t r) {
            check_offsets(offsets, r, samples);
            float depth = 0, sum[3] = {}, total = 0, mean = 0, half = fars[r];
            bool found = false;
            for (int64_t n = offsets[r]; n < offsets[r + 1]; n++) {
                const float tau = optical_depth(sigma[n], ends[n] - starts[n]);
                const float t = points ? points[n] : (starts[n] + ends[n]) / 2;
                const float in_front = std::exp(-depth), weight = in_front * -std::expm1(-tau);
                weights[n] = weight;
                depth += tau;
                total += weight;
                mean += weight == 0 ? 0 : weight * t;  // t is infinite in the middle of an infinite interval
                for (int c = 0; c < 3; c++) sum[c] += weight * rgb[n * 3 + c];
                if (!found && in_front - weight <= 0.5f) {
                    half = t < half ? t : half;
                    found = true;
                }
            }
            const float left = 1 - total < 0 ? 0 : 1 - total;
            for (int c = 0; c < 3; c++) color[r * 3 + c] = sum[c] + left * background[r * 3 + c];
            opacity[r] = total;
            moment[r] = mean;
            median[r] = half;
        });
    });
}

// Inputs are the gradients of colour (R, 3), opacity (R) and weights (N); the last two may be null. With
// g_i = dL/dw_i:  dL/dtau_i = g_i T_{i+1} - sum_{j > i} g_j w_j.
EXPORT int composite_backward(const float* sigma, const float* rgb, const float* starts, const float* ends,
                              const int64_t* offsets, int64_t rays, int64_t samples, const float* background,
                              const float* weights, const float* opacity, const float* color_grad,
                              const float* opacity_grad, const float* weights_grad, float* sigma_grad,
                              float* rgb_grad, int threads) {
    return guarded([&] {
        for_each(threads, rays, 128, [&](int64_t r) {
            check_offsets(offsets, r, samples);
            const float* g = color_grad + r * 3;
            const float* behind = background + r * 3;
            const bool see_through = 1 - opacity[r] >= 0;
            float base = opacity_grad ? opacity_grad[r] : 0;
            if (see_through)
                for (int c = 0; c < 3; c++) base -= g[c] * behind[c];
            float depth = 0, after = 0;
            for (int64_t n = offsets[r]; n < offsets[r + 1]; n++) {
                float own = base + (weights_grad ? weights_grad[n] : 0);
                for (int c = 0; c < 3; c++) own += g[c] * rgb[n * 3 + c];
                after += own * weights[n];
                sigma_grad[n] = own;
            }
            for (int64_t n = offsets[r]; n < offsets[r + 1]; n++) {
                const float delta = ends[n] - starts[n], tau = optical_depth(sigma[n], delta), own = sigma_grad[n];
                depth += tau;
                after -= own * weights[n];
                const float slope = depth_slope(sigma[n], delta);
                sigma_grad[n] = slope == 0 ? 0 : slope * (own * std::exp(-depth) - after);
                for (int c = 0; c < 3; c++) rgb_grad[n * 3 + c] = weights[n] * g[c];
            }
        });
    });
}

// Distortion (mip-NeRF 360, equation 15) of each ray and the gradients of its weights, in one pass each way:
// sum_ij w_i w_j |m_i - m_j| = 2 sum_i w_i (m_i W_i - M_i), with W_i, M_i the sums of w and w m in front of i.
EXPORT int distortion(const float* weights, const float* starts, const float* ends, const int64_t* offsets,
                      int64_t rays, int64_t samples, float* loss, float* weights_grad, int threads) {
    return guarded([&] {
        for_each(threads, rays, 128, [&](int64_t r) {
            check_offsets(offsets, r, samples);
            const int64_t begin = offsets[r], end = offsets[r + 1];
            // Distances from the first sample, so that a ray far from the origin loses no digits.
            const double origin = begin < end ? starts[begin] : 0;
            double total = 0, moment = 0, sum = 0;
            for (int64_t n = begin; n < end; n++) {
                const double m = (double(starts[n]) + ends[n]) / 2 - origin;
                total += weights[n];
                moment += weights[n] * m;
            }
            double w = 0, wm = 0;
            for (int64_t n = begin; n < end; n++) {
                const double m = (double(starts[n]) + ends[n]) / 2 - origin, delta = double(ends[n]) - starts[n];
                const double front = m * w - wm;
                w += weights[n];
                wm += weights[n] * m;
                const double behind = (moment - wm) - m * (total - w);
                sum += weights[n] * (2 * front + weights[n] * delta / 3);
                weights_grad[n] = float(2 * (front + behind) + 2 * weights[n] * delta / 3);
            }
            loss[r] = float(sum);
        });
    });
}
