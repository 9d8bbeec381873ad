// Where rays are sampled, as meslam_core.field.sampling.sample_distances has it.
#pragma once

#include <cstddef>
#include <cstdint>

namespace meslam {

struct SamplingSettings {
    int free_samples;     // stratified between the camera and the surface
    int surface_samples;  // normally distributed about the surface, the last behind it
    float surface_sigma;  // [m]
};

// along (rays, free + surface samples), ascending [m], of rays that end at distances [m]. A ray's
// random numbers depend on the seed and its number alone.
void sample_rays(const SamplingSettings& settings, uint64_t seed, size_t rays,
                 const float* distances, float* along);

}  // namespace meslam
