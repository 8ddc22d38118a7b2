// Inversion of a lens's distortion for one position on an image. See ../../geometry/lenses.py.
#pragma once

#include <cmath>

constexpr int LENS_SIZE = 11;  // k1, k2, p1, p2, k3, k4, k5, k6, k7, reach, outer bound
constexpr int LENS_ITERATIONS = 60;

struct Bent {
    double u, v, uu, uv, vv;  // the position, and the Jacobian du/dx, du/dy = dv/dx, dv/dy

    Bent(double x, double y, const double* k) {
        const double xx = x * x, xy = x * y, yy = y * y, q = xx + yy, p1 = k[2], p2 = k[3];
        const double over = 1 / (1 + q * (k[5] + q * (k[6] + q * k[7])));
        const double scale = (1 + q * (k[0] + q * (k[1] + q * (k[4] + q * k[8])))) * over;
        double slope = k[0] + q * (2 * k[1] + q * (3 * k[4] + q * 4 * k[8]));
        slope = (slope - scale * (k[5] + q * (2 * k[6] + q * 3 * k[7]))) * over;
        u = x * scale + 2 * p1 * xy + p2 * (q + 2 * xx);
        v = y * scale + p1 * (q + 2 * yy) + 2 * p2 * xy;
        uu = scale + 2 * slope * xx + 2 * p1 * y + 6 * p2 * x;
        uv = 2 * (slope * xy + p1 * x + p2 * y);
        vv = scale + 2 * slope * yy + 6 * p1 * y + 2 * p2 * x;
    }
    double area() const { return uu * vv - uv * uv; }
};

// The point of the lens's disk that is distorted to (u, v), and the Jacobian's determinant there; the disk's edge if
// none.
static inline void straighten(double u, double v, const double* lens, double& x, double& y, double& area) {
    const double reach = lens[9], outer = lens[10], distance = std::sqrt(u * u + v * v);
    x = y = 0;
    if (distance <= outer) {
        const double start = distance < reach ? 1 : 0.9 * reach / distance;
        const double tolerance = 1e-18 * (1 + distance * distance);
        double step_x = u * start, step_y = v * start, best = INFINITY;
        for (int i = 0; i < LENS_ITERATIONS; i++) {
            const double at_x = x + step_x, at_y = y + step_y;
            const Bent bent(at_x, at_y, lens);
            const double off_u = bent.u - u, off_v = bent.v - v, error = off_u * off_u + off_v * off_v;
            if (error < best) {
                x = at_x, y = at_y, best = error, area = bent.area();
                if (best <= tolerance) return;
                const double safe = area > 1e-12 ? area : 1e-12;
                step_x = (bent.uv * off_v - bent.vv * off_u) / safe;
                step_y = (bent.uv * off_u - bent.uu * off_v) / safe;
            } else {
                step_x /= 2, step_y /= 2;
            }
            const double to_x = x + step_x, to_y = y + step_y, squared = to_x * to_x + to_y * to_y;
            if (!(squared < reach * reach)) {
                const double shrink = (std::sqrt(x * x + y * y) + reach) / (2 * std::sqrt(squared));
                step_x = to_x * shrink - x, step_y = to_y * shrink - y;
            }
        }
    }
    x = u * (reach / distance), y = v * (reach / distance);
    area = Bent(x, y, lens).area();
}
