#include "observation.hpp"

#include <cmath>

namespace meslam {
namespace {

constexpr int kStepsAtEnd = 5;

}  // namespace

void mark_rays(const VoxelCube& cube, const float* origin, const float* directions,
               const float* distances, size_t count, float truncation_m, uint8_t along,
               uint8_t at_end) {
    const float half = 0.5f * static_cast<float>(cube.side);
    const float side = static_cast<float>(cube.side);
    const auto mark = [&](const float* direction, float distance, uint8_t bits) {
        int index = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const float at =
                (origin[axis] + distance * direction[axis]) / cube.voxel_m + half;
            // Also false for what is no number.
            if (!(at >= 0.0f && at < side)) return;
            index = index * cube.side + static_cast<int>(at);
        }
        cube.flags[index] |= bits;
    };
    for (size_t ray = 0; ray < count; ++ray) {
        const float* const direction = directions + 3 * ray;
        const float distance = distances[ray];
        if (!std::isfinite(distance)) continue;
        const float seen = distance + truncation_m;
        int step = 0;
        for (float reached = 0.0f; reached <= seen;
             reached = static_cast<float>(++step) * cube.voxel_m) {
            mark(direction, reached, along);
        }
        for (int end = 0; end < kStepsAtEnd; ++end) {
            const float share = 2.0f * static_cast<float>(end) / (kStepsAtEnd - 1) - 1.0f;
            mark(direction, distance + share * truncation_m, at_end);
        }
    }
}

}  // namespace meslam
