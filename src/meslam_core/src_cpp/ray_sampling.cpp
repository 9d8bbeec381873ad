#include "ray_sampling.hpp"

#include <algorithm>
#include <cmath>

namespace meslam {
namespace {

// Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators".
class SplitMix {
public:
    SplitMix(uint64_t seed, uint64_t stream) : state_(mix(seed) ^ mix(~stream)) {}

    // In [0, 1).
    float uniform() { return static_cast<float>(next() >> 40) * 0x1p-24f; }

    // Two independent standard normal numbers (Box and Muller).
    void normal_pair(float& first, float& second) {
        const float radius = std::sqrt(-2.0f * std::log(1.0f - uniform()));
        const float angle = 6.28318531f * uniform();
        first = radius * std::cos(angle);
        second = radius * std::sin(angle);
    }

private:
    static uint64_t mix(uint64_t z) {
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        return z ^ (z >> 31);
    }

    uint64_t next() {
        state_ += 0x9e3779b97f4a7c15u;
        return mix(state_);
    }

    uint64_t state_;
};

}  // namespace

void sample_rays(const SamplingSettings& settings, uint64_t seed, size_t rays,
                 const float* distances, float* along) {
    const int samples = settings.free_samples + settings.surface_samples;
    for (size_t i = 0; i < rays; ++i, along += samples) {
        SplitMix random(seed, i);
        const float surface = distances[i];
        const float free_end = std::max(surface - 2.0f * settings.surface_sigma, 0.02f);
        for (int s = 0; s < settings.free_samples; ++s) {
            along[s] = (static_cast<float>(s) + random.uniform()) /
                       static_cast<float>(settings.free_samples) * free_end;
        }
        for (int s = settings.free_samples; s < samples; s += 4) {
            float offsets[4];
            random.normal_pair(offsets[0], offsets[2]);
            offsets[1] = -offsets[0];
            offsets[3] = -offsets[2];
            for (int k = 0; k < 4 && s + k < samples; ++k) {
                along[s + k] = std::max(surface + settings.surface_sigma * offsets[k], 0.01f);
            }
        }
        std::sort(along, along + samples);
    }
}

}  // namespace meslam
