// Sigma points of a Gaussian through a lens, in double. See unscented.py for the reference and equations.
#pragma once

#include "splats/camera.h"

namespace {

// For ALPHA = 1, BETA = 2 and KAPPA = 0 in unscented.py.
constexpr double STEP_SQUARED = 3, OUTER = 1 / (2 * STEP_SQUARED), CENTER = 1 - 6 * OUTER, CENTER_SQUARED = CENTER + 2;
constexpr double TURN = 6.283185307179586;

inline double within_half_a_turn(double angle) { return angle - TURN * std::nearbyint(angle / TURN); }

// Where a lens shows a point (x right, y down, z forward), in normalised image coordinates, and the Jacobian.
struct Position {
    double x, y, slope[2][3];
    bool seen;

    Position(const Camera& camera, const double* at) {
        const double right = at[0], down = at[1], depth = at[2];
        if (camera.lens == Camera::EQUIRECTANGULAR) {
            const double level = right * right + depth * depth, squared = level + down * down, off = std::sqrt(level);
            x = level > 0 ? std::atan2(right, depth) : 0, y = std::atan2(down, off);
            seen = squared > 0;
            const double over_level = level > 0 ? 1 / level : 0, over = seen ? 1 / squared : 0;
            const double tilt = off > 0 ? -down * over / off : 0;
            set(depth * over_level, 0, -right * over_level, tilt * right, off * over, tilt * depth);
            return;
        }
        seen = depth > 0;
        if (camera.lens == Camera::FISHEYE && std::abs(right) + std::abs(down) >= 1e-12) {
            const double level = right * right + down * down, off = std::sqrt(level), over = 1 / (level + depth * depth);
            const double scale = std::atan2(off, depth) / off, bend = (depth * over - scale) / level;
            x = right * scale, y = down * scale, seen = true;
            const double cross = bend * right * down;
            set(scale + bend * right * right, cross, -right * over, cross, scale + bend * down * down, -down * over);
        } else {  // on the axis, an angle is its tangent
            const double over = seen ? 1 / depth : 1;
            x = right * over, y = down * over;
            set(over, 0, -x * over, 0, over, -y * over);
        }
        if (camera.lens == Camera::NONE) return;
        const double radius = std::sqrt(x * x + y * y), reach = camera.coefficients[9];
        if (!(radius <= reach)) {  // to the edge of the disk
            seen = false;
            const double shrink = reach / radius, n_x = x / radius, n_y = y / radius;
            multiply(shrink * (1 - n_x * n_x), -shrink * n_x * n_y, shrink * (1 - n_y * n_y));
            x *= shrink, y *= shrink;
        }
        const Bent bent(x, y, camera.coefficients);
        multiply(bent.uu, bent.uv, bent.vv);
        x = bent.u, y = bent.v;
    }

  private:
    void set(double xx, double xy, double xz, double yx, double yy, double yz) {
        slope[0][0] = xx, slope[0][1] = xy, slope[0][2] = xz;
        slope[1][0] = yx, slope[1][1] = yy, slope[1][2] = yz;
    }
    void multiply(double uu, double uv, double vv) {
        for (int i = 0; i < 3; i++) {
            const double first = slope[0][i], second = slope[1][i];
            slope[0][i] = uu * first + uv * second, slope[1][i] = uv * first + vv * second;
        }
    }
};

struct SigmaPoints {
    static constexpr int COUNT = 7;  // the centre, and a step along each axis and against it
    double x[COUNT], y[COUNT];       // columns; their products are the covariance, pixels
    double weight[COUNT];            // weight of each point in mean_x
    double slope[COUNT][2][3];       // Jacobian of each position, pixels by scene units
    double mean_x, mean_y, xx, xy, yy;
    bool shown;

    // `axes[i][k]` is component i of axis k times its standard deviation.
    void place(const Camera& camera, const double* at, double (*axes)[3]) {
        const bool wraps = camera.lens == Camera::EQUIRECTANGULAR;
        double u[COUNT], v[COUNT];
        shown = true;
        for (int n = 0; n < COUNT; n++) {
            double point[3];
            for (int i = 0; i < 3; i++) point[i] = at[i] + (n ? step(n) * axes[i][axis(n)] : 0);
            const Position position(camera, point);
            u[n] = position.x, v[n] = position.y;
            if (n == 0 || !camera.all_around()) shown = shown && position.seen;
            for (int i = 0; i < 3; i++) {
                slope[n][0][i] = camera.fx * position.slope[0][i];
                slope[n][1][i] = camera.fy * position.slope[1][i];
            }
        }
        double off_x = 0, off_y = 0, sine = 0, cosine = CENTER;
        for (int n = 1; n < COUNT; n++) {
            off_x += OUTER * (u[n] - u[0]), off_y += OUTER * (v[n] - v[0]);
            if (wraps) sine += OUTER * std::sin(u[n] - u[0]), cosine += OUTER * std::cos(u[n] - u[0]);
        }
        if (wraps) off_x = std::atan2(sine, cosine);
        weight[0] = 1;
        for (int n = 1; n < COUNT; n++) {
            const double apart = u[n] - u[0];
            weight[n] = !wraps ? OUTER : OUTER * (cosine * std::cos(apart) + sine * std::sin(apart)) /
                                             (sine * sine + cosine * cosine);
            weight[0] -= weight[n];
        }
        xx = xy = yy = 0;
        for (int n = 0; n < COUNT; n++) {
            const double apart = u[n] - u[0] - off_x;
            x[n] = root(n) * camera.fx * (wraps ? within_half_a_turn(apart) : apart);
            y[n] = root(n) * camera.fy * (v[n] - v[0] - off_y);
            xx += x[n] * x[n], xy += x[n] * y[n], yy += y[n] * y[n];
        }
        double middle = u[0] + off_x;
        if (wraps) {  // of the positions, which repeat every turn, the one nearest to the image's middle
            const double of_image = (0.5 * camera.width - camera.cx) / camera.fx;
            middle = of_image + within_half_a_turn(middle - of_image);
        }
        mean_x = camera.fx * middle + camera.cx, mean_y = camera.fy * (v[0] + off_y) + camera.cy;
    }

    // The determinant of the covariance without blur; in double, a cancelled difference is as exact as a float.
    double determinant() const {
        const double value = xx * yy - xy * xy;
        return value > 0 ? value : 0;
    }

    // Adds to the gradients of the centre and of the axes, from the gradients of mean_x, mean_y, xx, xy, yy and the
    // determinant.
    void backward(double of_mean_x, double of_mean_y, double of_xx, double of_xy, double of_yy, double of_determinant,
                  double* of_at, double (*of_axes)[3]) const {
        of_xx += of_determinant * yy, of_yy += of_determinant * xx, of_xy -= 2 * of_determinant * xy;
        double of_x[COUNT], of_y[COUNT];
        double rest_x = of_mean_x, rest_y = of_mean_y;  // each column lies opposite to the mean
        for (int n = 0; n < COUNT; n++) {
            of_x[n] = root(n) * (2 * of_xx * x[n] + of_xy * y[n]);
            of_y[n] = root(n) * (2 * of_yy * y[n] + of_xy * x[n]);
            rest_x -= of_x[n], rest_y -= of_y[n];
        }
        for (int n = 0; n < COUNT; n++) {
            const double u = of_x[n] + weight[n] * rest_x, v = of_y[n] + (n ? OUTER : CENTER) * rest_y;
            for (int i = 0; i < 3; i++) {
                const double of_point = u * slope[n][0][i] + v * slope[n][1][i];
                of_at[i] += of_point;
                if (n) of_axes[i][axis(n)] += step(n) * of_point;
            }
        }
    }

  private:
    static int axis(int n) { return (n - 1) % 3; }
    static double step(int n) { return n < 4 ? std::sqrt(STEP_SQUARED) : -std::sqrt(STEP_SQUARED); }
    static double root(int n) { return std::sqrt(n ? OUTER : CENTER_SQUARED); }
};

}  // namespace
