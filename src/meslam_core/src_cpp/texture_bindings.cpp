// What views of simulated scenes are made of, for Python.
#include <algorithm>
#include <cmath>
#include <string>

#include "bindings.hpp"
#include "rasterizer.hpp"
#include "texture_lookup.hpp"

namespace meslam {
namespace {

constexpr py::ssize_t kMaxSide = 1 << 17;

TextureAtlas texture_atlas(const py::array& image, const py::array& levels) {
    if (!py::isinstance<py::array_t<uint8_t>>(image) || image.ndim() != 3 || image.shape(2) != 3 ||
        image.shape(0) < 2 || image.shape(1) < 3 ||
        std::max(image.shape(0), image.shape(1)) > kMaxSide ||
        !(image.flags() & py::array::c_style)) {
        throw py::value_error("image has dtype " + std::string(py::str(image.dtype())) +
                              " and shape " + describe_shape(image) +
                              "; contiguous uint8 (height, width, 3) is expected");
    }
    const float* const table = matrix(levels, "levels", 3, levels.ndim() == 2 ? levels.shape(1) : 2);
    const int count = static_cast<int>(levels.shape(1));
    if (count < 2 || count > 16) throw py::value_error("2 to 16 levels are expected");
    return {static_cast<const uint8_t*>(image.data()),
            static_cast<int>(image.shape(1)),
            static_cast<int>(image.shape(0)),
            table,
            table + count,
            table + 2 * count,
            count};
}

Array shaded(const py::array& image, const py::array& levels, const py::array& texels,
             const py::array& distance, const py::array& triangle, const py::array& shares,
             const py::array& cosine, float focal_px) {
    const TextureAtlas atlas = texture_atlas(image, levels);
    const float* const rows = matrix(texels, "texels", -1, TriangleTexels::kColumns);
    const size_t triangles = static_cast<size_t>(texels.shape(0));
    const size_t count = static_cast<size_t>(distance.size());
    if (!py::isinstance<py::array_t<uint32_t>>(triangle) || triangle.ndim() != 1 ||
        static_cast<size_t>(triangle.size()) != count || !(triangle.flags() & py::array::c_style)) {
        throw py::value_error("triangle has dtype " + std::string(py::str(triangle.dtype())) +
                              " and shape " + describe_shape(triangle) +
                              "; contiguous uint32, one a ray, is expected");
    }
    if (!(focal_px > 0.0f)) throw py::value_error("focal_px must be positive");
    const RayHits hits{flat(distance, "distance", count),
                       static_cast<const uint32_t*>(triangle.data()),
                       matrix(shares, "shares", distance.size(), 2), flat(cosine, "cosine", count),
                       count};
    Array color = new_matrix(count, 3);
    float* const to = color.mutable_data();
    const py::gil_scoped_release unlocked;
    for (size_t ray = 0; ray < count; ++ray) {
        if (std::isfinite(hits.distance[ray]) && hits.triangle[ray] >= triangles) {
            const py::gil_scoped_acquire locked;
            throw py::value_error("a ray ends on triangle " + std::to_string(hits.triangle[ray]) +
                                  "; there are " + std::to_string(triangles));
        }
    }
    shade(atlas, {rows, triangles}, hits, focal_px, to);
    return color;
}

py::tuple seen_triangles(
    const py::array_t<double, py::array::c_style | py::array::forcecast>& corners, int width,
    int height, double fx, double fy, double cx, double cy) {
    if (corners.ndim() != 3 || corners.shape(1) != 3 || corners.shape(2) != 3) {
        throw py::value_error("corners has shape " + describe_shape(corners) +
                              "; (triangles, 3, 3) is expected");
    }
    if (width < 1 || height < 1 || std::max(width, height) > kMaxSide / 8) {
        throw py::value_error("width and height must be 1 to 16384");
    }
    if (!(fx > 0.0 && fy > 0.0)) throw py::value_error("fx and fy must be positive");
    const py::ssize_t pixels = static_cast<py::ssize_t>(width) * height;
    Array depth(pixels), cosine(pixels), shares = new_matrix(static_cast<size_t>(pixels), 2);
    py::array_t<uint32_t> triangle(pixels);
    const Visible visible{depth.mutable_data(), triangle.mutable_data(), shares.mutable_data(),
                          cosine.mutable_data()};
    {
        const py::gil_scoped_release unlocked;
        rasterize({width, height, fx, fy, cx, cy}, corners.data(),
                  static_cast<size_t>(corners.shape(0)), visible);
    }
    return py::make_tuple(depth, triangle, shares, cosine);
}

}  // namespace

void bind_textures(py::module_& module) {
    module.def("seen_triangles", seen_triangles, py::arg("corners"), py::kw_only(),
               py::arg("width"), py::arg("height"), py::arg("fx"), py::arg("fy"), py::arg("cx"),
               py::arg("cy"));
    module.def("shade", shaded, py::arg("image"), py::arg("levels"), py::arg("texels"),
               py::arg("distance"), py::arg("triangle"), py::arg("shares"), py::arg("cosine"),
               py::arg("focal_px"));
}

}  // namespace meslam
