// Pyramids of RGB-D images and their alignment, for Python.
#include <algorithm>
#include <string>

#include "bindings.hpp"
#include "rgbd_alignment.hpp"

namespace meslam {
namespace {

constexpr py::ssize_t kMaxSide = 16384;

RgbdPyramid* new_pyramid(const py::array& gray, const py::array& depth, float min_depth,
                         float max_depth, float fx, float fy, float cx, float cy, int halvings,
                         int levels) {
    if (!py::isinstance<py::array_t<uint8_t>>(gray) || gray.ndim() != 2 ||
        !(gray.flags() & py::array::c_style)) {
        throw py::type_error("gray has dtype " + std::string(py::str(gray.dtype())) +
                             " and shape " + describe_shape(gray) +
                             "; contiguous uint8 (height, width) is expected");
    }
    if (halvings < 0 || halvings > 8 || levels < 1 || levels > 16) {
        throw py::value_error("halvings must be 0 to 8, and levels 1 to 16");
    }
    const py::ssize_t shorter = std::min(gray.shape(0), gray.shape(1));
    if (shorter >> halvings < 8 || std::max(gray.shape(0), gray.shape(1)) > kMaxSide) {
        throw py::value_error("gray has shape " + describe_shape(gray) + "; sides of 8, after " +
                              std::to_string(halvings) + " halvings, to 16384 are expected");
    }
    const float* const depth_from = matrix(depth, "depth", gray.shape(0), gray.shape(1));
    const uint8_t* const gray_from = static_cast<const uint8_t*>(gray.data());
    if (!(fx > 0.0f && fy > 0.0f)) throw py::value_error("fx and fy must be positive");
    const int width = static_cast<int>(gray.shape(1)), height = static_cast<int>(gray.shape(0));
    const py::gil_scoped_release unlocked;
    return new RgbdPyramid(width, height, gray_from, depth_from, min_depth, max_depth,
                           {fx, fy, cx, cy}, halvings, levels);
}

py::dict align(const RgbdPyramid& source, const RgbdPyramid& target,
               const py::array_t<double, py::array::c_style | py::array::forcecast>& pose,
               int finest, int levels, int iterations, float max_distance, float convergence,
               float correlated, float luma_bias_m, float luma_bias_rad) {
    if (pose.ndim() != 2 || pose.shape(0) != 4 || pose.shape(1) != 4) {
        throw py::value_error("T_target_source has shape " + describe_shape(pose) +
                              "; (4, 4) is expected");
    }
    if (finest < 0 || levels < 1 || iterations < 1 || !(correlated >= 1.0f)) {
        throw py::value_error("finest must not be negative; levels, iterations and correlated must be at least 1");
    }
    const RgbdAlignmentSettings settings{finest,      levels,      iterations,  max_distance, convergence,
                                         correlated, luma_bias_m, luma_bias_rad};
    const double* const guess = pose.data();
    RgbdAlignment found;
    {
        const py::gil_scoped_release unlocked;
        found = align_rgbd(source, target, guess, settings);
    }
    py::array_t<double> transformation({4, 4});
    py::array_t<double> information({6, 6});
    std::copy(found.pose, found.pose + 16, transformation.mutable_data());
    std::copy(found.information, found.information + 36, information.mutable_data());
    py::dict result;
    result["T_target_source"] = transformation;
    result["information"] = information;
    result["inliers"] = found.inliers;
    result["visible"] = found.visible;
    result["in_view"] = found.in_view;
    result["same_light"] = found.same_light;
    result["points"] = found.points;
    result["squared_distance"] = found.squared_distance;
    result["luma_sigma"] = found.luma_sigma;
    result["depth_scale"] = found.depth_scale;
    result["iterations"] = found.iterations;
    return result;
}

}  // namespace

void bind_rgbd(py::module_& module) {
    py::class_<RgbdPyramid>(module, "RgbdPyramid")
        .def(py::init(&new_pyramid), py::arg("gray"), py::arg("depth"), py::kw_only(),
             py::arg("min_depth"), py::arg("max_depth"), py::arg("fx"), py::arg("fy"),
             py::arg("cx"), py::arg("cy"), py::arg("halvings"), py::arg("levels"))
        .def_property_readonly("levels",
                               [](const RgbdPyramid& pyramid) { return pyramid.levels().size(); })
        .def_property_readonly("measured", &RgbdPyramid::measured);
    module.def("align_rgbd", align, py::arg("source"), py::arg("target"),
               py::arg("T_target_source"), py::kw_only(), py::arg("finest"),
               py::arg("levels"), py::arg("iterations"), py::arg("max_distance"), py::arg("convergence"),
               py::arg("correlated"), py::arg("luma_bias_m"), py::arg("luma_bias_rad"));
}

}  // namespace meslam
