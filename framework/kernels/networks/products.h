// Products of a block of rows with the weights of a small layer, in float32.
//
// Only the first `rows` of a block are multiplied, a multiple of ROW_STEP: networks with few rows need no whole block.
#pragma once

#include "networks/mlp.h"

namespace mlp {

constexpr int ROW_STEP = 16;

// y (rows, width) = x (rows, inner) w (inner, width), all row-major; width is a multiple of a vector, rows of ROWS.
template <int ROWS, int VECTORS>
inline void product_tile(const float* x, int ldx, const float* w, int ldw, int inner, float* y, int ldy) {
    Floats sum[ROWS][VECTORS];
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) sum[r][v] = splat(0);
    for (int k = 0; k < inner; k++) {
        Floats row[VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) row[v] = load(w + k * ldw + v * LANES);
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[r][v] += x[r * ldx + k] * row[v];
    }
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) store(y + r * ldy + v * LANES, sum[r][v]);
}

template <int ROWS, int VECTORS>
inline void product_columns(const float* x, int ldx, const float* w, int ldw, int inner, float* y, int ldy,
                            int rows) {
    for (int r = 0; r < rows; r += ROWS)
        product_tile<ROWS, VECTORS>(x + r * ldx, ldx, w, ldw, inner, y + r * ldy, ldy);
}

// Number of vectors of a row summed at once: they fill the registers.
constexpr int WIDE = LANES == 16 ? 4 : 2;

inline void product(const float* x, int ldx, const float* w, int inner, int width, float* y, int ldy,
                    int rows = BLOCK) {
    int column = 0;
    for (; column + WIDE * LANES <= width; column += WIDE * LANES)
        product_columns<4, WIDE>(x, ldx, w + column, width, inner, y + column, ldy, rows);
    for (; column + 2 * LANES <= width; column += 2 * LANES)
        product_columns<LANES == 16 ? 8 : 4, 2>(x, ldx, w + column, width, inner, y + column, ldy, rows);
    for (; column < width; column += LANES)
        product_columns<LANES == 16 ? 16 : 8, 1>(x, ldx, w + column, width, inner, y + column, ldy, rows);
}

// dw (inner, width) += x^T (inner, rows) dy (rows, width), over the rows of one block.
template <int INNER, int VECTORS>
inline void outer_tile(const float* x, int ldx, const float* dy, int ldy, float* dw, int width, int rows) {
    Floats sum[INNER][VECTORS];
#pragma GCC unroll 16
    for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) sum[k][v] = load(dw + k * width + v * LANES);
    for (int r = 0; r < rows; r++) {
        Floats row[VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) row[v] = load(dy + r * ldy + v * LANES);
#pragma GCC unroll 16
        for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) sum[k][v] += x[r * ldx + k] * row[v];
    }
#pragma GCC unroll 16
    for (int k = 0; k < INNER; k++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) store(dw + k * width + v * LANES, sum[k][v]);
}

template <int INNER, int VECTORS>
inline void outer_columns(const float* x, int ldx, const float* dy, int ldy, int inner, float* dw, int width,
                          int rows) {
    for (int k = 0; k < inner; k += INNER)
        outer_tile<INNER, VECTORS>(x + k, ldx, dy, ldy, dw + k * width, width, rows);
}

// inner is a multiple of a vector.
inline void outer_product(const float* x, int ldx, const float* dy, int ldy, int inner, float* dw, int width,
                          int rows = BLOCK) {
    int column = 0;
    for (; column + WIDE * LANES <= width; column += WIDE * LANES)
        outer_columns<4, WIDE>(x, ldx, dy + column, ldy, inner, dw + column, width, rows);
    for (; column + 2 * LANES <= width; column += 2 * LANES)
        outer_columns<4, 2>(x, ldx, dy + column, ldy, inner, dw + column, width, rows);
    for (; column < width; column += LANES)
        outer_columns<LANES == 16 ? 16 : LANES == 8 ? 8 : 4, 1>(x, ldx, dy + column, ldy, inner, dw + column, width,
                                                                rows);
}

}  // namespace mlp
