// Volume rendering of one ray, its losses and their gradient.
#pragma once

namespace meslam {

struct RaySettings {
    float density_scale;    // of the positive part of f [1/m]
    float truncation;       // distance at which the target saturates [m]
    float surface_offset;   // how far before the surface f crosses zero [m]
    float distance_weight;  // of the signed-distance loss
    float depth_weight;     // of the rendered-depth loss
    float color_weight;     // of the rendered-colour loss
    float depth_clip;       // rendered-depth errors count up to this [m]
};

struct RayMeasurement {
    float distance;      // of the surface along the ray [m]
    const float* color;  // three, in [0, 1]
};

// The losses of meslam_core.mapping.losses.ray_losses on meslam_core.field.rendering.render.
// along (samples): ascending distances [m]; values (samples,4): network outputs. Writes the three
// weighted losses and grad_values (samples,4), the gradient of scale times their sum.
void ray_losses(const RaySettings& settings, const RayMeasurement& measured, int samples,
                const float* along, const float* values, float scale, float* losses,
                float* grad_values);

}  // namespace meslam
