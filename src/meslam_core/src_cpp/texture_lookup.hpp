// Colours where rays meet textured triangles: trilinear lookups in an atlas with mip levels.
#pragma once

#include <cstddef>
#include <cstdint>

namespace meslam {

// An 8-bit RGB image that holds all levels, rows one after the other; at least 3 wide and 2 high.
struct TextureAtlas {
    const uint8_t* texels;
    int width, height;
    // Of each level: scale of positions and shift of the level, rows of `levels` numbers each.
    const float *scale, *left, *top;
    int levels;
};

// Of each triangle: position of its first corner in the finest level, its two edges [px], and the
// length of a texel [m].
struct TriangleTexels {
    static constexpr size_t kColumns = 7;
    const float* rows;
    size_t triangles;
};

// Where rays end: distance along the optical axis [m], triangle, barycentric shares of its second
// and third corner, cosine between ray and normal. A distance that is not finite hits nothing.
struct RayHits {
    const float* distance;
    const uint32_t* triangle;
    const float* shares;
    const float* cosine;
    size_t count;
};

// Colours (count, 3) in [0, 255], black where nothing is hit. Bilinear in the two levels next to
// the pixel's footprint, with OpenCV's steps of 1/32 texel, then linear between them. Triangles
// must be valid where the distance is finite.
void shade(const TextureAtlas& atlas, const TriangleTexels& texels, const RayHits& hits,
           float focal_px, float* color);

}  // namespace meslam
