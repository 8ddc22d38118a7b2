// The first position along a ray that enough images show. See first_covisible.py for the reference.
#include "runtime/common.h"

#include <algorithm>
#include <cmath>

namespace {

struct Space {  // nested boxes around `box` (2, 3), and their excluded cells
    const uint8_t* excluded;
    int levels, cells;
    float centre[3], half[3], largest = 0;

    Space(const float* box, const uint8_t* excluded, int levels, int cells)
        : excluded(excluded), levels(levels), cells(cells) {
        for (int a = 0; a < 3; a++) {
            centre[a] = (box[a] + box[3 + a]) / 2;
            half[a] = (box[3 + a] - box[a]) / 2;
            largest = std::max(largest, half[a]);
        }
    }
    bool covisible(const float* origin, const float* direction, float t) const {
        float unit[3], farthest = 0;
        for (int a = 0; a < 3; a++) {
            unit[a] = (origin[a] + t * direction[a] - centre[a]) / half[a];
            farthest = std::max(farthest, std::fabs(unit[a]));
        }
        int level = 0;
        float size = 1;
        for (; level < levels && !(farthest <= size); size *= 2) level++;
        if (level == levels || !(unit[0] + unit[1] + unit[2] < INFINITY)) return true;  // NaN is in no cell
        int64_t index = level;
        for (int a = 0; a < 3; a++) {
            const float place = (unit[a] / size + 1) * (float(cells) / 2);
            index = index * cells + std::min(std::max(int(place), 0), cells - 1);
        }
        return !excluded[index];
    }
};

// Like torch.lerp.
float between(float a, float b, float share) {
    return share < 0.5f ? a + share * (b - a) : b - (b - a) * (1 - share);
}

}  // namespace

// `out` (rays): the distance of the first covisible one of `steps` positions between the near end of each ray and
// `reach` half edges of the box behind it, or its far end. The step before it is divided into `parts`, and the first
// covisible part counts. The near end if there is none.
EXPORT int first_covisible(const float* origins, const float* directions, const float* nears, const float* fars,
                           int64_t rays, const float* box, const uint8_t* excluded, int levels, int cells, int steps,
                           float reach, int parts, float* out, int threads) {
    return guarded([&] {
        if (steps < 2 || cells < 1) throw std::invalid_argument("a ray is looked at in two places or more");
        const Space space(box, excluded, levels, cells);
        for_each(threads, rays, 64, [&](int64_t r) {
            const float *origin = origins + r * 3, *direction = directions + r * 3, near = nears[r];
            const float end = near + reach * space.largest, far = end < fars[r] ? end : fars[r];
            const auto place = [&](int step) { return between(near, far, float(step) / float(steps - 1)); };
            int first = 0;
            while (first < steps && !space.covisible(origin, direction, place(first))) first++;
            if (first == steps) first = 0;
            const float before = place(std::max(first - 1, 0)), after = place(first);
            const auto within = [&](int part) { return between(before, after, float(part) / float(parts)); };
            int part = first ? 1 : parts;
            while (part < parts && !space.covisible(origin, direction, within(part))) part++;
            out[r] = within(part);
        });
    });
}
