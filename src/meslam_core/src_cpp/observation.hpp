// Which voxels of a cube rays have seen.
#pragma once

#include <cstddef>
#include <cstdint>

namespace meslam {

struct VoxelCube {
    uint8_t* flags;  // (side,side,side)
    int side;
    float voxel_m;
};

// Sets bits along each ray until `truncation_m` behind its end, and more bits within that of it.
//   origin (3): about the cube's centre [m]; directions (count,3): unit vectors;
//   distances (count): of the surface [m].
void mark_rays(const VoxelCube& cube, const float* origin, const float* directions,
               const float* distances, size_t count, float truncation_m, uint8_t along,
               uint8_t at_end);

}  // namespace meslam
