// Which triangle every pixel of a pinhole camera sees, without a ray cast for each.
#pragma once

#include <cstddef>
#include <cstdint>

namespace meslam {

struct Pinhole {
    int width, height;
    double fx, fy, cx, cy;
};

// Of every pixel, row by row: depth along the optical axis [m], infinite where nothing is; the
// triangle; the barycentric shares of its second and third corner; the cosine between the pixel's
// ray and its normal. Triangles are seen from both sides.
struct Visible {
    float* depth;
    uint32_t* triangle;
    float* shares;
    float* cosine;
};

// Homogeneous rasterisation after Olano and Greer, Triangle Scan Conversion using 2D Homogeneous
// Coordinates, 1997: nothing is clipped. `corners` are `triangles` times three points in the
// camera's frame [m].
void rasterize(const Pinhole& camera, const double* corners, size_t triangles,
               const Visible& visible);

}  // namespace meslam
