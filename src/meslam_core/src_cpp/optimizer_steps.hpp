// The element-wise passes over all parameters, compiled for the including file's instruction set.
#pragma once

#include <math.h>

#include "backend.hpp"
#include "vector_math.hpp"

namespace meslam {
namespace {

bool all_finite(const float* numbers, size_t count) {
    uint32_t bad = 0;
    for (size_t i = 0; i < count; ++i) {
        uint32_t bits;
        memcpy(&bits, numbers + i, sizeof bits);
        bad |= static_cast<uint32_t>((bits & 0x7f800000u) == 0x7f800000u);
    }
    return bad == 0;
}

// Kingma and Ba 2015, Algorithm 1, with epsilon outside the corrected root as torch has it.
void adam(const AdamSettings& settings, size_t count, const float* __restrict gradients,
          float* __restrict parameters, float* __restrict first_moment,
          float* __restrict second_moment) {
    const float beta1 = settings.beta1;
    const float beta2 = settings.beta2;
    const float epsilon = settings.epsilon;
    const float step = settings.learning_rate / settings.bias_correction1;
    const float scale = 1.0f / sqrtf(settings.bias_correction2);
    for (size_t i = 0; i < count; ++i) {
        const float g = gradients[i];
        const float m = beta1 * first_moment[i] + (1.0f - beta1) * g;
        const float v = beta2 * second_moment[i] + (1.0f - beta2) * g * g;
        first_moment[i] = m;
        second_moment[i] = v;
        parameters[i] -= step * m / (sqrtf(v) * scale + epsilon);
    }
}

}  // namespace
}  // namespace meslam
