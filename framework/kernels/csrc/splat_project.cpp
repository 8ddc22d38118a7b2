// Projection of Gaussians to an image, forward and backward. See ../splat_project.py for the reference and equations.
//
// Gaussians are taken LANES at a time, one in each lane.
#include "lens.h"
#include "splat.h"

#include <vector>

namespace {

constexpr int64_t GRAIN = 1024;  // Gaussians in a chunk
constexpr float DC = 0.28209479177387814f;
constexpr int MAX_BASIS = 15;

struct Camera {
    float r[3][3], t[3], fx, fy, cx, cy, width, height, near, blur;
    bool antialiased;
    enum Lens { NONE, OPENCV, FISHEYE } lens;
    float center[3];                    // of the camera, scene coordinates
    float low_x, high_x, low_y, high_y; // x / z and y / z beyond which the Jacobian is taken at the bound
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
        for (int j = 0; j < 3; j++) center[j] = -(r[0][j] * t[0] + r[1][j] * t[1] + r[2][j] * t[2]);
        const float over = 0.15f;  // of the image's size
        low_x = (-over * width - cx) / fx, high_x = ((1 + over) * width - cx) / fx;
        low_y = (-over * height - cy) / fy, high_y = ((1 + over) * height - cy) / fy;
        // A fisheye's Jacobian is bounded by itself: angles do not grow as tangents do.
        if (lens == FISHEYE) low_x = low_y = -INFINITY, high_x = high_y = INFINITY;
    }
};

struct Inputs {
    const float *means, *log_scales, *rotations, *logits, *colors, *harmonics;
    int64_t count;
    int basis, stride;  // harmonics that count, and those that are there, beyond the first
};

// Rows [from, from + LANES) of column c of a table, those beyond the last row as it.
inline Floats column(const float* table, int64_t from, int64_t count, int width, int c) {
    float out[LANES];
    for (int i = 0; i < LANES; i++) out[i] = table[std::min(from + i, count - 1) * width + c];
    return load(out);
}

inline void put(float* table, int64_t from, int64_t count, int width, int c, Floats values) {
    float out[LANES];
    store(out, values);
    for (int i = 0; i < LANES && from + i < count; i++) table[(from + i) * width + c] = out[i];
}

// The real spherical harmonics of degrees 1 to 3 (Sloan 2008), and of the sum of g[k] times each the gradient.
inline void harmonics(Floats x, Floats y, Floats z, int basis, Floats* b) {
    if (basis >= 3) b[0] = -0.4886025119029199f * y, b[1] = 0.4886025119029199f * z, b[2] = -0.4886025119029199f * x;
    if (basis >= 8) {
        b[3] = 1.0925484305920792f * x * y;
        b[4] = -1.0925484305920792f * y * z;
        b[5] = 0.31539156525252005f * (3 * z * z - 1);
        b[6] = -1.0925484305920792f * x * z;
        b[7] = 0.5462742152960396f * (x * x - y * y);
    }
    if (basis >= 15) {
        b[8] = -0.5900435899266435f * y * (3 * x * x - y * y);
        b[9] = 2.890611442640554f * x * y * z;
        b[10] = -0.4570457994644658f * y * (5 * z * z - 1);
        b[11] = 0.3731763325901154f * z * (5 * z * z - 3);
        b[12] = -0.4570457994644658f * x * (5 * z * z - 1);
        b[13] = 1.445305721320277f * z * (x * x - y * y);
        b[14] = -0.5900435899266435f * x * (x * x - 3 * y * y);
    }
}

inline void harmonics_gradient(Floats x, Floats y, Floats z, int basis, const Floats* g, Floats* out) {
    Floats gx{}, gy{}, gz{};
    if (basis >= 3) gy -= 0.4886025119029199f * g[0], gz += 0.4886025119029199f * g[1], gx -= 0.4886025119029199f * g[2];
    if (basis >= 8) {
        gx += 1.0925484305920792f * (y * g[3] - z * g[6] + x * g[7]);
        gy += 1.0925484305920792f * (x * g[3] - z * g[4] - y * g[7]);
        gz += -1.0925484305920792f * (y * g[4] + x * g[6]) + 6 * 0.31539156525252005f * z * g[5];
    }
    if (basis >= 15) {
        gx += -0.5900435899266435f * 6 * x * y * g[8] + 2.890611442640554f * y * z * g[9] -
              0.4570457994644658f * (5 * z * z - 1) * g[12] + 2 * 1.445305721320277f * x * z * g[13] -
              0.5900435899266435f * 3 * (x * x - y * y) * g[14];
        gy += -0.5900435899266435f * 3 * (x * x - y * y) * g[8] + 2.890611442640554f * x * z * g[9] -
              0.4570457994644658f * (5 * z * z - 1) * g[10] - 2 * 1.445305721320277f * y * z * g[13] +
              0.5900435899266435f * 6 * x * y * g[14];
        gz += 2.890611442640554f * x * y * g[9] - 0.4570457994644658f * 10 * z * (y * g[10] + x * g[12]) +
              0.3731763325901154f * (15 * z * z - 3) * g[11] + 1.445305721320277f * (x * x - y * y) * g[13];
    }
    out[0] = gx, out[1] = gy, out[2] = gz;
}

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

// From (x, y) = (tan t cos f, tan t sin f) to (t cos f, t sin f), as a fisheye sees it: what both are multiplied by, and
// the Jacobian. Both are those of a function of the radius, and so is a fisheye's Bent, so that their product is
// symmetric too.
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
    Floats s[3], q[4], norm;  // scales, the unit quaternion, and what it was divided by
    Floats rotation[3][3], v[3][3];  // v: the axes times the scales, in the camera's frame
    Floats plane_x, plane_y, inside_x, inside_y;  // x / z and y / z, as the Jacobian takes them; 1 where not bounded
    Floats bend[3];        // the lens's Jacobian: uu, uv, vv
    Floats to_u[3], to_v[3];  // rows of the Jacobian of the image position
    Floats t0[3], t1[3], cross[3];  // rows of the Jacobian times v, and their product
    Floats a, b, c, det0, det;
    Floats base, factor, opacity;   // the logistic, the correction for the blur, and their product
    Floats given;          // sum of all parameters but the colours': it is finite only where they are
    Floats u, v_image, distance;
    Floats direction[3], to_camera;  // from the camera to the centre, scene coordinates, and its length
    Ints valid;

    Projected(const Inputs& in, const Camera& camera, int64_t from) {
        Floats m[3];
        for (int i = 0; i < 3; i++) {
            m[i] = column(in.means, from, in.count, 3, i);
            const Floats log_scale = column(in.log_scales, from, in.count, 3, i);
            s[i] = exponential(log_scale);
            given = (i ? given : splat(0)) + m[i] + log_scale;
        }
        for (int i = 0; i < 3; i++) p[i] = camera.r[i][0] * m[0] + camera.r[i][1] * m[1] + camera.r[i][2] * m[2] + camera.t[i];
        Floats squared{};
        for (int i = 0; i < 4; i++) {
            q[i] = column(in.rotations, from, in.count, 4, i);
            squared += q[i] * q[i];
            given += q[i];
        }
        norm = square_root(squared);
        valid = (p[2] > camera.near) & (squared > 1e-24f);
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
        const Floats logit = column(in.logits, from, in.count, 1, 0);
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

inline Floats color_of(const Inputs& in, int64_t from, int channel, const Floats* basis) {
    Floats value = 0.5f + DC * column(in.colors, from, in.count, 3, channel);
    for (int k = 0; k < in.basis; k++)
        value += basis[k] * column(in.harmonics, from, in.count, 3 * in.stride, channel * in.stride + k);
    return value;
}

}  // namespace

// A record of each Gaussian, (count, RECORD). One that is not visible has a CUT of 0, and zeros elsewhere. Returns how
// many are dropped as they are not finite.
EXPORT int splat_project(const float* means, const float* log_scales, const float* rotations, const float* logits,
                         const float* colors, const float* harmonic, int64_t count, int basis, int stride,
                         const double* settings, float* records, int threads, int64_t* dropped) {
    return guarded([&] {
        const Inputs in{means, log_scales, rotations, logits, colors, harmonic, count, basis, stride};
        const Camera camera(settings);
        const int64_t chunks = (count + GRAIN - 1) / GRAIN;
        std::vector<int64_t> bad(size_t(chunks), 0);
        for_chunks(threads, chunks, [&](int64_t chunk, int) {
            const int64_t end = std::min(count, (chunk + 1) * GRAIN);
            for (int64_t from = chunk * GRAIN; from < end; from += LANES) {
                const Projected g(in, camera, from);
                Floats out[RECORD] = {};
                const Floats cut = logarithm(larger(g.opacity * (1 / MIN_ALPHA), splat(1e-30f)));
                const Floats safe = larger(cut, splat(0));
                const Floats reach_x = square_root(2 * safe * g.a), reach_y = square_root(2 * safe * g.c);
                Ints visible = g.valid & (cut > 0) & (g.u + reach_x > 0) & (g.u - reach_x < camera.width) &
                               (g.v_image + reach_y > 0) & (g.v_image - reach_y < camera.height);
                const Floats over_c = 1.0f / g.c, v_y = square_root(0.5f * over_c);
                const Floats u_x = square_root(0.5f * g.c / g.det), u_y = -g.b * over_c * u_x;
                Floats basis_values[MAX_BASIS];
                harmonics(g.direction[0], g.direction[1], g.direction[2], basis, basis_values);
                out[X] = g.u, out[Y] = g.v_image, out[U_X] = u_x, out[U_Y] = u_y, out[V_Y] = v_y;
                out[OPACITY] = g.opacity, out[CUT] = cut, out[REACH_X] = reach_x, out[REACH_Y] = reach_y;
                Floats given = g.given;
                for (int i = 0; i < 3; i++) {
                    const Floats color = color_of(in, from, i, basis_values);
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
                // What overflows on the way is not visible either, but only what has such parameters is counted.
                float rows[RECORD][LANES];
                int32_t shown[LANES], sound[LANES];
                const Ints all = (given - given == 0) & (g.norm > 1e-12f);
                const Ints kept = visible & finite & all;
                std::memcpy(shown, &kept, sizeof shown);
                std::memcpy(sound, &all, sizeof sound);
                for (int k = 0; k < RECORD; k++) store(rows[k], out[k]);
                for (int i = 0; i < LANES && from + i < end; i++) {
                    bad[size_t(chunk)] += !sound[i];
                    for (int k = 0; k < RECORD; k++) records[(from + i) * RECORD + k] = shown[i] ? rows[k][i] : 0.0f;
                }
            }
        });
        *dropped = 0;
        for (const int64_t some : bad) *dropped += some;
    });
}

// From the gradient of the records, that of all parameters, and of the camera's pose (3, 4) by partial sums of chunks
// (chunks, 12), which are given room for. Slots CUT and REACH_* of the gradient are not read.
EXPORT int splat_project_backward(const float* means, const float* log_scales, const float* rotations,
                                  const float* logits, const float* colors, const float* harmonic, int64_t count,
                                  int basis, int stride, const double* settings, const float* records,
                                  const float* gradient, float* of_means, float* of_log_scales, float* of_rotations,
                                  float* of_logits, float* of_colors, float* of_harmonic, float* of_pose,
                                  int threads) {
    return guarded([&] {
        const Inputs in{means, log_scales, rotations, logits, colors, harmonic, count, basis, stride};
        const Camera camera(settings);
        const int64_t chunks = (count + GRAIN - 1) / GRAIN;
        std::vector<double> poses(size_t(of_pose ? chunks * 12 : 0), 0.0);
        for_chunks(threads, chunks, [&](int64_t chunk, int) {
            const int64_t end = std::min(count, (chunk + 1) * GRAIN);
            for (int64_t from = chunk * GRAIN; from < end; from += LANES) {
                bool any = false;
                int32_t shown[LANES];
                for (int i = 0; i < LANES; i++) {
                    shown[i] = from + i < end && records[(from + i) * RECORD + CUT] > 0 ? -1 : 0;
                    any |= shown[i] != 0;
                }
                const int64_t rows = std::min<int64_t>(LANES, end - from);
                if (stride > 0 && (!any || basis < stride))
                    std::memset(of_harmonic + from * 3 * stride, 0, size_t(rows * 3 * stride) * sizeof(float));
                if (!any) {
                    std::memset(of_means + from * 3, 0, size_t(rows * 3) * sizeof(float));
                    std::memset(of_log_scales + from * 3, 0, size_t(rows * 3) * sizeof(float));
                    std::memset(of_rotations + from * 4, 0, size_t(rows * 4) * sizeof(float));
                    std::memset(of_logits + from, 0, size_t(rows) * sizeof(float));
                    std::memset(of_colors + from * 3, 0, size_t(rows * 3) * sizeof(float));
                    continue;
                }
                Ints visible;
                std::memcpy(&visible, shown, sizeof visible);
                const auto give = [&](float* table, int width, int c, Floats values) {
                    put(table, from, end, width, c, visible ? values : splat(0));  // NaN times 0 is not 0
                };
                const Projected g(in, camera, from);
                Floats d[RECORD];
                for (int k = 0; k <= DISTANCE; k++) {
                    const Floats value = column(gradient, from, count, RECORD, k);
                    d[k] = visible ? value : splat(0);
                }
                // Colours.
                Floats basis_values[MAX_BASIS], of_basis[MAX_BASIS] = {}, of_direction[3] = {};
                harmonics(g.direction[0], g.direction[1], g.direction[2], basis, basis_values);
                for (int i = 0; i < 3; i++) {
                    const Floats shade = column(records, from, count, RECORD, RED + i);
                    const Floats own = shade > 0 ? d[RED + i] : splat(0);  // cut off below 0
                    give(of_colors, 3, i, DC * own);
                    for (int k = 0; k < basis; k++) {
                        of_basis[k] += own * column(harmonic, from, count, 3 * stride, i * stride + k);
                        give(of_harmonic, 3 * stride, i * stride + k, own * basis_values[k]);
                    }
                }
                if (basis > 0)
                    harmonics_gradient(g.direction[0], g.direction[1], g.direction[2], basis, of_basis, of_direction);
                Floats of_m[3], along{};
                for (int i = 0; i < 3; i++) along += of_direction[i] * g.direction[i];
                const Floats over_length = 1.0f / larger(g.to_camera, splat(1e-20f));
                for (int i = 0; i < 3; i++) of_m[i] = (of_direction[i] - along * g.direction[i]) * over_length;
                const Floats of_center[3] = {-of_m[0], -of_m[1], -of_m[2]};

                // Shape: u_x = sqrt(c / (2 det)), u_y = -b / sqrt(2 c det), v_y = 1 / sqrt(2 c).
                const Floats over_c = 1.0f / g.c, over_det = 1.0f / g.det;
                const Floats v_y = square_root(0.5f * over_c), u_x = square_root(0.5f * g.c * over_det);
                const Floats u_y = -g.b * over_c * u_x;
                Floats of_det = -0.5f * over_det * (d[U_X] * u_x + d[U_Y] * u_y);
                const Floats of_b = -d[U_Y] * over_c * u_x;
                const Floats of_c = 0.5f * over_c * (d[U_X] * u_x - d[U_Y] * u_y - d[V_Y] * v_y);
                const Floats of_base = d[OPACITY] * g.factor;
                Floats of_det0{};
                if (camera.antialiased) {  // factor = sqrt(det0 / det)
                    const Floats of_factor = d[OPACITY] * g.base;
                    of_det -= 0.5f * of_factor * g.factor * over_det;
                    of_det0 = 0.5f * of_factor / larger(g.factor * g.det, splat(1e-30f));
                }
                // det = det0 + blur (|t0|^2 + |t1|^2) + blur^2, det0 = |t0 x t1|^2; through a, b and c it would cancel.
                of_det0 += of_det;
                Floats of_t0[3], of_t1[3];
                for (int k = 0; k < 3; k++) {
                    const int i = (k + 1) % 3, j = (k + 2) % 3;
                    of_t0[k] = of_b * g.t1[k] + 2 * camera.blur * of_det * g.t0[k] +
                               2 * of_det0 * (g.t1[i] * g.cross[j] - g.t1[j] * g.cross[i]);
                    of_t1[k] = of_b * g.t0[k] + 2 * (of_c + camera.blur * of_det) * g.t1[k] +
                               2 * of_det0 * (g.cross[i] * g.t0[j] - g.cross[j] * g.t0[i]);
                }
                give(of_logits, 1, 0, of_base * g.base * (1.0f - g.base));

                // T = (rows of the Jacobian) V.
                Floats of_u_row[3] = {}, of_v_row[3] = {}, of_v[3][3];
                for (int i = 0; i < 3; i++)
                    for (int k = 0; k < 3; k++) {
                        of_u_row[i] += of_t0[k] * g.v[i][k];
                        of_v_row[i] += of_t1[k] * g.v[i][k];
                        of_v[i][k] = g.to_u[i] * of_t0[k] + g.to_v[i] * of_t1[k];
                    }
                // The Jacobian's rows, of p; the lens's own Jacobian is taken as constant.
                const Floats depth = visible ? g.p[2] : splat(1), over = 1.0f / depth;
                Floats of_jx[3], of_jy[3], of_p[3];
                for (int i = 0; i < 3; i++) {
                    of_jx[i] = camera.fx * g.bend[0] * of_u_row[i] + camera.fy * g.bend[1] * of_v_row[i];
                    of_jy[i] = camera.fx * g.bend[1] * of_u_row[i] + camera.fy * g.bend[2] * of_v_row[i];
                }
                const Floats of_over = of_jx[0] + of_jy[1] - g.plane_x * of_jx[2] - g.plane_y * of_jy[2];
                // x / z and y / z: of the Jacobian, where not bounded, and of the image position.
                const Floats of_x = g.inside_x * -over * of_jx[2] +
                                    camera.fx * g.bend[0] * d[X] + camera.fy * g.bend[1] * d[Y];
                const Floats of_y = g.inside_y * -over * of_jy[2] +
                                    camera.fx * g.bend[1] * d[X] + camera.fy * g.bend[2] * d[Y];
                of_p[0] = of_x * over, of_p[1] = of_y * over;
                of_p[2] = -over * (of_over * over + of_x * g.p[0] * over + of_y * g.p[1] * over);
                const Floats over_distance = 1.0f / larger(g.distance, splat(1e-20f));
                for (int i = 0; i < 3; i++) of_p[i] += d[DISTANCE] * g.p[i] * over_distance;

                // V = W R S, p = W m + t.
                Floats of_rotation[3][3], of_s[3] = {};
                for (int i = 0; i < 3; i++)
                    for (int k = 0; k < 3; k++) {
                        const Floats of_rs =
                            camera.r[0][i] * of_v[0][k] + camera.r[1][i] * of_v[1][k] + camera.r[2][i] * of_v[2][k];
                        of_s[k] += of_rs * g.rotation[i][k];
                        of_rotation[i][k] = of_rs * g.s[k];
                    }
                for (int i = 0; i < 3; i++) {
                    of_m[i] += camera.r[0][i] * of_p[0] + camera.r[1][i] * of_p[1] + camera.r[2][i] * of_p[2];
                    give(of_means, 3, i, of_m[i]);
                    give(of_log_scales, 3, i, of_s[i] * g.s[i]);
                }
                const Floats w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
                const auto& R = of_rotation;
                Floats of_q[4] = {
                    2 * (x * (R[2][1] - R[1][2]) + y * (R[0][2] - R[2][0]) + z * (R[1][0] - R[0][1])),
                    2 * (y * (R[0][1] + R[1][0]) + z * (R[0][2] + R[2][0]) + w * (R[2][1] - R[1][2]) -
                         2 * x * (R[1][1] + R[2][2])),
                    2 * (x * (R[0][1] + R[1][0]) + z * (R[1][2] + R[2][1]) + w * (R[0][2] - R[2][0]) -
                         2 * y * (R[0][0] + R[2][2])),
                    2 * (x * (R[0][2] + R[2][0]) + y * (R[1][2] + R[2][1]) + w * (R[1][0] - R[0][1]) -
                         2 * z * (R[0][0] + R[1][1])),
                };
                Floats radial{};
                for (int i = 0; i < 4; i++) radial += of_q[i] * g.q[i];
                const Floats over_norm = 1.0f / (visible ? g.norm : splat(1));
                for (int i = 0; i < 4; i++)
                    give(of_rotations, 4, i, (of_q[i] - radial * g.q[i]) * over_norm);

                if (!of_pose) continue;
                // Entries of (W | t) taken as independent: p, V and the camera's centre -W^T t.
                double* sums = poses.data() + chunk * 12;
                Floats m[3];
                for (int i = 0; i < 3; i++) m[i] = column(means, from, count, 3, i);
                const auto add = [&](int entry, Floats values) {
                    float lanes[LANES];
                    store(lanes, visible ? values : splat(0));
                    for (int i = 0; i < LANES; i++) sums[entry] += lanes[i];
                };
                for (int i = 0; i < 3; i++) {
                    for (int j = 0; j < 3; j++) {
                        Floats value = of_p[i] * m[j] - camera.t[i] * of_center[j];
                        for (int k = 0; k < 3; k++) value += of_v[i][k] * g.s[k] * g.rotation[j][k];
                        add(i * 4 + j, value);
                    }
                    Floats value = of_p[i];
                    for (int j = 0; j < 3; j++) value -= camera.r[i][j] * of_center[j];
                    add(i * 4 + 3, value);
                }
            }
        });
        if (of_pose)
            for (int entry = 0; entry < 12; entry++) {
                double sum = 0;
                for (int64_t chunk = 0; chunk < chunks; chunk++) sum += poses[size_t(chunk * 12 + entry)];
                of_pose[entry] = float(sum);
            }
    });
}
