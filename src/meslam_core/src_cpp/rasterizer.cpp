#include "rasterizer.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace meslam {
namespace {

constexpr uint32_t kNothing = 0xffffffffu;
// Corners nearer than this are not projected [m]; their triangles may cover any row.
constexpr double kNear_m = 1e-3;

struct Vector {
    double x, y, z;
};

Vector cross(const Vector& a, const Vector& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

double dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// A number that is linear over the image.
struct Plane {
    double per_column, per_row, constant;

    double at(double column, double row) const {
        return per_column * column + per_row * row + constant;
    }
};

// The share of a corner of the ray's end, divided by its depth: inside the triangle all three are
// positive, and their sum is the inverse depth.
Plane share_plane(const Vector& across, double volume, const Pinhole& camera) {
    const double per_column = across.x / volume / camera.fx, per_row = across.y / volume / camera.fy;
    return {per_column, per_row,
            across.z / volume - per_column * camera.cx - per_row * camera.cy};
}

struct Triangle {
    Plane shares[3];
    Plane inverse_depth;
    // Unit normal times what a pixel's ray is long: linear, as the ray is.
    Plane facing;
    int first_row, last_row;
};

bool set_up(const double* corners, const Pinhole& camera, Triangle& result) {
    const Vector a{corners[0], corners[1], corners[2]}, b{corners[3], corners[4], corners[5]},
        c{corners[6], corners[7], corners[8]};
    if (std::max({a.z, b.z, c.z}) <= 0.0) return false;
    const double volume = dot(a, cross(b, c));
    const Vector normal = cross({b.x - a.x, b.y - a.y, b.z - a.z}, {c.x - a.x, c.y - a.y, c.z - a.z});
    const double length = std::sqrt(dot(normal, normal));
    if (volume == 0.0 || length == 0.0) return false;
    result.first_row = 0;
    result.last_row = camera.height - 1;
    if (std::min({a.z, b.z, c.z}) > kNear_m) {
        const auto row = [&](const Vector& p) { return camera.fy * p.y / p.z + camera.cy; };
        const auto column = [&](const Vector& p) { return camera.fx * p.x / p.z + camera.cx; };
        const auto [left, right] = std::minmax({column(a), column(b), column(c)});
        const auto [top, bottom] = std::minmax({row(a), row(b), row(c)});
        if (left > camera.width - 1 || right < 0.0) return false;
        // Far outside, rows do not fit an int.
        const double rows = camera.height;
        result.first_row = static_cast<int>(std::ceil(std::clamp(top, 0.0, rows)));
        result.last_row = static_cast<int>(std::floor(std::clamp(bottom, -1.0, rows - 1.0)));
    }
    result.shares[0] = share_plane(cross(b, c), volume, camera);
    result.shares[1] = share_plane(cross(c, a), volume, camera);
    result.shares[2] = share_plane(cross(a, b), volume, camera);
    result.inverse_depth = {};
    for (const Plane& plane : result.shares) {
        result.inverse_depth.per_column += plane.per_column;
        result.inverse_depth.per_row += plane.per_row;
        result.inverse_depth.constant += plane.constant;
    }
    result.facing = share_plane(normal, length, camera);
    return result.first_row <= result.last_row;
}

// The columns of a row that the triangle covers; empty where the first is beyond the last.
void span(const Triangle& triangle, int row, int width, int& first, int& last) {
    double from = 0.0, to = width - 1;
    for (const Plane& plane : triangle.shares) {
        const double constant = plane.per_row * row + plane.constant;
        if (plane.per_column > 0.0) {
            from = std::max(from, -constant / plane.per_column);
        } else if (plane.per_column < 0.0) {
            to = std::min(to, -constant / plane.per_column);
        } else if (constant < 0.0) {
            to = -1.0;
        }
    }
    first = from > width - 1 ? width : static_cast<int>(std::ceil(from));
    last = to < 0.0 ? -1 : static_cast<int>(std::floor(to));
}

}  // namespace

void rasterize(const Pinhole& camera, const double* corners, size_t triangles,
               const Visible& visible) {
    const size_t width = static_cast<size_t>(camera.width);
    const size_t pixels = width * static_cast<size_t>(camera.height);
    std::vector<Triangle> in_view;
    std::vector<uint32_t> numbers;
    // Until the end, depths are inverse ones, and triangles are numbered among those in view.
    std::fill(visible.depth, visible.depth + pixels, 0.0f);
    std::fill(visible.triangle, visible.triangle + pixels, kNothing);
    for (size_t number = 0; number < triangles; ++number) {
        Triangle triangle;
        if (!set_up(corners + 9 * number, camera, triangle)) continue;
        const uint32_t name = static_cast<uint32_t>(in_view.size());
        for (int row = triangle.first_row; row <= triangle.last_row; ++row) {
            int first, last;
            span(triangle, row, camera.width, first, last);
            const float start = static_cast<float>(triangle.inverse_depth.at(first, row));
            const float step = static_cast<float>(triangle.inverse_depth.per_column);
            float* const depth = visible.depth + static_cast<size_t>(row) * width + first;
            uint32_t* const names = visible.triangle + static_cast<size_t>(row) * width + first;
            for (int i = 0; i <= last - first; ++i) {
                const float inverse = start + step * static_cast<float>(i);
                const bool nearer = inverse > depth[i];
                depth[i] = nearer ? inverse : depth[i];
                names[i] = nearer ? name : names[i];
            }
        }
        in_view.push_back(triangle);
        numbers.push_back(static_cast<uint32_t>(number));
    }
    size_t pixel = 0;
    for (int row = 0; row < camera.height; ++row) {
        const double y = (row - camera.cy) / camera.fy;
        for (int column = 0; column < camera.width; ++column, ++pixel) {
            if (visible.triangle[pixel] == kNothing) {
                visible.depth[pixel] = std::numeric_limits<float>::infinity();
                visible.shares[2 * pixel] = visible.shares[2 * pixel + 1] = 0.0f;
                visible.cosine[pixel] = 0.0f;
                continue;
            }
            const Triangle& triangle = in_view[visible.triangle[pixel]];
            const double x = (column - camera.cx) / camera.fx;
            const double depth = 1.0 / triangle.inverse_depth.at(column, row);
            const double facing = std::abs(triangle.facing.at(column, row));
            visible.depth[pixel] = static_cast<float>(depth);
            visible.shares[2 * pixel] = static_cast<float>(depth * triangle.shares[1].at(column, row));
            visible.shares[2 * pixel + 1] =
                static_cast<float>(depth * triangle.shares[2].at(column, row));
            visible.cosine[pixel] = static_cast<float>(facing / std::sqrt(x * x + y * y + 1.0));
            visible.triangle[pixel] = numbers[visible.triangle[pixel]];
        }
    }
}

}  // namespace meslam
