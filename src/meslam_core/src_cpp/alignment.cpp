#include "alignment.hpp"

#include <algorithm>
#include <cmath>

namespace meslam {
namespace {

void to_map(const double* matrix, const float* gradient, double* result) {
    for (int j = 0; j < 3; ++j) {
        result[j] =
            gradient[0] * matrix[j] + gradient[1] * matrix[3 + j] + gradient[2] * matrix[6 + j];
    }
}

double huber_weight(double residual, double threshold) {
    return std::min(1.0, threshold / std::max(std::fabs(residual), 1e-12));
}

class NormalEquations {
public:
    // direction: of the residual's derivative with respect to the point, map axes.
    void add(const double* direction, const float* arm, double residual, double weight) {
        const double jacobian[6] = {direction[0],
                                    direction[1],
                                    direction[2],
                                    arm[1] * direction[2] - arm[2] * direction[1],
                                    arm[2] * direction[0] - arm[0] * direction[2],
                                    arm[0] * direction[1] - arm[1] * direction[0]};
        int entry = 0;
        for (int i = 0; i < 6; ++i) {
            const double weighted = weight * jacobian[i];
            gradient_[i] += weighted * residual;
            for (int j = i; j < 6; ++j) upper_[entry++] += weighted * jacobian[j];
        }
    }

    void write(double* information, double* gradient) const {
        int entry = 0;
        for (int i = 0; i < 6; ++i) {
            gradient[i] = gradient_[i];
            for (int j = i; j < 6; ++j) {
                information[6 * i + j] = information[6 * j + i] = upper_[entry++];
            }
        }
    }

private:
    double upper_[21] = {};
    double gradient_[6] = {};
};

}  // namespace

void normal_equations(const AlignmentSettings& settings, const AlignmentPoints& points,
                      double* information, double* gradient, float* distance, bool* usable) {
    constexpr double kLuma[3] = {0.299, 0.587, 0.114};
    NormalEquations equations;
    for (size_t i = 0; i < points.count; ++i) {
        const float* const value = points.values + 4 * i;
        const float* const arm = points.arms + 3 * i;
        double direction[3];
        to_map(settings.to_map, points.grad_distance + 3 * i, direction);
        const double slope = std::sqrt(direction[0] * direction[0] + direction[1] * direction[1] +
                                       direction[2] * direction[2]);
        const double weight = points.weights[i];
        usable[i] =
            weight > 0.0 && std::fabs(value[0]) < settings.saturation && slope > settings.min_slope;
        const double divisor = std::max(slope, 1e-6);
        const double residual = (value[0] - settings.surface_level) / divisor;
        distance[i] = static_cast<float>(residual);
        if (!usable[i]) continue;
        for (double& component : direction) component /= divisor;
        equations.add(direction, arm, residual, weight * huber_weight(residual, settings.huber));
        if (points.grad_luma == nullptr) continue;
        double luma = -points.luma[i];
        for (int c = 0; c < 3; ++c) luma += kLuma[c] * value[1 + c];
        to_map(settings.to_map, points.grad_luma + 3 * i, direction);
        const double scale = settings.color_weight;
        equations.add(direction, arm, luma,
                      weight * scale * scale * huber_weight(scale * luma, settings.huber));
    }
    equations.write(information, gradient);
}

}  // namespace meslam
