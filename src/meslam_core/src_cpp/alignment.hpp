// Gauss-Newton's normal equations of a frame against the field.
#pragma once

#include <cstddef>

namespace meslam {

struct AlignmentSettings {
    double to_map[9];      // (3,3): gradient in the map = gradient in region coordinates times it
    double surface_level;  // f on the surface
    double saturation;     // a point with |f| above this is not used
    double min_slope;      // nor one with a flatter f [1/m]
    double huber;          // robust threshold [m]
    double color_weight;   // scale of the colour residual; 0 switches it off
};

// What the field says at the points, and what was measured there.
struct AlignmentPoints {
    size_t count;
    const float* values;         // (count,4)
    const float* grad_distance;  // (count,3), region coordinates
    const float* grad_luma;      // (count,3), or null without colour
    const float* arms;           // (count,3): from the camera centre, map axes [m]
    const float* luma;           // (count): measured
    const float* weights;        // (count): 0 leaves a point out
};

// information (6,6) and gradient (6) of half the weighted squared residuals with respect to
// (translation, rotation about the camera centre); distance (count): to the mapped surface [m];
// usable (count).
void normal_equations(const AlignmentSettings& settings, const AlignmentPoints& points,
                      double* information, double* gradient, float* distance, bool* usable);

}  // namespace meslam
