// The first shape of a signed distance: a ball and a floor. See samples.py for the equations.
#pragma once

#include <cmath>

namespace surfaces {

struct FirstShape {
    const float *centre, *scale;
    float size, radius, rounding;
    const float* floor;  // its normal, and its height along the normal

    // Distance and gradient at a position, with the first output of a network and its gradient `slope` in the unit box.
    float at(const float* position, float output, const float* slope, float* gradient) const {
        float offset[3];
        const float far = from_centre(position, offset), height = above(position);
        const bool lower = height < far - radius;
        for (int axis = 0; axis < 3; axis++)
            gradient[axis] = (lower ? floor[axis] : offset[axis] / far) + size * scale[axis] * slope[axis];
        return (lower ? height : far - radius) + size * output;
    }
    float distance(const float* position, float output) const {
        float offset[3];
        const float ball = from_centre(position, offset) - radius, height = above(position);
        return (height < ball ? height : ball) + size * output;
    }

private:
    float from_centre(const float* position, float* offset) const {
        float squares = rounding * rounding;
        for (int axis = 0; axis < 3; axis++) {
            offset[axis] = position[axis] - centre[axis];
            squares += offset[axis] * offset[axis];
        }
        return std::sqrt(squares);
    }
    float above(const float* position) const {
        float height = -floor[3];
        for (int axis = 0; axis < 3; axis++) height += floor[axis] * position[axis];
        return height;
    }
};

}  // namespace surfaces
