// Marking what rays have seen, for Python.
#include <string>

#include "bindings.hpp"
#include "observation.hpp"

namespace meslam {
namespace {

constexpr float kFarthest_m = 1000.0f;

void mark(const py::array& flags, const py::array& origin, const py::array& directions,
          const py::array& distances, float voxel_m, float truncation_m, uint8_t along,
          uint8_t at_end) {
    const bool bytes = py::isinstance<py::array_t<uint8_t>>(flags);
    if (!bytes || flags.ndim() != 3 || flags.shape(0) != flags.shape(1) ||
        flags.shape(0) != flags.shape(2) || flags.shape(0) > 1024 ||
        !(flags.flags() & py::array::c_style) || !flags.writeable()) {
        throw py::value_error("flags has dtype " + std::string(py::str(flags.dtype())) +
                              " and shape " + describe_shape(flags) +
                              "; a writeable contiguous uint8 cube of at most 1024 is expected");
    }
    if (!(voxel_m > 0.0f && truncation_m >= 0.0f)) {
        throw py::value_error("voxel_m must be positive, and truncation_m not negative");
    }
    const size_t count = static_cast<size_t>(distances.size());
    const float* const from = flat(origin, "origin", 3);
    const float* const lengths = flat(distances, "distances", count);
    const float* const rays =
        matrix(directions, "directions", static_cast<py::ssize_t>(count), 3);
    for (size_t ray = 0; ray < count; ++ray) {
        if (lengths[ray] > kFarthest_m) throw py::value_error("distances reach beyond 1 km");
    }
    const VoxelCube cube{static_cast<uint8_t*>(const_cast<void*>(flags.data())),
                         static_cast<int>(flags.shape(0)), voxel_m};
    const py::gil_scoped_release unlocked;
    mark_rays(cube, from, rays, lengths, count, truncation_m, along, at_end);
}

}  // namespace

void bind_observation(py::module_& module) {
    module.def("mark_rays", mark, py::arg("flags"), py::arg("origin"), py::arg("directions"),
               py::arg("distances"), py::kw_only(), py::arg("voxel_m"), py::arg("truncation_m"),
               py::arg("along"), py::arg("at_end"));
}

}  // namespace meslam
