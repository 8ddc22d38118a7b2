// Projection of Gaussians to an image, forward and backward. See project.py for the reference and equations.
#include "splats/project.h"

#include <vector>

namespace {

constexpr int64_t GRAIN = 1024;  // Gaussians in a chunk

// Rows [from, from + LANES) of column c of a table, those beyond the last row as it.
inline Floats column(const float* table, int64_t from, int64_t count, int width, int c) {
    float out[LANES];
    for (int i = 0; i < LANES; i++) out[i] = table[std::min(from + i, count - 1) * width + c];
    return load(out);
}

// Parameters in a table each, a Gaussian in a row.
struct Inputs {
    static constexpr bool FINITE = false;
    const float *means, *log_scales, *rotations, *logits, *colors, *harmonics;
    int64_t count;
    int stride;  // harmonics of a channel beyond the first
    Floats mean(int64_t from, int i) const { return column(means, from, count, 3, i); }
    Floats log_scale(int64_t from, int i) const { return column(log_scales, from, count, 3, i); }
    Floats rotation(int64_t from, int i) const { return column(rotations, from, count, 4, i); }
    Floats logit(int64_t from) const { return column(logits, from, count, 1, 0); }
    Floats color(int64_t from, int channel) const { return column(colors, from, count, 3, channel); }
    Floats harmonic(int64_t from, int channel, int k) const {
        return column(harmonics, from, count, 3 * stride, channel * stride + k);
    }
};

inline void put(float* table, int64_t from, int64_t count, int width, int c, Floats values) {
    float out[LANES];
    store(out, values);
    for (int i = 0; i < LANES && from + i < count; i++) table[(from + i) * width + c] = out[i];
}

// The gradients of the centre and of the axes in the camera's frame, from the results of SigmaPoints::backward.
inline void through_points(const Projected& g, Ints visible, const Floats* of_shape, Floats* of_p, Floats (*of_v)[3]) {
    float given[6][LANES], centers[3][LANES] = {}, axes[3][3][LANES] = {};
    int32_t shown[LANES];
    std::memcpy(shown, &visible, sizeof shown);
    for (int i = 0; i < 6; i++) store(given[i], of_shape[i]);
    for (int lane = 0; lane < LANES; lane++) {
        if (!shown[lane]) continue;
        double of_at[3] = {}, of_axes[3][3] = {};
        g.points[lane].backward(given[0][lane], given[1][lane], given[2][lane], given[3][lane], given[4][lane],
                                given[5][lane], of_at, of_axes);
        for (int i = 0; i < 3; i++) {
            centers[i][lane] = float(of_at[i]);
            for (int k = 0; k < 3; k++) axes[i][k][lane] = float(of_axes[i][k]);
        }
    }
    for (int i = 0; i < 3; i++) {
        of_p[i] = load(centers[i]);
        for (int k = 0; k < 3; k++) of_v[i][k] = load(axes[i][k]);
    }
}

}  // namespace

// A record of each Gaussian, (count, RECORD). One that is not visible has a CUT of 0, and zeros elsewhere. Returns how
// many are dropped as they are not finite.
EXPORT int splat_project(const float* means, const float* log_scales, const float* rotations, const float* logits,
                         const float* colors, const float* harmonic, int64_t count, int basis, int stride,
                         const double* settings, float* records, int threads, int64_t* dropped) {
    return guarded([&] {
        const Inputs in{means, log_scales, rotations, logits, colors, harmonic, count, stride};
        const Camera camera(settings);
        std::vector<int64_t> bad(size_t((count + GRAIN - 1) / GRAIN), 0);
        for_chunks(threads, int64_t(bad.size()), [&](int64_t chunk, int) {
            const int64_t end = std::min(count, (chunk + 1) * GRAIN);
            for (int64_t from = chunk * GRAIN; from < end; from += LANES)
                bad[size_t(chunk)] += project_lanes(in, camera, basis, from, end, records);
        });
        *dropped = 0;
        for (const int64_t some : bad) *dropped += some;
    });
}

// Computes the gradients of all parameters and of the camera's pose (3, 4) from the gradient of the records. The pose
// has partial sums of chunks, (chunks, 12), allocated by the caller. CUT and REACH_* are not read.
EXPORT int splat_project_backward(const float* means, const float* log_scales, const float* rotations,
                                  const float* logits, const float* colors, const float* harmonic, int64_t count,
                                  int basis, int stride, const double* settings, const float* records,
                                  const float* gradient, float* of_means, float* of_log_scales, float* of_rotations,
                                  float* of_logits, float* of_colors, float* of_harmonic, float* of_pose,
                                  int threads) {
    return guarded([&] {
        const Inputs in{means, log_scales, rotations, logits, colors, harmonic, count, stride};
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
                    give(of_colors, 3, i, FIRST_HARMONIC * own);
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
                give(of_logits, 1, 0, of_base * g.base * (1.0f - g.base));

                Floats of_p[3], of_v[3][3];
                if (camera.unscented) {
                    const Floats of_shape[] = {d[X], d[Y], camera.blur * of_det, of_b, of_c + camera.blur * of_det, of_det0};
                    through_points(g, visible, of_shape, of_p, of_v);
                } else {
                    Floats of_t0[3], of_t1[3];
                    for (int k = 0; k < 3; k++) {
                        const int i = (k + 1) % 3, j = (k + 2) % 3;
                        of_t0[k] = of_b * g.t1[k] + 2 * camera.blur * of_det * g.t0[k] +
                                   2 * of_det0 * (g.t1[i] * g.cross[j] - g.t1[j] * g.cross[i]);
                        of_t1[k] = of_b * g.t0[k] + 2 * (of_c + camera.blur * of_det) * g.t1[k] +
                                   2 * of_det0 * (g.cross[i] * g.t0[j] - g.cross[j] * g.t0[i]);
                    }
                    // T = (rows of the Jacobian) V.
                    Floats of_u_row[3] = {}, of_v_row[3] = {};
                    for (int i = 0; i < 3; i++)
                        for (int k = 0; k < 3; k++) {
                            of_u_row[i] += of_t0[k] * g.v[i][k];
                            of_v_row[i] += of_t1[k] * g.v[i][k];
                            of_v[i][k] = g.to_u[i] * of_t0[k] + g.to_v[i] * of_t1[k];
                        }
                    // The Jacobian's rows, of p; the lens's own Jacobian is taken as constant.
                    const Floats depth = visible ? g.p[2] : splat(1), over = 1.0f / depth;
                    Floats of_jx[3], of_jy[3];
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
                }
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
