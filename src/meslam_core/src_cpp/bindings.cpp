// The Python module meslam_core.field._kernel: a field's parameters, values and gradients.
#include "bindings.hpp"

#include <pybind11/stl.h>

#include <string>
#include <vector>

#include "cpu_features.hpp"

namespace meslam {
namespace {

Array new_parameters(const FusedField& field) {
    return Array(static_cast<py::ssize_t>(field.shape().parameters));
}

Array forward(FusedField& field, const py::array& points) {
    const float* const from = matrix(points, "points", -1, 3);
    const size_t count = static_cast<size_t>(points.shape(0));
    Array values = new_matrix(count, 4);
    float* const to = values.mutable_data();
    const py::gil_scoped_release unlocked;
    field.forward(from, count, to);
    return values;
}

py::tuple forward_with_gradient(FusedField& field, const py::array& points, bool luma) {
    const float* const from = matrix(points, "points", -1, 3);
    const size_t count = static_cast<size_t>(points.shape(0));
    Array values = new_matrix(count, 4);
    Array grad_distance = new_matrix(count, 3);
    py::object grad_luma = py::none();
    float* luma_to = nullptr;
    if (luma) {
        Array array = new_matrix(count, 3);
        luma_to = array.mutable_data();
        grad_luma = array;
    }
    float* const values_to = values.mutable_data();
    float* const distance_to = grad_distance.mutable_data();
    {
        const py::gil_scoped_release unlocked;
        field.forward_with_gradient(from, count, values_to, distance_to, luma_to);
    }
    return py::make_tuple(values, grad_distance, grad_luma);
}

py::object backward(FusedField& field, const py::array& points, const py::array& grad_values,
                    bool want_points) {
    const float* const from = matrix(points, "points", -1, 3);
    const size_t count = static_cast<size_t>(points.shape(0));
    const float* const gradient = matrix(grad_values, "grad_values", points.shape(0), 4);
    py::object result = py::none();
    float* to = nullptr;
    if (want_points) {
        Array grad_points = new_matrix(count, 3);
        to = grad_points.mutable_data();
        result = grad_points;
    }
    const py::gil_scoped_release unlocked;
    field.backward(from, count, gradient, to);
    return result;
}

template <auto kGet>
Array get_flat(FusedField& field) {
    Array array = new_parameters(field);
    float* const to = array.mutable_data();
    const py::gil_scoped_release unlocked;
    (field.*kGet)(to);
    return array;
}

void set_parameters(FusedField& field, const py::array& array) {
    const float* const from = flat(array, "parameters", field.shape().parameters);
    const py::gil_scoped_release unlocked;
    field.set_parameters(from);
}

py::tuple optimizer_state(FusedField& field) {
    Array first = new_parameters(field);
    Array second = new_parameters(field);
    float* const first_to = first.mutable_data();
    float* const second_to = second.mutable_data();
    long step = 0;
    {
        const py::gil_scoped_release unlocked;
        field.get_optimizer(first_to, second_to, step);
    }
    return py::make_tuple(first, second, step);
}

void set_optimizer_state(FusedField& field, const py::array& first, const py::array& second,
                         long step) {
    const size_t count = field.shape().parameters;
    const float* const first_from = flat(first, "first_moment", count);
    const float* const second_from = flat(second, "second_moment", count);
    const py::gil_scoped_release unlocked;
    field.set_optimizer(first_from, second_from, step);
}

bool adam_step(FusedField& field, float learning_rate, float beta1, float beta2, float epsilon,
               float encoding_scale, float average_share) {
    const py::gil_scoped_release unlocked;
    return field.adam_step(
        {learning_rate, beta1, beta2, epsilon, encoding_scale, average_share});
}

std::vector<std::string> available_isas() {
    std::vector<std::string> names;
    for (const Backend* backend : available_backends()) names.emplace_back(backend->name);
    return names;
}

}  // namespace

PYBIND11_MODULE(_kernel, module) {
    module.doc() = "Fused evaluation and training of a region's neural field.";
    module.def("available_isas", available_isas, "Instruction sets usable here, the best first.");
    using Free = py::call_guard<py::gil_scoped_release>;
    py::class_<FusedField> field(module, "FusedField");
    field
        .def(py::init<int, int, const std::string&, int>(), py::arg("width"), py::arg("embedding"),
             py::arg("isa") = "auto", py::arg("threads") = 1)
        .def_property_readonly("width", [](const FusedField& f) { return f.shape().width; })
        .def_property_readonly("embedding", [](const FusedField& f) { return f.shape().embedding; })
        .def_property_readonly("isa", &FusedField::isa)
        .def_property_readonly("threads", &FusedField::threads)
        .def_property_readonly("parameter_count",
                               [](const FusedField& f) { return f.shape().parameters; })
        .def("parameters", get_flat<&FusedField::get_parameters>)
        .def("average", get_flat<&FusedField::get_average>)
        .def("set_parameters", set_parameters, py::arg("parameters"))
        .def("gradients", get_flat<&FusedField::get_gradients>)
        .def("zero_gradients", &FusedField::zero_gradients, Free())
        .def("optimizer_state", optimizer_state)
        .def("set_optimizer_state", set_optimizer_state, py::arg("first_moment"),
             py::arg("second_moment"), py::arg("step"))
        .def("reset_optimizer", &FusedField::reset_optimizer, Free())
        .def("forward", forward, py::arg("points"))
        .def("forward_with_gradient", forward_with_gradient, py::arg("points"),
             py::arg("luma") = true)
        .def("backward", backward, py::arg("points"), py::arg("grad_values"),
             py::arg("want_points") = true)
        .def("adam_step", adam_step, py::arg("learning_rate"), py::arg("beta1") = 0.9f,
             py::arg("beta2") = 0.99f, py::arg("epsilon") = 1e-8f,
             py::arg("encoding_scale") = 1.0f, py::arg("average_share") = 1.0f);
    bind_rays(module, field);
    bind_rgbd(module);
    bind_observation(module);
    bind_textures(module);
}

}  // namespace meslam
