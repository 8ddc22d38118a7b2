// A density that is a small network on a hash grid, evaluated block by block in other kernels.
#pragma once

#include "encodings/contraction.h"
#include "grids/hash_grid.h"
#include "networks/mlp.h"

struct Density {  // at positions * scale + shift, or contracted around a box (2, 3) if given
    const float *scale, *shift, *table;
    const int64_t *resolutions, *offsets;
    int levels;
    bool contracted;
    float centre[3], halves[3];  // of the box, and 1 over half of its edges
    int64_t inputs, width;  // of the network, and of its output
    std::unique_ptr<mlp::Layers> net;
    decltype(&grid::encode<2>) encode;

    Density(const float* scale, const float* shift, const float* around, const float* table, int features,
            const int64_t* resolutions, const int64_t* offsets, int levels, const int64_t* widths, int layers,
            const float* const* weights, bool bf16)
        : scale(scale), shift(shift), table(table), resolutions(resolutions), offsets(offsets), levels(levels),
          contracted(around != nullptr), inputs(int64_t(levels) * features), width(widths[layers]),
          net(bf16 ? mlp::layers_bf16_of(widths, layers, weights) : mlp::layers_of(widths, layers, weights)) {
        for (int a = 0; around && a < 3; a++) {
            centre[a] = (around[a] + around[3 + a]) / 2;
            halves[a] = 2 / (around[3 + a] - around[a]);
        }
        if (widths[0] != inputs) throw std::invalid_argument("the network does not fit the grid");
        switch (features) {
            case 1: encode = grid::encode<1>; break;
            case 2: encode = grid::encode<2>; break;
            case 4: encode = grid::encode<4>; break;
            case 8: encode = grid::encode<8>; break;
            default: throw std::invalid_argument("hash grid: an entry has 1, 2, 4 or 8 features");
        }
    }

    // Maps a distance along a ray to the unit cube.
    void place(const float* origin, const float* direction, float t, float* unit) const {
        float position[3];
        for (int a = 0; a < 3; a++) position[a] = origin[a] + t * direction[a];
        if (contracted) return Contracted(position, centre, halves).write(unit);
        for (int a = 0; a < 3; a++) unit[a] = position[a] * scale[a] + shift[a];
    }

    // Features (count, inputs), the network's outputs (count, width) and density (count) at `unit` (count, 3); the
    // network's records unless null.
    void evaluate(const float* unit, int64_t count, float* encoded, float* outputs, float* density,
                  char* records) const {
        for (int64_t n = 0; n < count; n += grid::CHUNK)
            encode(unit, n, std::min(count, n + grid::CHUNK), table, resolutions, offsets, levels, encoded);
        net->forward(encoded, count, mlp::NONE, outputs, density, records);
    }
};
