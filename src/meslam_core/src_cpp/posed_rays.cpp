#include "posed_rays.hpp"

#include <algorithm>

namespace meslam {
namespace {

void rotated(const float* rotation, const float* vector, float* result) {
    for (int i = 0; i < 3; ++i) {
        result[i] = rotation[3 * i] * vector[0] + rotation[3 * i + 1] * vector[1] +
                    rotation[3 * i + 2] * vector[2];
    }
}

// By the transpose of the linear part of to_region: a gradient by region coordinates becomes one
// by map coordinates.
void gradient_in_map(const float* to_region, const float* gradient, float* result) {
    for (int j = 0; j < 3; ++j) {
        result[j] = to_region[j] * gradient[0] + to_region[4 + j] * gradient[1] +
                    to_region[8 + j] * gradient[2];
    }
}

}  // namespace

RegionRays to_region(const PosedRays& rays) {
    RegionRays result{std::vector<float>(3 * rays.rays), std::vector<float>(3 * rays.rays)};
    for (size_t ray = 0; ray < rays.rays; ++ray) {
        const size_t pose = static_cast<size_t>(rays.pose[ray]);
        const float* const origin = rays.translations + 3 * pose;
        float direction[3];
        rotated(rays.rotations + 9 * pose, rays.directions + 3 * ray, direction);
        for (int i = 0; i < 3; ++i) {
            const float* const row = rays.to_region + 4 * i;
            result.origins[3 * ray + i] =
                row[0] * origin[0] + row[1] * origin[1] + row[2] * origin[2] + row[3];
            result.directions[3 * ray + i] =
                row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2];
        }
    }
    return result;
}

void twist_gradients(const PosedRays& rays, const float* grad_origins, const float* grad_directions,
                     float* grad_twists) {
    std::vector<double> sums(6 * rays.poses, 0.0);
    for (size_t ray = 0; ray < rays.rays; ++ray) {
        const size_t pose = static_cast<size_t>(rays.pose[ray]);
        float direction[3], by_origin[3], by_direction[3];
        rotated(rays.rotations + 9 * pose, rays.directions + 3 * ray, direction);
        gradient_in_map(rays.to_region, grad_origins + 3 * ray, by_origin);
        gradient_in_map(rays.to_region, grad_directions + 3 * ray, by_direction);
        double* const sum = sums.data() + 6 * pose;
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, k = (i + 2) % 3;
            sum[i] += by_origin[i];
            sum[3 + i] += direction[j] * by_direction[k] - direction[k] * by_direction[j];
        }
    }
    std::copy(sums.begin(), sums.end(), grad_twists);
}

}  // namespace meslam
