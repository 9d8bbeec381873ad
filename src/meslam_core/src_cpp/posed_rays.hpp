// Rays in the cameras' frames with the cameras' poses, and their way to region coordinates and
// back.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace meslam {

struct PosedRays {
    size_t rays;
    size_t poses;
    const float* rotations;     // (poses,3,3): T_map_camera
    const float* translations;  // (poses,3) [m]
    const int64_t* pose;        // (rays): each ray's pose
    const float* directions;    // (rays,3): unit vectors, camera frame
    const float* distances;     // (rays): of the measured surface [m]
    const float* colors;        // (rays,3): measured, in [0, 1]
    const float* weights;       // (rays): factors on the rays' losses; null for ones
    float to_region[12];        // (3,4): from the map frame to region coordinates
};

// Origins and directions (rays,3) in region coordinates.
struct RegionRays {
    std::vector<float> origins;
    std::vector<float> directions;
};

RegionRays to_region(const PosedRays& rays);

// grad_twists (poses,6): gradients of small moves (translation [m], rotation [rad]) of the cameras
// about their centres, map axes, from those of origins and directions in region coordinates.
void twist_gradients(const PosedRays& rays, const float* grad_origins, const float* grad_directions,
                     float* grad_twists);

}  // namespace meslam
