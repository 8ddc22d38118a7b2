// Projection of Gaussians to an image, LANES at a time, one in each lane. See project.py for the reference and
// equations. A source provides the parameters: mean(from, i) and so on return parameter i of LANES consecutive
// Gaussians.
#pragma once

#include "encodings/harmonics.h"
#include "splats/camera.h"
#include "splats/unscented.h"

#include <algorithm>

namespace {

constexpr int MAX_BASIS = 15;

inline Floats logistic(Floats x) { return 1.0f / (1.0f + exponential(-x)); }

// log of positive numbers, to 2 units in the last place; Cephes' logf.
inline Floats logarithm(Floats x) {
    Ints bits;
    std::memcpy(&bits, &x, sizeof bits);
    Ints exponent = (bits >> 23) - 126;
    bits = (bits & 0x007fffff) | 0x3f000000;
    Floats m;
    std::memcpy(&m, &bits, sizeof m);
    const Ints below = m < 0.707106781186547524f;
    exponent += below;  // -1 where it is true
    m = (below ? m + m : m) - 1.0f;
    Floats p = splat(7.0376836292e-2f);
    p = p * m - 1.1514610310e-1f;
    p = p * m + 1.1676998740e-1f;
    p = p * m - 1.2420140846e-1f;
    p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f;
    p = p * m + 2.0000714765e-1f;
    p = p * m - 2.4999993993e-1f;
    p = p * m + 3.3333331174e-1f;
    const Floats e = __builtin_convertvector(exponent, Floats), square = m * m;
    return (m + (m * square * p - 2.12194440e-4f * e - 0.5f * square)) + 0.693359375f * e;
}

// Maps (x, y) = (tan t cos f, tan t sin f) to (t cos f, t sin f), as in a fisheye: the common factor, and the Jacobian.
// This mapping and a fisheye's Bent are functions of the radius, so the product of their Jacobians is symmetric.
struct ToAngle {
    double scale = 1, xx = 1, xy = 0, yy = 1;

    ToAngle(double x, double y, bool fisheye) {
        if (!fisheye) return;
        const double squared = x * x + y * y, radius = std::sqrt(squared);
        scale = radius > 1e-4 ? std::atan(radius) / radius : 1 - squared / 3;
        const double slope = radius > 1e-4 ? (1 / (1 + squared) - scale) / squared : -2.0 / 3;  // of scale, over radius
        xx = scale + slope * x * x, xy = slope * x * y, yy = scale + slope * y * y;
    }
};

// All that both directions need, of LANES Gaussians.
struct Projected {
    Floats p[3];           // the centre in the camera's frame
    Floats s[3], q[4], norm;  // scales, the unit quaternion, and its length before
    Floats rotation[3][3], v[3][3];  // v: the axes times the scales, in the camera's frame
    Floats plane_x, plane_y, inside_x, inside_y;  // x / z and y / z, as the Jacobian takes them; 1 where not bounded
    Floats bend[3];        // the lens's Jacobian: uu, uv, vv
    Floats to_u[3], to_v[3];  // rows of the Jacobian of the image position
    Floats t0[3], t1[3], cross[3];  // rows of the Jacobian times v, and their product
    SigmaPoints points[LANES];      // in place of all from plane_x to here, if the camera is unscented
    Floats a, b, c, det0, det;
    Floats base, factor, opacity;   // the logistic, the correction for the blur, and their product
    Floats given;          // sum of all parameters but the colours': it is finite only where they are
    Floats u, v_image, distance;
    Floats direction[3], to_camera;  // from the camera to the centre, scene coordinates, and its length
    Ints valid;

    template <typename Source>
    Projected(const Source& in, const Camera& camera, int64_t from) {
        Floats m[3];
        for (int i = 0; i < 3; i++) {
            m[i] = in.mean(from, i);
            const Floats log_scale = in.log_scale(from, i);
            s[i] = exponential(log_scale);
            given = (i ? given : splat(0)) + m[i] + log_scale;
        }
        for (int i = 0; i < 3; i++) p[i] = camera.r[i][0] * m[0] + camera.r[i][1] * m[1] + camera.r[i][2] * m[2] + camera.t[i];
        Floats squared{};
        for (int i = 0; i < 4; i++) {
            q[i] = in.rotation(from, i);
            squared += q[i] * q[i];
            given += q[i];
        }
        norm = square_root(squared);
        const Floats ahead = camera.all_around() ? square_root(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) : p[2];
        valid = (ahead > camera.near) & (squared > 1e-24f);
        const Floats scale = 1.0f / (valid ? norm : splat(1));
        for (int i = 0; i < 4; i++) q[i] *= scale;
        const Floats w = q[0], x = q[1], y = q[2], z = q[3];
        rotation[0][0] = 1 - 2 * (y * y + z * z), rotation[0][1] = 2 * (x * y - w * z), rotation[0][2] = 2 * (x * z + w * y);
        rotation[1][0] = 2 * (x * y + w * z), rotation[1][1] = 1 - 2 * (x * x + z * z), rotation[1][2] = 2 * (y * z - w * x);
        rotation[2][0] = 2 * (x * z - w * y), rotation[2][1] = 2 * (y * z + w * x), rotation[2][2] = 1 - 2 * (x * x + y * y);
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++)
                v[i][k] = (camera.r[i][0] * rotation[0][k] + camera.r[i][1] * rotation[1][k] +
                           camera.r[i][2] * rotation[2][k]) * s[k];
        if (camera.unscented)
            shape_by_points(camera);
        else
            shape_by_jacobian(camera);
        const Floats logit = in.logit(from);
        given += logit;
        base = logistic(logit);
        factor = camera.antialiased ? square_root(det0 / det) : splat(1);
        opacity = base * factor;
        distance = square_root(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
        Floats length{};
        for (int i = 0; i < 3; i++) {
            direction[i] = m[i] - camera.center[i];
            length += direction[i] * direction[i];
        }
        to_camera = square_root(length);
        const Floats shrink = 1.0f / larger(to_camera, splat(1e-20f));
        for (int i = 0; i < 3; i++) direction[i] *= shrink;
    }

    // Elliptical weighted averaging.
    void shape_by_jacobian(const Camera& camera) {
        const Floats depth = valid ? p[2] : splat(1), over = 1.0f / depth;
        const Floats image_x = p[0] * over, image_y = p[1] * over;
        plane_x = smaller(larger(image_x, splat(camera.low_x)), splat(camera.high_x));
        plane_y = smaller(larger(image_y, splat(camera.low_y)), splat(camera.high_y));
        inside_x = plane_x == image_x ? splat(1) : splat(0), inside_y = plane_y == image_y ? splat(1) : splat(0);
        Floats bent_x = image_x, bent_y = image_y;
        bend[0] = bend[2] = splat(1), bend[1] = splat(0);
        if (camera.lens) bend_by_lens(camera, bent_x, bent_y);
        u = camera.fx * bent_x + camera.cx, v_image = camera.fy * bent_y + camera.cy;
        // d(x / z, y / z)/dp, then the lens, then the focal lengths
        const Floats jx[3] = {over, splat(0), -plane_x * over}, jy[3] = {splat(0), over, -plane_y * over};
        for (int i = 0; i < 3; i++) {
            to_u[i] = camera.fx * (bend[0] * jx[i] + bend[1] * jy[i]);
            to_v[i] = camera.fy * (bend[1] * jx[i] + bend[2] * jy[i]);
        }
        for (int k = 0; k < 3; k++) {
            t0[k] = to_u[0] * v[0][k] + to_u[1] * v[1][k] + to_u[2] * v[2][k];
            t1[k] = to_v[0] * v[0][k] + to_v[1] * v[1][k] + to_v[2] * v[2][k];
        }
        Floats first{}, second{};
        b = splat(0), det0 = splat(0);
        for (int k = 0; k < 3; k++) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            cross[k] = t0[i] * t1[j] - t0[j] * t1[i];
            det0 += cross[k] * cross[k];
            first += t0[k] * t0[k], second += t1[k] * t1[k], b += t0[k] * t1[k];
        }
        a = first + camera.blur, c = second + camera.blur;
        det = det0 + camera.blur * (first + second) + camera.blur * camera.blur;  // no difference, so nothing cancels
    }

    // The unscented transform, a lane at a time.
    void shape_by_points(const Camera& camera) {
        float center[3][LANES], axes[3][3][LANES], out[6][LANES] = {};
        int32_t shown[LANES];
        std::memcpy(shown, &valid, sizeof shown);
        for (int i = 0; i < 3; i++) {
            store(center[i], p[i]);
            for (int k = 0; k < 3; k++) store(axes[i][k], v[i][k]);
        }
        for (int lane = 0; lane < LANES; lane++) {
            if (!shown[lane]) continue;
            double at[3], of[3][3];
            for (int i = 0; i < 3; i++) {
                at[i] = center[i][lane];
                for (int k = 0; k < 3; k++) of[i][k] = axes[i][k][lane];
            }
            SigmaPoints here;
            here.place(camera, at, of);
            points[lane] = here;
            shown[lane] = here.shown ? -1 : 0;
            const double values[6] = {here.mean_x, here.mean_y, here.xx, here.xy, here.yy, here.determinant()};
            for (int i = 0; i < 6; i++) out[i][lane] = float(values[i]);
        }
        std::memcpy(&valid, shown, sizeof valid);
        u = load(out[0]), v_image = load(out[1]);
        const Floats first = load(out[2]), second = load(out[4]);
        b = load(out[3]), det0 = load(out[5]);
        a = first + camera.blur, c = second + camera.blur;
        det = det0 + camera.blur * (first + second) + camera.blur * camera.blur;
    }

    void bend_by_lens(const Camera& camera, Floats& x, Floats& y) {
        float px[LANES], py[LANES], d[3][LANES];
        int32_t good[LANES];
        store(px, x), store(py, y);
        const double reach = camera.coefficients[9];
        for (int i = 0; i < LANES; i++) {
            const ToAngle angle(px[i], py[i], camera.lens == Camera::FISHEYE);
            const double at_x = angle.scale * px[i], at_y = angle.scale * py[i];
            good[i] = at_x * at_x + at_y * at_y < reach * reach ? -1 : 0;
            const Bent bent(good[i] ? at_x : 0, good[i] ? at_y : 0, camera.coefficients);
            px[i] = float(bent.u), py[i] = float(bent.v);
            d[0][i] = float(bent.uu * angle.xx + bent.uv * angle.xy);
            d[1][i] = float(bent.uu * angle.xy + bent.uv * angle.yy);
            d[2][i] = float(bent.uv * angle.xy + bent.vv * angle.yy);
        }
        Ints keep;
        std::memcpy(&keep, good, sizeof keep);
        valid &= keep;
        x = load(px), y = load(py);
        for (int i = 0; i < 3; i++) bend[i] = load(d[i]);
    }
};

template <typename Source>
inline Floats color_of(const Source& in, int64_t from, int channel, int basis, const Floats* values) {
    Floats color = 0.5f + FIRST_HARMONIC * in.color(from, channel);
    for (int k = 0; k < basis; k++) color += values[k] * in.harmonic(from, channel, k);
    return color;
}

// Writes the records of the Gaussians [from, from + LANES), zeros for invisible ones, but not beyond `end`. Returns the
// number that is not finite; a FINITE source is not asked for the colours of invisible Gaussians.
template <typename Source>
inline int project_lanes(const Source& in, const Camera& camera, int basis, int64_t from, int64_t end, float* records) {
    const Projected g(in, camera, from);
    Floats out[RECORD] = {};
    const Floats cut = logarithm(larger(g.opacity * (1 / MIN_ALPHA), splat(1e-30f)));
    const Floats safe = larger(cut, splat(0));
    const Floats reach_x = square_root(2 * safe * g.a), reach_y = square_root(2 * safe * g.c);
    const Ints visible = g.valid & (cut > 0) & (g.u + reach_x > 0) & (g.u - reach_x < camera.width) &
                         (g.v_image + reach_y > 0) & (g.v_image - reach_y < camera.height);
    int32_t shown[LANES], sound[LANES], any = 0;
    std::memcpy(shown, &visible, sizeof shown);
    for (int i = 0; i < LANES; i++) any |= shown[i];
    if (Source::FINITE && !any) {
        for (int64_t i = from; i < std::min(from + LANES, end); i++) records[i * RECORD + CUT] = 0;
        return 0;
    }
    const Floats over_c = 1.0f / g.c, v_y = square_root(0.5f * over_c);
    const Floats u_x = square_root(0.5f * g.c / g.det), u_y = -g.b * over_c * u_x;
    out[X] = g.u, out[Y] = g.v_image, out[U_X] = u_x, out[U_Y] = u_y, out[V_Y] = v_y;
    out[OPACITY] = g.opacity, out[CUT] = cut, out[REACH_X] = reach_x, out[REACH_Y] = reach_y;
    Floats given = g.given, values[MAX_BASIS];
    harmonics(g.direction[0], g.direction[1], g.direction[2], basis, values);
    for (int i = 0; i < 3; i++) {
        const Floats color = color_of(in, from, i, basis, values);
        out[RED + i] = color < 0 ? splat(0) : color;  // NaN stays NaN
        given += color;
    }
    out[DISTANCE] = g.distance;
    // The shortest axis, turned towards the camera.
    const Ints second = (g.s[1] < g.s[0]) & (g.s[1] <= g.s[2]), third = (g.s[2] < g.s[0]) & (g.s[2] < g.s[1]);
    Floats normal[3], facing{};
    for (int i = 0; i < 3; i++) {
        normal[i] = third ? g.rotation[i][2] : (second ? g.rotation[i][1] : g.rotation[i][0]);
        facing += normal[i] * g.direction[i];
    }
    for (int i = 0; i < 3; i++) out[NORMAL_X + i] = facing > 0 ? -normal[i] : normal[i];
    Ints finite = Ints{} - 1;
    for (int k = 0; k < RECORD; k++) finite &= out[k] - out[k] == 0;
    // Gaussians that overflow are invisible too, but only parameters that are not finite are counted.
    const Ints all = (given - given == 0) & (g.norm > 1e-12f), kept = visible & finite & all;
    std::memcpy(shown, &kept, sizeof shown);
    std::memcpy(sound, &all, sizeof sound);
    float rows[RECORD][LANES];
    for (int k = 0; k < RECORD; k++) store(rows[k], out[k]);
    int bad = 0;
    for (int i = 0; i < LANES && from + i < end; i++) {
        bad += !sound[i];
        for (int k = 0; k < RECORD; k++) records[(from + i) * RECORD + k] = shown[i] ? rows[k][i] : 0.0f;
    }
    return bad;
}

}  // namespace
