#include "rgbd_alignment.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <utility>

// One function for each instruction set, chosen when the library is loaded.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define MESLAM_CLONES __attribute__((target_clones("arch=skylake-avx512", "arch=haswell", "default")))
#else
#define MESLAM_CLONES
#endif
#define MESLAM_FORCED inline __attribute__((always_inline))

namespace meslam {
namespace {

constexpr int kTexel = 8;
constexpr int kBlock = 128;
constexpr int kLanes = 16;
// Six of the motion, then gain and offset of the light.
constexpr int kUnknowns = 8;
constexpr int kProducts = kUnknowns * (kUnknowns + 1) / 2;
constexpr float kFreedom = 5.0f;
constexpr float kFirstLumaSigma = 0.05f;
// Luma differences below this are noise.
constexpr float kSameLight = 0.08f;
constexpr float kMinLumaSigma = 0.004f;
constexpr float kMinDepthScale = 0.25f;
// Keeps gain and offset where the image has no contrast to tell them.
constexpr double kLightPrior = 1e3;

typedef float Lanes __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));
typedef float Texel __attribute__((vector_size(4 * kTexel), aligned(4), may_alias));

// What depth cameras err by: a floor, and an error that grows with the square of the distance.
MESLAM_FORCED float depth_noise(float z) { return 0.002f + 0.0025f * z * z; }

struct System {
    double products[kProducts];
    double gradient[kUnknowns];
};

struct Sums {
    System luma, depth;
    double luma_squares, luma_weight;
    double depth_squares, depth_weight;
    double in_view, same_light, visible, inliers, squared_distance;
};

struct Motion {
    float r[9], t[3];
};

struct Scales {
    float luma, depth, gain, offset, max_distance;
};

// Rows of a block: derivatives and residuals, each already times the root of its weight.
struct Rows {
    float luma[kUnknowns + 1][kBlock];
    float depth[7][kBlock];
};

template <int kColumns>
MESLAM_FORCED void add_products(const float (*rows)[kBlock], System& sums) {
    // The last row is the residual.
    for (int i = 0; i < kColumns; ++i) {
        for (int j = i; j <= kColumns; ++j) {
            Lanes total = {};
            for (int n = 0; n < kBlock; n += kLanes) {
                total += *reinterpret_cast<const Lanes*>(rows[i] + n) *
                         *reinterpret_cast<const Lanes*>(rows[j] + n);
            }
            float sum = 0.0f;
            for (int lane = 0; lane < kLanes; ++lane) sum += total[lane];
            if (j == kColumns) {
                sums.gradient[i] += sum;
            } else {
                sums.products[i * kUnknowns - i * (i - 1) / 2 + j - i] += sum;
            }
        }
    }
}

MESLAM_CLONES
void accumulate(const RgbdLevel& source, const RgbdLevel& target, const Motion& motion,
                const Scales& scales, Sums& sums) {
    std::memset(&sums, 0, sizeof sums);
    const size_t count = source.z.size();
    const Intrinsics camera = target.camera;
    const float limit_u = static_cast<float>(target.width - 1);
    const float limit_v = static_cast<float>(target.height - 1);
    const int width = target.width;
    const float* const texels = target.texels.data();
    alignas(64) Rows rows;
    alignas(64) float x[kBlock], y[kBlock], z[kBlock], u[kBlock], v[kBlock], light[kBlock];
    alignas(64) float looked_up[kBlock][kTexel];
    for (size_t begin = 0; begin < count; begin += kBlock) {
        const int size = static_cast<int>(std::min<size_t>(kBlock, count - begin));
        const float* const px = source.x.data() + begin;
        const float* const py = source.y.data() + begin;
        const float* const pz = source.z.data() + begin;
        const float* const pl = source.point_luma.data() + begin;
        for (int n = 0; n < size; ++n) {
            x[n] = motion.r[0] * px[n] + motion.r[1] * py[n] + motion.r[2] * pz[n] + motion.t[0];
            y[n] = motion.r[3] * px[n] + motion.r[4] * py[n] + motion.r[5] * pz[n] + motion.t[1];
            z[n] = motion.r[6] * px[n] + motion.r[7] * py[n] + motion.r[8] * pz[n] + motion.t[2];
            const float inverse = z[n] > 0.05f ? 1.0f / z[n] : 0.0f;
            u[n] = z[n] > 0.05f ? camera.fx * x[n] * inverse + camera.cx : -1.0f;
            v[n] = camera.fy * y[n] * inverse + camera.cy;
            light[n] = pl[n];
        }
        int kept = 0;
        for (int n = 0; n < size; ++n) {
            if (!(u[n] >= 0.0f && u[n] < limit_u && v[n] >= 0.0f && v[n] < limit_v)) continue;
            const int column = static_cast<int>(u[n]), row = static_cast<int>(v[n]);
            const float right = u[n] - column, down = v[n] - row;
            const float* const corner = texels + (static_cast<size_t>(row) * width + column) * kTexel;
            const float* const below = corner + static_cast<size_t>(width) * kTexel;
            const Texel upper = *reinterpret_cast<const Texel*>(corner) * (1.0f - right) +
                                *reinterpret_cast<const Texel*>(corner + kTexel) * right;
            const Texel lower = *reinterpret_cast<const Texel*>(below) * (1.0f - right) +
                                *reinterpret_cast<const Texel*>(below + kTexel) * right;
            *reinterpret_cast<Texel*>(looked_up[kept]) = upper * (1.0f - down) + lower * down;
            x[kept] = x[n];
            y[kept] = y[n];
            z[kept] = z[n];
            light[kept] = light[n];
            ++kept;
        }
        float luma_squares = 0.0f, luma_weights = 0.0f, depth_squares = 0.0f, depth_weights = 0.0f;
        float same_light = 0.0f, inliers = 0.0f, visible = 0.0f, squared_distance = 0.0f;
        for (int n = 0; n < kept; ++n) {
            const float* const texel = looked_up[n];
            const float inverse = 1.0f / z[n];
            const bool valid = texel[7] > 0.999f;
            const float gap = z[n] - texel[3];
            const bool near = valid && std::fabs(gap) < scales.max_distance;
            visible += valid ? 1.0f : 0.0f;
            inliers += near ? 1.0f : 0.0f;
            squared_distance += near ? gap * gap : 0.0f;
            // A point hidden behind another surface, or before it, shows another colour there.
            const bool lit = near || !valid;
            const float difference = texel[0] - (scales.gain * light[n] + scales.offset);
            const float scaled = difference / scales.luma;
            const float luma_weight = lit ? (kFreedom + 1.0f) / (kFreedom + scaled * scaled) : 0.0f;
            luma_squares += luma_weight * difference * difference;
            same_light += std::fabs(difference) < kSameLight ? 1.0f : 0.0f;
            luma_weights += lit ? 1.0f : 0.0f;
            const float root = std::sqrt(luma_weight) / scales.luma;
            const float gx = root * texel[1] * camera.fx * inverse;
            const float gy = root * texel[2] * camera.fy * inverse;
            const float gz = -(gx * x[n] + gy * y[n]) * inverse;
            rows.luma[0][n] = gx;
            rows.luma[1][n] = gy;
            rows.luma[2][n] = gz;
            rows.luma[3][n] = y[n] * gz - z[n] * gy;
            rows.luma[4][n] = z[n] * gx - x[n] * gz;
            rows.luma[5][n] = x[n] * gy - y[n] * gx;
            rows.luma[6][n] = -root * light[n];
            rows.luma[7][n] = -root;
            rows.luma[8][n] = root * difference;

            const float* const normal = texel + 4;
            // Point and surface lie on one viewing ray; normals point at the camera.
            const float ray = (normal[0] * x[n] + normal[1] * y[n] + normal[2] * z[n]) * inverse;
            const float noise = depth_noise(z[n]);
            const float distance = ray * gap / noise;
            const float whitened = distance / scales.depth;
            const float depth_weight =
                near ? (kFreedom + 1.0f) / (kFreedom + whitened * whitened) : 0.0f;
            depth_squares += depth_weight * distance * distance;
            depth_weights += near ? 1.0f : 0.0f;
            const float scale = near ? std::sqrt(depth_weight) / (scales.depth * noise) : 0.0f;
            const float nx = scale * normal[0], ny = scale * normal[1], nz = scale * normal[2];
            rows.depth[0][n] = nx;
            rows.depth[1][n] = ny;
            rows.depth[2][n] = nz;
            rows.depth[3][n] = y[n] * nz - z[n] * ny;
            rows.depth[4][n] = z[n] * nx - x[n] * nz;
            rows.depth[5][n] = x[n] * ny - y[n] * nx;
            rows.depth[6][n] = near ? scale * ray * gap : 0.0f;
        }
        for (int n = kept; n < kBlock; ++n) {
            for (auto& row : rows.luma) row[n] = 0.0f;
            for (auto& row : rows.depth) row[n] = 0.0f;
        }
        add_products<kUnknowns>(rows.luma, sums.luma);
        add_products<6>(rows.depth, sums.depth);
        sums.luma_squares += luma_squares;
        sums.luma_weight += luma_weights;
        sums.depth_squares += depth_squares;
        sums.depth_weight += depth_weights;
        sums.in_view += kept;
        sums.same_light += same_light;
        sums.inliers += inliers;
        sums.visible += visible;
        sums.squared_distance += squared_distance;
    }
}

using Matrix6 = std::array<std::array<double, 6>, 6>;
using Vector6 = std::array<double, 6>;

// A motion's normal equations: information and gradient of half the squared residuals.
struct Equations {
    Matrix6 information{};
    Vector6 gradient{};
};

// Solves a x = b by elimination with pivots, in place: b becomes x. False where a is singular.
template <size_t kSize, size_t kColumns>
bool eliminate(std::array<std::array<double, kSize>, kSize>& a,
               std::array<std::array<double, kColumns>, kSize>& b) {
    for (size_t i = 0; i < kSize; ++i) {
        size_t pivot = i;
        for (size_t k = i + 1; k < kSize; ++k) {
            if (std::fabs(a[k][i]) > std::fabs(a[pivot][i])) pivot = k;
        }
        if (!(std::fabs(a[pivot][i]) > 0.0)) return false;
        std::swap(a[i], a[pivot]);
        std::swap(b[i], b[pivot]);
        for (size_t k = 0; k < kSize; ++k) {
            if (k == i) continue;
            const double factor = a[k][i] / a[i][i];
            for (size_t j = i; j < kSize; ++j) a[k][j] -= factor * a[i][j];
            for (size_t j = 0; j < kColumns; ++j) b[k][j] -= factor * b[i][j];
        }
    }
    for (size_t i = 0; i < kSize; ++i) {
        for (double& value : b[i]) value /= a[i][i];
    }
    return true;
}

double product(const System& system, int i, int j) {
    if (i > j) std::swap(i, j);
    return system.products[i * kUnknowns - i * (i - 1) / 2 + j - i];
}

Equations equations_of(const System& system) {
    Equations equations;
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) equations.information[i][j] = product(system, i, j);
        equations.gradient[i] = system.gradient[i];
    }
    return equations;
}

// Gain and offset of the light for a motion of `step`, from the last two rows.
void solve_light(const System& system, const Vector6& step, double* light) {
    std::array<std::array<double, 2>, 2> a;
    std::array<std::array<double, 1>, 2> b;
    for (int i = 0; i < 2; ++i) {
        for (int j = 0; j < 2; ++j) a[i][j] = product(system, 6 + i, 6 + j);
        a[i][i] += kLightPrior;
        b[i][0] = -system.gradient[6 + i];
        for (int j = 0; j < 6; ++j) b[i][0] -= product(system, 6 + i, j) * step[j];
    }
    eliminate(a, b);
    light[0] = b[0][0];
    light[1] = b[1][0];
}

// The same for the motion alone, with gain and offset of the light taken out.
Equations without_light(const System& system) {
    Equations equations = equations_of(system);
    std::array<std::array<double, 2>, 2> a;
    std::array<std::array<double, 7>, 2> b;
    for (int i = 0; i < 2; ++i) {
        for (int j = 0; j < 2; ++j) a[i][j] = product(system, 6 + i, 6 + j);
        a[i][i] += kLightPrior;
        for (int j = 0; j < 6; ++j) b[i][j] = product(system, 6 + i, j);
        b[i][6] = system.gradient[6 + i];
    }
    if (!eliminate(a, b)) return equations;
    for (int i = 0; i < 6; ++i) {
        for (int k = 0; k < 2; ++k) {
            const double coupling = product(system, i, 6 + k);
            for (int j = 0; j < 6; ++j) equations.information[i][j] -= coupling * b[k][j];
            equations.gradient[i] -= coupling * b[k][6];
        }
    }
    return equations;
}

// The equations of an estimate that may be off by `bias` besides: (1 + information C)^-1 of both
// sides, with C the variances of the bias.
Equations with_bias(const Equations& equations, const RgbdAlignmentSettings& settings) {
    Matrix6 a{};
    std::array<std::array<double, 7>, 6> b;
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) {
            const double bias = j < 3 ? settings.luma_bias_m : settings.luma_bias_rad;
            a[i][j] = (i == j ? 1.0 : 0.0) + equations.information[i][j] * bias * bias;
            b[i][j] = equations.information[i][j];
        }
        b[i][6] = equations.gradient[i];
    }
    if (!eliminate(a, b)) return equations;
    Equations biased;
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) biased.information[i][j] = 0.5 * (b[i][j] + b[j][i]);
        biased.gradient[i] = b[i][6];
    }
    return biased;
}

Equations combined(const Sums& sums, const RgbdAlignmentSettings& settings) {
    Equations luma = without_light(sums.luma);
    Equations depth = equations_of(sums.depth);
    const double share = 1.0 / settings.correlated;
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) luma.information[i][j] *= share;
        luma.gradient[i] *= share;
    }
    luma = with_bias(luma, settings);
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) {
            luma.information[i][j] += share * depth.information[i][j];
        }
        luma.gradient[i] += share * depth.gradient[i];
    }
    return luma;
}

bool solve(const Equations& equations, Vector6& step) {
    Matrix6 a = equations.information;
    std::array<std::array<double, 1>, 6> b;
    for (int i = 0; i < 6; ++i) {
        a[i][i] = a[i][i] * (1.0 + 1e-6) + 1e-9;
        b[i][0] = -equations.gradient[i];
    }
    if (!eliminate(a, b)) return false;
    for (int i = 0; i < 6; ++i) step[i] = b[i][0];
    return std::all_of(step.begin(), step.end(), [](double x) { return std::isfinite(x); });
}

// pose <- exp(step) pose, for a step of (translation, rotation).
void apply(const Vector6& step, double* pose) {
    const double* const w = step.data() + 3;
    const double angle = std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    const double a = angle < 1e-9 ? 1.0 : std::sin(angle) / angle;
    const double b = angle < 1e-9 ? 0.5 : (1.0 - std::cos(angle)) / (angle * angle);
    double r[9];
    const double cross[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            double square = 0.0;
            for (int k = 0; k < 3; ++k) square += cross[3 * i + k] * cross[3 * k + j];
            r[3 * i + j] = (i == j ? 1.0 : 0.0) + a * cross[3 * i + j] + b * square;
        }
    }
    double moved[12];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 4; ++j) {
            moved[4 * i + j] = j == 3 ? step[i] : 0.0;
            for (int k = 0; k < 3; ++k) moved[4 * i + j] += r[3 * i + k] * pose[4 * k + j];
        }
    }
    std::copy(moved, moved + 12, pose);
}

}  // namespace

RgbdAlignment align_rgbd(const RgbdPyramid& source, const RgbdPyramid& target, const double* pose,
                         const RgbdAlignmentSettings& settings) {
    RgbdAlignment result{};
    std::copy(pose, pose + 16, result.pose);
    Scales scales{kFirstLumaSigma, 1.0f, 1.0f, 0.0f, 0.0f};
    const size_t shared = std::min(source.levels().size(), target.levels().size());
    const int last = static_cast<int>(std::min<size_t>(settings.levels, shared)) - 1;
    const int finest = std::min(settings.finest, last);
    Sums sums{};
    Equations equations;
    for (int number = last; number >= finest; --number) {
        const RgbdLevel& from = source.levels()[number];
        const RgbdLevel& to = target.levels()[number];
        scales.max_distance = settings.max_distance * (1.0f + 0.5f * number);
        for (int iteration = 0; iteration < settings.iterations; ++iteration) {
            Motion motion;
            for (int i = 0; i < 3; ++i) {
                for (int j = 0; j < 3; ++j) {
                    motion.r[3 * i + j] = static_cast<float>(result.pose[4 * i + j]);
                }
                motion.t[i] = static_cast<float>(result.pose[4 * i + 3]);
            }
            accumulate(from, to, motion, scales, sums);
            ++result.iterations;
            if (sums.luma_weight > 0.0) {
                scales.luma = std::max<float>(
                    kMinLumaSigma, std::sqrt(sums.luma_squares / sums.luma_weight));
            }
            if (sums.depth_weight > 0.0) {
                scales.depth = std::max<float>(
                    kMinDepthScale, std::sqrt(sums.depth_squares / sums.depth_weight));
            }
            equations = combined(sums, settings);
            Vector6 step;
            if (!solve(equations, step)) break;
            apply(step, result.pose);
            double light[2];
            solve_light(sums.luma, step, light);
            scales.gain += static_cast<float>(light[0]);
            scales.offset += static_cast<float>(light[1]);
            double length = 0.0, turn = 0.0;
            for (int i = 0; i < 3; ++i) {
                length += step[i] * step[i];
                turn += step[3 + i] * step[3 + i];
            }
            if (std::sqrt(length) + std::sqrt(turn) < settings.convergence * static_cast<float>(1 << number)) {
                break;
            }
        }
    }
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) result.information[6 * i + j] = equations.information[i][j];
    }
    result.inliers = sums.inliers;
    result.visible = sums.visible;
    result.in_view = sums.in_view;
    result.same_light = sums.same_light;
    result.squared_distance = sums.squared_distance;
    result.points = static_cast<double>(source.levels()[finest].z.size());
    result.luma_sigma = scales.luma;
    result.depth_scale = scales.depth;
    return result;
}

}  // namespace meslam
