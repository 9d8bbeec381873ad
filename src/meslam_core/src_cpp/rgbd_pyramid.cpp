#include <algorithm>
#include <cmath>

#include "rgbd_alignment.hpp"

namespace meslam {
namespace {

// Depths that differ by more than this share lie on different surfaces.
constexpr float kSameSurface = 0.03f;
// Half the baseline, in pixels, over which a normal is measured.
constexpr int kNormalReach = 2;
constexpr float kMinIncidence = 0.15f;
constexpr int kTexel = 8;
// A level of fewer pixels along a side is not halved.
constexpr int kMinSize = 16;

RgbdLevel halved(const RgbdLevel& fine) {
    RgbdLevel coarse;
    coarse.width = fine.width / 2;
    coarse.height = fine.height / 2;
    coarse.camera = {fine.camera.fx / 2, fine.camera.fy / 2, (fine.camera.cx - 0.5f) / 2,
                     (fine.camera.cy - 0.5f) / 2};
    const size_t count = static_cast<size_t>(coarse.width) * coarse.height;
    coarse.luma.resize(count);
    coarse.depth.resize(count);
    for (int row = 0; row < coarse.height; ++row) {
        for (int column = 0; column < coarse.width; ++column) {
            const size_t corner = static_cast<size_t>(2 * row) * fine.width + 2 * column;
            const size_t corners[4] = {corner, corner + 1, corner + fine.width,
                                       corner + fine.width + 1};
            float light = 0.0f, nearest = 0.0f;
            for (const size_t at : corners) {
                light += fine.luma[at];
                const float z = fine.depth[at];
                if (z > 0.0f && (nearest == 0.0f || z < nearest)) nearest = z;
            }
            float sum = 0.0f, weight = 0.0f;
            for (const size_t at : corners) {
                const float z = fine.depth[at];
                if (z > 0.0f && z < nearest * (1.0f + kSameSurface)) {
                    sum += z;
                    weight += 1.0f;
                }
            }
            const size_t to = static_cast<size_t>(row) * coarse.width + column;
            coarse.luma[to] = 0.25f * light;
            coarse.depth[to] = weight > 0.0f ? sum / weight : 0.0f;
        }
    }
    return coarse;
}

// Mean of the 3x3 neighbours on the same surface.
std::vector<float> smoothed(const RgbdLevel& level) {
    std::vector<float> result(level.depth.size(), 0.0f);
    for (int row = 0; row < level.height; ++row) {
        const int first = std::max(row - 1, 0), last = std::min(row + 1, level.height - 1);
        for (int column = 0; column < level.width; ++column) {
            const size_t at = static_cast<size_t>(row) * level.width + column;
            const float center = level.depth[at];
            if (center <= 0.0f) continue;
            const float tolerance = kSameSurface * center;
            const int left = std::max(column - 1, 0), right = std::min(column + 1, level.width - 1);
            float sum = 0.0f, weight = 0.0f;
            for (int r = first; r <= last; ++r) {
                const float* const line = level.depth.data() + static_cast<size_t>(r) * level.width;
                for (int c = left; c <= right; ++c) {
                    const float same = std::fabs(line[c] - center) < tolerance ? 1.0f : 0.0f;
                    sum += same * line[c];
                    weight += same;
                }
            }
            result[at] = sum / weight;
        }
    }
    return result;
}

// Change of depth a pixel along one axis, from the neighbours on the same surface.
bool slope(const std::vector<float>& depth, size_t at, int position, int size, int stride,
           float* result) {
    const float center = depth[at];
    const float tolerance = 2.0f * kSameSurface * center;
    const auto usable = [&](int offset) {
        if (position + offset < 0 || position + offset >= size) return false;
        const float z = depth[at + static_cast<ptrdiff_t>(offset) * stride];
        return z > 0.0f && std::fabs(z - center) < tolerance;
    };
    const bool before = usable(-kNormalReach), after = usable(kNormalReach);
    const ptrdiff_t reach = static_cast<ptrdiff_t>(kNormalReach) * stride;
    if (before && after) {
        *result = (depth[at + reach] - depth[at - reach]) / (2 * kNormalReach);
    } else if (after) {
        *result = (depth[at + reach] - center) / kNormalReach;
    } else if (before) {
        *result = (center - depth[at - reach]) / kNormalReach;
    }
    return before || after;
}

// The unit normal, towards the camera, of the surface z(u, v) at a pixel.
bool normal_at(const RgbdLevel& level, const std::vector<float>& depth, int row, int column,
               float* normal) {
    const size_t at = static_cast<size_t>(row) * level.width + column;
    const float z = depth[at];
    float dz_du = 0.0f, dz_dv = 0.0f;
    if (z <= 0.0f || !slope(depth, at, column, level.width, 1, &dz_du) ||
        !slope(depth, at, row, level.height, level.width, &dz_dv)) {
        return false;
    }
    const float a = (column - level.camera.cx) / level.camera.fx;
    const float b = (row - level.camera.cy) / level.camera.fy;
    // Cross product of the derivatives of (a z, b z, z) by column and row.
    const float u[3] = {a * dz_du + z / level.camera.fx, b * dz_du, dz_du};
    const float v[3] = {a * dz_dv, b * dz_dv + z / level.camera.fy, dz_dv};
    float n[3] = {v[1] * u[2] - v[2] * u[1], v[2] * u[0] - v[0] * u[2], v[0] * u[1] - v[1] * u[0]};
    const float length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    if (!(length > 0.0f)) return false;
    for (int i = 0; i < 3; ++i) normal[i] = n[i] / length;
    const float incidence = -(normal[0] * a + normal[1] * b + normal[2]);
    return incidence > kMinIncidence * std::sqrt(a * a + b * b + 1.0f);
}

void add_texels(RgbdLevel& level) {
    const std::vector<float> depth = smoothed(level);
    level.texels.assign(depth.size() * kTexel, 0.0f);
    for (int row = 0; row < level.height; ++row) {
        const int above = std::max(row - 1, 0), below = std::min(row + 1, level.height - 1);
        for (int column = 0; column < level.width; ++column) {
            const size_t line = static_cast<size_t>(row) * level.width;
            const int left = std::max(column - 1, 0), right = std::min(column + 1, level.width - 1);
            float* const texel = level.texels.data() + (line + column) * kTexel;
            texel[0] = level.luma[line + column];
            texel[1] = (level.luma[line + right] - level.luma[line + left]) / (right - left);
            texel[2] = (level.luma[static_cast<size_t>(below) * level.width + column] -
                        level.luma[static_cast<size_t>(above) * level.width + column]) /
                       (below - above);
            texel[3] = depth[line + column];
            texel[7] = normal_at(level, depth, row, column, texel + 4) ? 1.0f : 0.0f;
        }
    }
}

void add_points(RgbdLevel& level) {
    for (int row = 0; row < level.height; ++row) {
        for (int column = 0; column < level.width; ++column) {
            const size_t at = static_cast<size_t>(row) * level.width + column;
            const float z = level.depth[at];
            if (z <= 0.0f) continue;
            level.x.push_back((column - level.camera.cx) / level.camera.fx * z);
            level.y.push_back((row - level.camera.cy) / level.camera.fy * z);
            level.z.push_back(z);
            level.point_luma.push_back(level.luma[at]);
        }
    }
}

}  // namespace

RgbdPyramid::RgbdPyramid(int width, int height, const unsigned char* gray, const float* depth,
                         float min_depth, float max_depth, const Intrinsics& camera, int halvings,
                         int levels) {
    const size_t count = static_cast<size_t>(width) * height;
    RgbdLevel finest;
    finest.width = width;
    finest.height = height;
    finest.camera = camera;
    finest.luma.resize(count);
    finest.depth.resize(count);
    for (size_t i = 0; i < count; ++i) finest.luma[i] = gray[i] * (1.0f / 255.0f);
    // NaN compares as false, and so becomes a hole.
    for (size_t i = 0; i < count; ++i) {
        finest.depth[i] = depth[i] >= min_depth && depth[i] <= max_depth ? depth[i] : 0.0f;
    }
    for (int i = 0; i < halvings; ++i) finest = halved(finest);
    levels_.push_back(std::move(finest));
    while (static_cast<int>(levels_.size()) < levels && levels_.back().width >= kMinSize &&
           levels_.back().height >= kMinSize) {
        levels_.push_back(halved(levels_.back()));
    }
    for (RgbdLevel& level : levels_) {
        add_texels(level);
        add_points(level);
    }
}

}  // namespace meslam
