// What the parts of the Python module share. Arrays are checked here, once; below, sizes fit.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <string>

#include "fused_field.hpp"

namespace py = pybind11;

namespace meslam {

using Array = py::array_t<float>;

inline std::string describe_shape(const py::array& array) {
    std::string text = "(";
    for (py::ssize_t axis = 0; axis < array.ndim(); ++axis) {
        if (axis > 0) text += ", ";
        text += std::to_string(array.shape(axis));
    }
    return text + ")";
}

inline void check_floats(const py::array& array, const char* name) {
    if (!py::isinstance<py::array_t<float>>(array)) {
        throw py::type_error(std::string(name) + " has dtype " +
                             std::string(py::str(array.dtype())) + "; float32 is expected");
    }
    if (!(array.flags() & py::array::c_style)) {
        throw py::value_error(std::string(name) +
                              " is not C-contiguous; pass numpy.ascontiguousarray of it");
    }
}

// The numbers of an array of shape (rows, columns); any number of rows where rows is negative.
inline const float* matrix(const py::array& array, const char* name, py::ssize_t rows,
                           py::ssize_t columns) {
    check_floats(array, name);
    if (array.ndim() != 2 || array.shape(1) != columns || (rows >= 0 && array.shape(0) != rows)) {
        const std::string expected = rows < 0 ? "N" : std::to_string(rows);
        throw py::value_error(std::string(name) + " has shape " + describe_shape(array) + "; (" +
                              expected + ", " + std::to_string(columns) + ") is expected");
    }
    return static_cast<const float*>(array.data());
}

inline const float* flat(const py::array& array, const char* name, size_t count) {
    check_floats(array, name);
    if (array.ndim() != 1 || static_cast<size_t>(array.shape(0)) != count) {
        throw py::value_error(std::string(name) + " has shape " + describe_shape(array) + "; (" +
                              std::to_string(count) + ",) is expected");
    }
    return static_cast<const float*>(array.data());
}

inline Array new_matrix(size_t rows, py::ssize_t columns) {
    return Array({static_cast<py::ssize_t>(rows), columns});
}

// Adds the alignment of RGB-D images.
void bind_rgbd(py::module_& module);

// Adds the marking of what rays have seen.
void bind_observation(py::module_& module);

// Adds the shading of simulated views.
void bind_textures(py::module_& module);

// Adds the training on rays and the alignment of frames.
void bind_rays(py::module_& module, py::class_<FusedField>& field);

}  // namespace meslam
