// Projection of packed Gaussians, which are drawn many times. See packed.py.
#include "splats/project.h"

namespace {

constexpr int PACK = 16;  // Gaussians in a block, for vectors of any length
static_assert(PACK % LANES == 0, "a vector lies within a block");
constexpr int64_t GRAIN = 64;  // blocks in a chunk

enum Column { MEAN, LOG_SCALE = 3, ROTATION = 6, LOGIT = 10, COLOR = 11, COLUMNS = 14 };

typedef uint16_t Halves __attribute__((vector_size(LANES * 2)));

inline Floats load_stored(const float* from) { return load(from); }
inline Floats load_stored(const uint16_t* from) {  // bfloat16: the upper half of a float
    Halves upper;
    std::memcpy(&upper, from, sizeof upper);
    const Ints bits = __builtin_convertvector(upper, Ints) << 16;
    Floats value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// Blocks of PACK Gaussians: COLUMNS rows of one parameter each, and harmonics, (3, stride, PACK) a block.
template <typename Stored>
struct Packed {
    static constexpr bool FINITE = true;
    const float* values;
    const Stored* harmonics;
    int stride;
    Floats row(int64_t from, int c) const { return load(values + (from / PACK * COLUMNS + c) * PACK + from % PACK); }
    Floats mean(int64_t from, int i) const { return row(from, MEAN + i); }
    Floats log_scale(int64_t from, int i) const { return row(from, LOG_SCALE + i); }
    Floats rotation(int64_t from, int i) const { return row(from, ROTATION + i); }
    Floats logit(int64_t from) const { return row(from, LOGIT); }
    Floats color(int64_t from, int channel) const { return row(from, COLOR + channel); }
    Floats harmonic(int64_t from, int channel, int k) const {
        return load_stored(harmonics + ((from / PACK * 3 + channel) * stride + k) * PACK + from % PACK);
    }
};

// Sides of the image, as planes through the camera. No Gaussian is on the image if its centre p has n . p > per_reach
// times its reach.
struct Sides {
    float n[4][3], length[4], per_reach[4];
    int count = 0;
    explicit Sides(const Camera& c) {
        if (c.lens || c.unscented) return;  // a lens bends the sides; blocks behind the camera are still found
        // x / z of a centre and half the width of the area drawn around it: fx reach sqrt(1 + (x/z)^2) / z, where x / z
        // is bounded as in the Jacobian, and the root of the blur's part, of a CUT of at most log(255).
        const float blur = std::sqrt(2 * std::log(1 / MIN_ALPHA) * c.blur);
        const float wide = c.fx * std::sqrt(1 + std::max(c.low_x * c.low_x, c.high_x * c.high_x));
        const float high = c.fy * std::sqrt(1 + std::max(c.low_y * c.low_y, c.high_y * c.high_y));
        add(c.fx, 0, c.cx - c.width - blur, wide), add(-c.fx, 0, -c.cx - blur, wide);
        add(0, c.fy, c.cy - c.height - blur, high), add(0, -c.fy, -c.cy - blur, high);
    }
    void add(float x, float y, float z, float reach) {
        n[count][0] = x, n[count][1] = y, n[count][2] = z, per_reach[count] = reach;
        length[count++] = std::sqrt(x * x + y * y + z * z);
    }
    // Whether no Gaussian with a centre in a ball, and a reach of at most `reach`, is on the image.
    bool miss(const Camera& c, const float* ball, float reach) const {
        float p[3];
        for (int i = 0; i < 3; i++) p[i] = c.r[i][0] * ball[0] + c.r[i][1] * ball[1] + c.r[i][2] * ball[2] + c.t[i];
        const float radius = ball[3] + 1e-5f * (std::abs(p[0]) + std::abs(p[1]) + std::abs(p[2]));  // rounding
        if (!c.all_around() && p[2] + radius < c.near) return true;
        for (int side = 0; side < count; side++) {
            const float* of = n[side];
            if (of[0] * p[0] + of[1] * p[1] + of[2] * p[2] - length[side] * radius > per_reach[side] * reach) return true;
        }
        return false;
    }
};

template <typename Stored>
void project(const Packed<Stored>& in, const float* balls, int64_t blocks, int basis, const Camera& camera, float* records,
             int threads) {
    const Sides sides(camera);
    for_each(threads, blocks, GRAIN, [&](int64_t block) {
        const int64_t first = block * PACK;
        if (sides.miss(camera, balls + block * 5, balls[block * 5 + 4])) {
            for (int64_t i = first; i < first + PACK; i++) records[i * RECORD + CUT] = 0;
            return;
        }
        for (int64_t from = first; from < first + PACK; from += LANES)
            project_lanes(in, camera, basis, from, first + PACK, records);
    });
}

}  // namespace

// Records of `blocks` blocks of PACK Gaussians, (blocks * PACK, RECORD). One that is not visible has a CUT of 0, and
// anything elsewhere. A block is not read if its ball, (blocks, 5) centre, radius and longest reach, is not on the
// image. The harmonics are floats or, if `halves`, bfloat16.
EXPORT int splat_project_packed(const float* values, const void* harmonics, int halves, const float* balls, int64_t blocks,
                                int basis, int stride, const double* settings, float* records, int threads) {
    return guarded([&] {
        const Camera camera(settings);
        if (halves)
            project(Packed<uint16_t>{values, static_cast<const uint16_t*>(harmonics), stride}, balls, blocks, basis, camera,
                    records, threads);
        else
            project(Packed<float>{values, static_cast<const float*>(harmonics), stride}, balls, blocks, basis, camera,
                    records, threads);
    });
}
