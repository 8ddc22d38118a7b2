// The loss of an image from structural similarity and mean absolute error, and its derivative by the image. See
// ssim.py for formulas and reference.
//
// An image of interleaved channels is filtered as rows of width * channels floats, with taps `channels` apart. A band
// of rows is processed from input to gradient in one sweep, which keeps no more rows than the window covers. Rows are
// blurred along, then down, which gives the windows' moments; the derivatives by the moments are blurred down, then
// along, which gives the gradient.
#include "runtime/common.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

namespace {

constexpr int TAPS = 11, REACH = TAPS - 1;
constexpr int ROWS = 8;  // blurred down at once: each input row is read once for all of them
constexpr int KEPT = ROWS + REACH;
constexpr float C2 = 9e-4f;

// The window along one axis: exp(-k^2 / (2 * 1.5^2)), for k = 0 to 5, divided by the sum over all taps.
constexpr float TAP[REACH / 2 + 1] = {
    0.266011724862f, 0.213005537711f, 0.109360689510f, 0.0360007721284f, 0.00759875813524f, 0.00102838008448f,
};

// Sums over ROWS windows, from the top, of the KEPT rows at `rows`.
inline void blur_down(const float* const* rows, int64_t at, Floats* out) {
    Floats value[KEPT];
#pragma GCC unroll 18
    for (int r = 0; r < KEPT; r++) value[r] = load(rows[r] + at);
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++) {
        Floats sum = TAP[0] * value[r + 5];
#pragma GCC unroll 5
        for (int k = 1; k <= 5; k++) sum += TAP[k] * (value[r + 5 - k] + value[r + 5 + k]);
        out[r] = sum;
    }
}

// The sum over the window that begins at `row`, with taps `step` floats apart.
inline Floats blur_along(const float* row, int64_t step) {
    Floats sum = TAP[0] * load(row + 5 * step);
#pragma GCC unroll 5
    for (int k = 1; k <= 5; k++) sum += TAP[k] * (load(row + (5 - k) * step) + load(row + (5 + k) * step));
    return sum;
}

// The same of values and of their squares.
inline void blur_along(const float* row, int64_t step, Floats& sum, Floats& squares) {
    const Floats middle = load(row + 5 * step);
    sum = TAP[0] * middle, squares = TAP[0] * (middle * middle);
#pragma GCC unroll 5
    for (int k = 1; k <= 5; k++) {
        const Floats left = load(row + (5 - k) * step), right = load(row + (5 + k) * step);
        sum += TAP[k] * (left + right), squares += TAP[k] * (left * left + right * right);
    }
}

// The last KEPT rows of a map.
struct Rows {
    float* data;
    int64_t stride;

    float* operator[](int64_t row) const { return data + (row + KEPT) % KEPT * stride; }
    void pointers(int64_t first, const float** out) const {
        for (int r = 0; r < KEPT; r++) out[r] = (*this)[first + r];
    }
};

struct Images {
    const float *image, *target;
    int64_t height, width, channels;
    float c1;  // of the means; if it is infinite, only variances are compared
    const float *weights, *of_windows;  // of pixels (height, width) and windows (height - REACH, width - REACH), or null
};

inline int64_t whole_vectors(int64_t floats) { return (floats + LANES - 1) / LANES * LANES; }

// A variance, which rounding may leave below 0. NaN stays NaN.
inline Floats positive(Floats variance) { return variance < 0.0f ? splat(0) : variance; }

// Measures of each row, and their factors in the gradient.
struct Measure {
    std::vector<double> dissimilarity;  // of the windows that begin in it
    std::vector<double> error;          // absolute, of its pixels
    float of_similarity, of_error;      // per window, per value
};

// The gradients of a band of rows, and the dissimilarity of the windows that begin in it. Rows are counted from REACH
// above the band, where the first windows that reach into it begin.
class Band {
  public:
    Band(const Images& images, int64_t first, int64_t count, std::vector<float>& scratch)
        : images(images), top(first - REACH), rows(count + REACH), step(images.channels),
          row_floats(images.width * step), reach(REACH * step), windows(row_floats - reach),
          margin(whole_vectors(reach)) {
        // Rows have space for a window's reach on both sides, and for whole vectors.
        const int64_t stride = margin + whole_vectors(row_floats + reach) + LANES;
        scratch.assign(size_t((7 * KEPT + 4 * ROWS + 3) * stride + LANES), 0.0f);
        float* at = scratch.data();
        while (reinterpret_cast<uintptr_t>(at) % sizeof(Floats)) at++;
        for (Rows& map : moments) map = {at, stride}, at += KEPT * stride;
        for (Rows& map : slopes) map = {at, stride}, at += KEPT * stride;
        for (Rows& map : blurred) map = {at, stride}, at += ROWS * stride;
        for (float** row : {&sums, &differences, &counting}) *row = at, at += stride;
        for (int64_t i = 0; i < row_floats; i++) counting[i] = 1;
        for (float*& row : inside) {
            row = at, at += stride;
            for (int64_t i = 0; i < windows; i++) row[i] = 1;
        }
    }

    // Writes the measures of each row and, unless `gradient` is null, the derivative.
    void run(Measure& measure, float* gradient) {
        for (int64_t row = 0; row < REACH; row++) read(row, measure.error.data());
        for (int64_t row = 0; row < rows; row += ROWS) {
            for (int64_t next = row + REACH; next < std::min<int64_t>(row + KEPT, rows + REACH); next++)
                read(next, measure.error.data());
            compare(row, measure.dissimilarity.data());
            if (gradient && row + ROWS > REACH) differentiate(row, measure, gradient);
        }
    }

  private:
    // Sum and difference of a row of both images, and their squares, blurred along.
    void read(int64_t row, double* error) {
        const int64_t y = top + row;
        if (y < 0 || y >= images.height) return;  // not in any window that counts
        const float *a = images.image + y * row_floats, *b = images.target + y * row_floats;
        for (int64_t i = 0; i < row_floats; i++) {
            sums[i] = (a[i] - 0.5f) + (b[i] - 0.5f);
            differences[i] = a[i] - b[i];
        }
        if (row >= REACH && row < rows) {
            weigh(y);
            error[y] = absolute_sum();
        }
        float* out[4];
        for (int m = 0; m < 4; m++) out[m] = moments[m][row];
        for (int64_t i = 0; i < windows; i += LANES) {
            Floats mean, squares;
            blur_along(sums + i, step, mean, squares);
            store(out[0] + i, mean), store(out[2] + i, squares);
            blur_along(differences + i, step, mean, squares);
            store(out[1] + i, mean), store(out[3] + i, squares);
        }
    }

    // The weights of a row of pixels, for each channel.
    void weigh(int64_t y) {
        if (images.weights) repeat(images.weights + y * images.width, row_floats, counting);
    }

    // The weights of ROWS rows of windows, for each channel.
    void choose(int64_t row) {
        for (int r = 0; r < ROWS; r++) {
            const int64_t y = top + row + r;
            if (y < 0 || y >= images.height - REACH) continue;  // it has no windows
            repeat(images.of_windows + y * (images.width - REACH), windows, inside[r]);
        }
    }

    // Writes each value once for each channel.
    void repeat(const float* values, int64_t count, float* out) const {
        for (int64_t i = 0; i < count; i += step, values++)
            for (int64_t c = 0; c < step; c++) out[i + c] = *values;
    }

    // For the differences of a row, with its weights.
    double absolute_sum() const {
        Floats lanes = splat(0);
        int64_t i = 0;
        for (; i + LANES <= row_floats; i += LANES) lanes += load(counting + i) * magnitude(load(differences + i));
        double total = 0;
        for (int lane = 0; lane < LANES; lane++) total += lanes[lane];
        for (; i < row_floats; i++) total += counting[i] * std::abs(differences[i]);
        return total;
    }

    // The derivatives of ROWS rows of windows, and their dissimilarity.
    void compare(int64_t row, double* dissimilarity) {
        const float* from[4][KEPT];
        for (int m = 0; m < 4; m++) moments[m].pointers(row, from[m]);
        if (images.of_windows) choose(row);
        Floats total[ROWS] = {};
        for (int64_t i = 0; i < windows; i += LANES) {
            Floats moment[4][ROWS];
            for (int m = 0; m < 4; m++) blur_down(from[m], i, moment[m]);
            for (int r = 0; r < ROWS; r++) {
                const Floats counts = load(inside[r] + i);
                // S = (1 - darker) (1 - flatter), by means and by variances. `full` is the sum without its offset.
                const Floats sum = moment[0][r], full = sum + 1.0f, difference = moment[1][r];
                const Floats square = difference * difference;
                const Floats of_sum = positive(moment[2][r] - sum * sum);
                const Floats of_difference = positive(moment[3][r] - square);
                const Floats light = 0.5f * (full * full + square) + images.c1;
                const Floats contrast = 0.5f * (of_sum + of_difference) + C2;
                const Floats per_light = 1.0f / light, per_contrast = 1.0f / contrast;
                const Floats darker = square * per_light, flatter = of_difference * per_contrast;
                const Floats similar = 1.0f - darker;
                // Twice the derivatives by E[u^2] and E[v^2], and the one by the means; variances depend on the means
                // too.
                const Floats by_sum = similar * flatter * per_contrast;
                const Floats by_difference = by_sum - 2.0f * similar * per_contrast;
                const Floats by_mean =
                    (1.0f - flatter) * per_light * (darker * (full + difference) - 2.0f * difference) -
                    (sum * by_sum + difference * by_difference);
                total[r] += counts != 0.0f ? counts * (darker + similar * flatter) : splat(0);
                store(slopes[0][row + r] + margin + i, counts != 0.0f ? counts * by_mean : splat(0));
                store(slopes[1][row + r] + margin + i, counts != 0.0f ? counts * by_sum : splat(0));
                store(slopes[2][row + r] + margin + i, counts != 0.0f ? counts * by_difference : splat(0));
            }
        }
        for (int r = 0; r < ROWS; r++) {
            const int64_t y = top + row + r;
            if (y < 0 || y >= images.height - REACH)
                for (const Rows& map : slopes) std::memset(map[row + r] + margin, 0, size_t(windows) * sizeof(float));
            else if (row + r >= REACH && row + r < rows)
                for (int lane = 0; lane < LANES; lane++) dissimilarity[y] += total[r][lane];
        }
    }

    // Gradients of ROWS rows of pixels.
    void differentiate(int64_t row, const Measure& measure, float* gradient) {
        const float* from[KEPT];
        for (int m = 0; m < 3; m++) {
            slopes[m].pointers(row - REACH, from);
            for (int64_t i = margin; i < margin + windows; i += LANES) {
                Floats out[ROWS];
                blur_down(from, i, out);
                for (int r = 0; r < ROWS; r++) store(blurred[m][r] + i, out[r]);
            }
        }
        for (int64_t r = std::max<int64_t>(REACH - row, 0); r < std::min<int64_t>(rows - row, ROWS); r++) {
            const int64_t begin = (top + row + r) * row_floats;
            weigh(top + row + r);
            const float *a = images.image + begin, *b = images.target + begin;
            const float* map[3];
            for (int m = 0; m < 3; m++) map[m] = blurred[m][r] + margin - reach;
            const auto slope = [&](int64_t i, Floats x, Floats y) {
                const Floats sum = (x - 0.5f) + (y - 0.5f), difference = x - y;
                const Floats slope = blur_along(map[0] + i, step) + sum * blur_along(map[1] + i, step) +
                                     difference * blur_along(map[2] + i, step);
                const Floats sign = (difference > 0 ? splat(1) : splat(0)) - (difference < 0 ? splat(1) : splat(0));
                return measure.of_similarity * slope + measure.of_error * (load(counting + i) * sign);
            };
            int64_t i = 0;
            for (; i + LANES <= row_floats; i += LANES)
                store(gradient + begin + i, slope(i, load(a + i), load(b + i)));
            const size_t rest = size_t(row_floats - i) * sizeof(float);
            Floats x = splat(0), y = splat(0);
            std::memcpy(&x, a + i, rest), std::memcpy(&y, b + i, rest);
            const Floats last = slope(i, x, y);
            std::memcpy(gradient + begin + i, &last, rest);
        }
    }

    const Images& images;
    const int64_t top, rows, step, row_floats, reach, windows, margin;
    Rows moments[4];            // sum, difference and their squares, blurred along
    Rows slopes[3];             // by the mean, and twice by the means of both squares, after `margin` zeros
    Rows blurred[3];            // the slopes, blurred down
    float *sums, *differences;  // of a row of both images
    float* counting;            // the weights of a row of pixels
    float* inside[ROWS];        // the weights of rows of windows
};

}  // namespace

// out: 1 - ssim_weight times the mean absolute error, and ssim_weight times the mean of 1 - the similarity, of image and
// target (height, width, channels), with at least 11 pixels along each side. weights (height, width) and of_windows
// (height - 10, width - 10): factors in these means of pixels and of windows; null for 1. gradient (height, width,
// channels): derivative by the image, unless null.
EXPORT int photometric(const float* image, const float* target, int64_t height, int64_t width, int64_t channels,
                       float ssim_weight, float c1, const float* weights, const float* of_windows, float* gradient,
                       int threads, double* out) {
    return guarded([&] {
        if (std::min(height, width) < TAPS || channels < 1) throw std::invalid_argument("SSIM needs 11x11 pixels");
        const Images images{image, target, height, width, channels, c1, weights, of_windows};
        const double count = double(height - REACH) * double(width - REACH) * double(channels);
        const double values = double(height) * double(width) * double(channels);
        // Neighbouring bands both read the rows between them, so there are no more bands than useful threads. Results
        // do not depend on the bands: each begins at a multiple of ROWS, and sums are over rows first.
        const int64_t bands = threads > 1 ? 2 * threads : 1;
        const int64_t rows = std::max<int64_t>(((height + bands - 1) / bands + ROWS - 1) / ROWS * ROWS, 4 * ROWS);
        const std::vector<double> zeros(size_t(height), 0.0);
        Measure measure{zeros, zeros, float(-ssim_weight / count), float((1 - ssim_weight) / values)};
        static thread_local std::vector<std::vector<float>> kept;  // reused: new memory costs page faults
        std::vector<std::vector<float>>& scratch = kept;           // the caller's, on whichever thread the work runs
        const size_t slots = size_t(std::max(threads, 1));
        if (scratch.size() < slots) scratch.resize(slots);
        for_chunks(threads, (height + rows - 1) / rows, [&](int64_t chunk, int slot) {
            const int64_t first = chunk * rows;
            Band band(images, first, std::min(rows, height - first), scratch[size_t(slot)]);
            band.run(measure, gradient);
        });
        double dissimilar = 0, absolute = 0;
        for (const double of_row : measure.dissimilarity) dissimilar += of_row;
        for (const double of_row : measure.error) absolute += of_row;
        *out = (1 - ssim_weight) * (absolute / values) + ssim_weight * (dissimilar / count);
    });
}
