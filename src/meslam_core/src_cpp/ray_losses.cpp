#include "ray_losses.hpp"

#include <algorithm>
#include <cmath>

namespace meslam {
namespace {

// A denser interval lets nothing through, and its gradient is zero.
constexpr float kMaxOpticalDepth = 30.0f;
constexpr float kMinOpacity = 1e-4f;

float sign(float x) { return static_cast<float>((x > 0.0f) - (x < 0.0f)); }

struct Rendered {
    float distance;
    float opacity;
    float color[3];
};

// An interval's density times its length, before it is cut.
float optical_depth(const RaySettings& settings, int samples, const float* along,
                    const float* values, int i) {
    // A measured ray ends: what passes through its other intervals ends in the last one.
    if (i + 1 == samples) return 2.0f * kMaxOpticalDepth;
    return settings.density_scale * std::max(values[4 * i], 0.0f) * (along[i + 1] - along[i]);
}

// The light that reaches the end of interval i, and the share that ends in it, go to
// passed_and_weight[4 * i] and [4 * i + 1].
Rendered render(const RaySettings& settings, int samples, const float* along, const float* values,
                float* passed_and_weight) {
    Rendered result{};
    float light = 1.0f, weighted_distance = 0.0f;
    for (int i = 0; i < samples; ++i) {
        const float depth =
            std::min(optical_depth(settings, samples, along, values, i), kMaxOpticalDepth);
        const float ends = -std::expm1(-depth);
        const float weight = light * ends;
        light *= 1.0f - ends;
        passed_and_weight[4 * i] = light;
        passed_and_weight[4 * i + 1] = weight;
        result.opacity += weight;
        weighted_distance += weight * along[i];
        for (int c = 0; c < 3; ++c) result.color[c] += weight * values[4 * i + 1 + c];
    }
    result.distance = weighted_distance / std::max(result.opacity, kMinOpacity);
    return result;
}

}  // namespace

void ray_losses(const RaySettings& settings, const RayMeasurement& measured, int samples,
                const float* along, const float* values, float scale, float* losses,
                float* grad_values) {
    // The gradient's memory holds the light until the gradient takes its place.
    const Rendered rendered = render(settings, samples, along, values, grad_values);
    const float depth_error = rendered.distance - measured.distance;
    losses[1] = settings.depth_weight * std::min(std::fabs(depth_error), settings.depth_clip);
    losses[2] = 0.0f;
    float color_slope[3];
    for (int c = 0; c < 3; ++c) {
        const float error = rendered.color[c] - measured.color[c];
        losses[2] += settings.color_weight / 3.0f * std::fabs(error);
        color_slope[c] = scale * settings.color_weight / 3.0f * sign(error);
    }
    const float depth_slope = std::fabs(depth_error) <= settings.depth_clip
                                  ? scale * settings.depth_weight * sign(depth_error)
                                  : 0.0f;
    const float normalizer = std::max(rendered.opacity, kMinOpacity);
    const float pull = rendered.opacity >= kMinOpacity ? rendered.distance : 0.0f;

    const float confidence =
        std::min(1.5f, 1.0f / (0.5f + 0.125f * measured.distance * measured.distance));
    const float distance_scale =
        settings.distance_weight * confidence / static_cast<float>(samples);
    float distance_loss = 0.0f, behind = 0.0f;
    for (int i = samples - 1; i >= 0; --i) {
        const float* const value = values + 4 * i;
        float* const gradient = grad_values + 4 * i;
        const float light = gradient[0], weight = gradient[1];
        const float target = std::clamp(
            (along[i] - measured.distance + settings.surface_offset) / settings.truncation, -1.0f,
            1.0f);
        const float error = value[0] - target;
        distance_loss += distance_scale * std::fabs(error);
        // Of the sum of the losses with respect to this interval's weight.
        float slope = depth_slope * (along[i] - pull) / normalizer;
        for (int c = 0; c < 3; ++c) {
            slope += color_slope[c] * value[1 + c];
            gradient[1 + c] = color_slope[c] * weight;
        }
        gradient[0] = scale * distance_scale * sign(error);
        const float depth = optical_depth(settings, samples, along, values, i);
        if (value[0] > 0.0f && depth <= kMaxOpticalDepth) {
            gradient[0] += (slope * light - behind) * depth / value[0];
        }
        behind += slope * weight;
    }
    losses[0] = distance_loss;
}

}  // namespace meslam
