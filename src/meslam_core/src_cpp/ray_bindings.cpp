// Training on rays and alignment of frames, for Python.
#include <string>

#include "bindings.hpp"

namespace meslam {
namespace {

py::tuple train_rays(FusedField& field, const RaySettings& settings, const py::array& origins,
                     const py::array& directions, const py::array& distances,
                     const py::array& colors, const py::array& along, const py::object& weights) {
    RayBatch batch{};
    batch.origins = matrix(origins, "origins", -1, 3);
    const py::ssize_t rays = origins.shape(0);
    batch.rays = static_cast<size_t>(rays);
    batch.directions = matrix(directions, "directions", rays, 3);
    batch.distances = flat(distances, "distances", batch.rays);
    batch.colors = matrix(colors, "colors", rays, 3);
    if (along.ndim() != 2 || along.shape(1) < 1 || along.shape(1) > 4096) {
        throw py::value_error("along has shape " + describe_shape(along) +
                              "; (N, samples) is expected, with 1 to 4096 samples");
    }
    batch.samples = static_cast<int>(along.shape(1));
    batch.along = matrix(along, "along", rays, along.shape(1));
    if (!weights.is_none()) {
        batch.weights = flat(py::cast<py::array>(weights), "weights", batch.rays);
    }
    Array losses = new_matrix(batch.rays, 3);
    Array grad_origins = new_matrix(batch.rays, 3);
    Array grad_directions = new_matrix(batch.rays, 3);
    float* const losses_to = losses.mutable_data();
    float* const origins_to = grad_origins.mutable_data();
    float* const directions_to = grad_directions.mutable_data();
    {
        const py::gil_scoped_release unlocked;
        field.train_rays(settings, batch, losses_to, origins_to, directions_to);
    }
    return py::make_tuple(losses, grad_origins, grad_directions);
}

SamplingSettings sampling_settings(int free_samples, int surface_samples, float surface_sigma) {
    if (free_samples < 0 || surface_samples < 0 || free_samples + surface_samples < 1 ||
        free_samples + surface_samples > 4096) {
        throw py::value_error("free_samples and surface_samples are " +
                              std::to_string(free_samples) + " and " +
                              std::to_string(surface_samples) + "; 1 to 4096 in all are expected");
    }
    return {free_samples, surface_samples, surface_sigma};
}

Array sampled_rays(const SamplingSettings& settings, uint64_t seed, const py::array& distances) {
    const size_t rays = distances.ndim() == 1 ? static_cast<size_t>(distances.shape(0)) : 0;
    const float* const from = flat(distances, "distances", rays);
    Array along = new_matrix(rays, settings.free_samples + settings.surface_samples);
    sample_rays(settings, seed, rays, from, along.mutable_data());
    return along;
}

const int64_t* pose_numbers(const py::array& array, size_t rays, py::ssize_t poses) {
    if (!py::isinstance<py::array_t<int64_t>>(array) || array.ndim() != 1 ||
        static_cast<size_t>(array.shape(0)) != rays || !(array.flags() & py::array::c_style)) {
        throw py::value_error("pose has dtype " + std::string(py::str(array.dtype())) +
                              " and shape " + describe_shape(array) + "; contiguous int64 (" +
                              std::to_string(rays) + ",) is expected");
    }
    const int64_t* const numbers = static_cast<const int64_t*>(array.data());
    for (size_t i = 0; i < rays; ++i) {
        if (numbers[i] < 0 || numbers[i] >= poses) {
            throw py::index_error("pose[" + std::to_string(i) + "] is " +
                                  std::to_string(numbers[i]) + ", but there are " +
                                  std::to_string(poses) + " poses");
        }
    }
    return numbers;
}

py::tuple train_posed_rays(FusedField& field, const RaySettings& settings,
                           const SamplingSettings& sampling, uint64_t seed,
                           const py::array& rotations, const py::array& translations,
                           const py::array& pose, const py::array& directions,
                           const py::array& distances, const py::array& colors,
                           const py::array& to_region, const py::object& weights) {
    PosedRays batch{};
    check_floats(rotations, "rotations");
    if (rotations.ndim() != 3 || rotations.shape(1) != 3 || rotations.shape(2) != 3) {
        throw py::value_error("rotations has shape " + describe_shape(rotations) +
                              "; (N, 3, 3) is expected");
    }
    batch.poses = static_cast<size_t>(rotations.shape(0));
    batch.rotations = static_cast<const float*>(rotations.data());
    batch.translations = matrix(translations, "translations", rotations.shape(0), 3);
    batch.directions = matrix(directions, "directions", -1, 3);
    batch.rays = static_cast<size_t>(directions.shape(0));
    batch.pose = pose_numbers(pose, batch.rays, rotations.shape(0));
    batch.distances = flat(distances, "distances", batch.rays);
    batch.colors = matrix(colors, "colors", directions.shape(0), 3);
    if (!weights.is_none()) {
        batch.weights = flat(py::cast<py::array>(weights), "weights", batch.rays);
    }
    const float* const affine = matrix(to_region, "to_region", 3, 4);
    for (int i = 0; i < 12; ++i) batch.to_region[i] = affine[i];
    Array losses = new_matrix(batch.rays, 3);
    Array grad_twists = new_matrix(batch.poses, 6);
    float* const losses_to = losses.mutable_data();
    float* const twists_to = grad_twists.mutable_data();
    {
        const py::gil_scoped_release unlocked;
        field.train_posed_rays(settings, sampling, seed, batch, losses_to, twists_to);
    }
    return py::make_tuple(losses, grad_twists);
}

py::tuple align(FusedField& field, const py::array& points, const py::array& arms,
                const py::array& luma, const py::array& weights,
                const py::array_t<double, py::array::c_style>& to_map, double surface_level,
                double saturation, double min_slope, double huber, double color_weight) {
    const float* const points_from = matrix(points, "points", -1, 3);
    AlignmentPoints measured{};
    measured.count = static_cast<size_t>(points.shape(0));
    measured.arms = matrix(arms, "arms", points.shape(0), 3);
    measured.luma = flat(luma, "luma", measured.count);
    measured.weights = flat(weights, "weights", measured.count);
    if (to_map.ndim() != 2 || to_map.shape(0) != 3 || to_map.shape(1) != 3) {
        throw py::value_error("to_map has shape " + describe_shape(to_map) +
                              "; (3, 3) is expected");
    }
    AlignmentSettings settings{{}, surface_level, saturation, min_slope, huber, color_weight};
    for (int i = 0; i < 9; ++i) settings.to_map[i] = to_map.data()[i];
    py::array_t<double> information({6, 6});
    py::array_t<double> gradient(6);
    Array distance(points.shape(0));
    py::array_t<bool> usable(points.shape(0));
    double* const information_to = information.mutable_data();
    double* const gradient_to = gradient.mutable_data();
    float* const distance_to = distance.mutable_data();
    bool* const usable_to = usable.mutable_data();
    {
        const py::gil_scoped_release unlocked;
        field.normal_equations(settings, points_from, measured, information_to, gradient_to,
                               distance_to, usable_to);
    }
    return py::make_tuple(information, gradient, distance, usable);
}

}  // namespace

void bind_rays(py::module_& module, py::class_<FusedField>& field) {
    py::class_<RaySettings>(module, "RaySettings")
        .def(py::init([](float density_scale, float truncation, float surface_offset,
                         float distance_weight, float depth_weight, float color_weight,
                         float depth_clip) {
                 return RaySettings{density_scale, truncation,   surface_offset, distance_weight,
                                    depth_weight,  color_weight, depth_clip};
             }),
             py::kw_only(), py::arg("density_scale"), py::arg("truncation"),
             py::arg("surface_offset"), py::arg("distance_weight"), py::arg("depth_weight"),
             py::arg("color_weight"), py::arg("depth_clip"));
    py::class_<SamplingSettings>(module, "SamplingSettings")
        .def(py::init(&sampling_settings), py::kw_only(), py::arg("free_samples"),
             py::arg("surface_samples"), py::arg("surface_sigma"));
    module.def("sample_rays", sampled_rays, py::arg("settings"), py::arg("seed"),
               py::arg("distances"));
    field
        .def("train_rays", train_rays, py::arg("settings"), py::arg("origins"),
             py::arg("directions"), py::arg("distances"), py::arg("colors"), py::arg("along"),
             py::arg("weights") = py::none())
        .def("train_posed_rays", train_posed_rays, py::arg("settings"), py::arg("sampling"),
             py::arg("seed"), py::arg("rotations"), py::arg("translations"), py::arg("pose"),
             py::arg("directions"), py::arg("distances"), py::arg("colors"), py::arg("to_region"),
             py::arg("weights") = py::none())
        .def("normal_equations", align, py::arg("points"), py::arg("arms"), py::arg("luma"),
             py::arg("weights"), py::kw_only(), py::arg("to_map"), py::arg("surface_level"),
             py::arg("saturation"), py::arg("min_slope"), py::arg("huber"),
             py::arg("color_weight"));
}

}  // namespace meslam
