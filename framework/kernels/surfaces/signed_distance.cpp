// Signed distances at positions, without their gradient. See signed_distance.py for the reference.
#include "surfaces/signed_distance.h"

using namespace surfaces;

// positions: (count, 3), scene coordinates. out: (count).
EXPORT int signed_distances(const float* positions, int64_t count, const float* shift, const float* table, int features,
                            const int64_t* resolutions, const int64_t* offsets, int levels, const float* first,
                            int hidden, const float* second, int outputs, const float* centre, const float* scale,
                            float size, float radius, float rounding, const float* floor, float* out, int threads) {
    return guarded([&] {
        const SignedDistance of{{centre, scale, size, radius, rounding, floor},
                                shift,
                                {table, resolutions, offsets, levels},
                                {levels * features, hidden, outputs, first, second}};
        for_ranges(threads, count, grid::CHUNK, [&](int64_t begin, int64_t end) {
            Space space;
#define CALL(F) of.values<F>(positions + begin * 3, end - begin, space, out + begin)
            FOR_FEATURES(features, CALL)
#undef CALL
        });
    });
}
