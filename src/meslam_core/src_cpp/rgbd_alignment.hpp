// Direct alignment of two RGB-D images: photometric and point-to-plane residuals on an image
// pyramid, with weights of a t-distribution (Kerl et al., "Robust odometry estimation for RGB-D
// cameras", ICRA 2013).
#pragma once

#include <cstddef>
#include <vector>

namespace meslam {

struct Intrinsics {
    float fx, fy, cx, cy;
};

// A pyramid level: what is looked up in it as a target, and its points as a source.
struct RgbdLevel {
    int width = 0;
    int height = 0;
    Intrinsics camera{};
    std::vector<float> luma;   // (height, width)
    std::vector<float> depth;  // (height, width) [m], 0 where there is none
    // (height, width, 8): luma, its derivatives by column and row, depth, normal, validity of both.
    std::vector<float> texels;
    // The points of pixels with depth, structure of arrays.
    std::vector<float> x, y, z, point_luma;
};

class RgbdPyramid {
public:
    // gray and depth [m] are (height, width); depth outside the range is as none. The finest of
    // `levels` levels is the image halved `halvings` times.
    RgbdPyramid(int width, int height, const unsigned char* gray, const float* depth,
                float min_depth, float max_depth, const Intrinsics& camera, int halvings,
                int levels);

    const std::vector<RgbdLevel>& levels() const { return levels_; }
    size_t measured() const { return levels_.front().z.size(); }

private:
    std::vector<RgbdLevel> levels_;
};

struct RgbdAlignmentSettings {
    int finest;          // the level that is aligned last; 0 is the pyramid's first
    int levels;          // of the pyramid that may be used
    int iterations;      // at most, a level
    float max_distance;  // of corresponding depths [m]; grows by half with every level
    float convergence;   // a step below this [m, rad] ends the finest level, twice it the next, ...
    // Residuals that err together count as one.
    float correlated;
    // What the pose that the images alone tell may be off by [m, rad], for all their contrast:
    // colour and depth are taken at different times, and colour line by line.
    float luma_bias_m, luma_bias_rad;
};

struct RgbdAlignment {
    double pose[16];          // T_target_source, row-major
    double information[36];   // (translation, rotation) about the target's origin, target axes
    double inliers;           // points whose depth agrees
    double visible;           // points that fall on measured depth
    double in_view;           // points that fall into the image
    double same_light;        // of those, points of the luma seen there
    double points;            // of the source level
    double squared_distance;  // sum over the inliers [m^2]
    double luma_sigma;        // scale of the luma residuals at the end
    double depth_scale;       // of the depth residuals in units of their expected noise
    int iterations;
};

// pose: first guess of T_target_source, row-major.
RgbdAlignment align_rgbd(const RgbdPyramid& source, const RgbdPyramid& target, const double* pose,
                         const RgbdAlignmentSettings& settings);

}  // namespace meslam
