#include "fused_field.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "cpu_features.hpp"
#include "denormals.hpp"

namespace meslam {
namespace {

using Lock = std::lock_guard<std::mutex>;

// Rec. 601 luma of the three colours after the sigmoid.
constexpr float kLuma[3] = {0.299f, 0.587f, 0.114f};

void copy(const float* from, size_t count, float* to) { std::copy(from, from + count, to); }

// points (rays * samples,3) of the rays from `first` on.
void place_samples(const RayBatch& batch, size_t first, int rays, float* points) {
    for (size_t ray = first; ray < first + rays; ++ray) {
        const float* const along = batch.along + ray * batch.samples;
        for (int i = 0; i < batch.samples; ++i, points += 3) {
            for (int axis = 0; axis < 3; ++axis) {
                points[axis] =
                    batch.origins[3 * ray + axis] + along[i] * batch.directions[3 * ray + axis];
            }
        }
    }
}

// The way back: gradients of the points to gradients of the rays.
void gather_rays(const RayBatch& batch, size_t first, int rays, const float* grad_points,
                 float* grad_origins, float* grad_directions) {
    for (size_t ray = first; ray < first + rays; ++ray) {
        const float* const along = batch.along + ray * batch.samples;
        float origin[3] = {}, direction[3] = {};
        for (int i = 0; i < batch.samples; ++i, grad_points += 3) {
            for (int axis = 0; axis < 3; ++axis) {
                origin[axis] += grad_points[axis];
                direction[axis] += along[i] * grad_points[axis];
            }
        }
        copy(origin, 3, grad_origins + 3 * ray);
        copy(direction, 3, grad_directions + 3 * ray);
    }
}

}  // namespace

FusedField::FusedField(int width, int embedding, const std::string& isa, int threads)
    : backend_(find_backend(isa)), shape_(make_network_shape(width, embedding)), pool_(threads) {
    if (threads < 1 || threads > 64) {
        throw std::invalid_argument("threads is " + std::to_string(threads) +
                                    "; it may be from 1 to 64");
    }
    parameters_ = AlignedArray<float>(shape_.parameters);
    average_ = AlignedArray<float>(shape_.parameters);
    gradients_ = AlignedArray<float>(shape_.parameters);
    first_moment_ = AlignedArray<float>(shape_.parameters);
    second_moment_ = AlignedArray<float>(shape_.parameters);
    packed_ = AlignedArray<char>(backend_->packed_bytes(shape_));
    for (int i = 0; i < threads; ++i) {
        workspaces_.emplace_back(backend_->workspace_bytes(shape_));
        accumulators_.emplace_back(backend_->accumulator_floats(shape_));
    }
    backend_->pack(shape_, parameters_.data(), packed_.data());
}

void FusedField::get_parameters(float* to) const {
    const Lock lock(mutex_);
    copy(parameters_.data(), shape_.parameters, to);
}

void FusedField::get_average(float* to) const {
    const Lock lock(mutex_);
    copy(average_.data(), shape_.parameters, to);
}

void FusedField::set_parameters(const float* from) {
    const Lock lock(mutex_);
    if (!backend_->all_finite(from, shape_.parameters)) {
        throw std::invalid_argument("the parameters contain numbers that are not finite");
    }
    copy(from, shape_.parameters, parameters_.data());
    copy(from, shape_.parameters, average_.data());
    backend_->pack(shape_, parameters_.data(), packed_.data());
}

void FusedField::get_gradients(float* to) {
    const Lock lock(mutex_);
    collect_gradients();
    copy(gradients_.data(), shape_.parameters, to);
}

void FusedField::zero_gradients() {
    const Lock lock(mutex_);
    collect_gradients();
    std::fill_n(gradients_.data(), shape_.parameters, 0.0f);
}

void FusedField::get_optimizer(float* first_moment, float* second_moment, long& step) const {
    const Lock lock(mutex_);
    copy(first_moment_.data(), shape_.parameters, first_moment);
    copy(second_moment_.data(), shape_.parameters, second_moment);
    step = step_;
}

void FusedField::set_optimizer(const float* first_moment, const float* second_moment, long step) {
    const Lock lock(mutex_);
    if (step < 0) throw std::invalid_argument("the optimiser's step count is negative");
    if (!backend_->all_finite(first_moment, shape_.parameters) ||
        !backend_->all_finite(second_moment, shape_.parameters)) {
        throw std::invalid_argument("the optimiser's moments contain numbers that are not finite");
    }
    copy(first_moment, shape_.parameters, first_moment_.data());
    copy(second_moment, shape_.parameters, second_moment_.data());
    step_ = step;
}

void FusedField::reset_optimizer() {
    const Lock lock(mutex_);
    std::fill_n(first_moment_.data(), shape_.parameters, 0.0f);
    std::fill_n(second_moment_.data(), shape_.parameters, 0.0f);
    step_ = 0;
}

// task(thread, first, number) for blocks of at most `block` items. Each thread has a fixed range of
// blocks, so that the order of its sums does not depend on timing.
void FusedField::for_each_block(size_t count, size_t block,
                                const std::function<void(int, size_t, int)>& task) {
    const size_t blocks = (count + block - 1) / block;
    const size_t threads = static_cast<size_t>(pool_.threads());
    const auto work = [&](int thread) {
        const size_t begin = blocks * thread / threads;
        const size_t end = blocks * (thread + 1) / threads;
        if (begin == end) return;
        const FlushDenormals flush;
        alignas(64) char saved_state[kSavedStateBytes];
        backend_->enter(saved_state);
        for (size_t i = begin; i < end; ++i) {
            task(thread, i * block, static_cast<int>(std::min(block, count - i * block)));
        }
        backend_->leave(saved_state);
    };
    if (blocks < 2) {
        work(static_cast<int>(threads) - 1);
    } else {
        pool_.run(work);
    }
}

void FusedField::forward(const float* points, size_t count, float* values) {
    const Lock lock(mutex_);
    for_each_block(count, backend_->block, [&](int thread, size_t first, int samples) {
        backend_->forward(shape_, packed_.data(), workspaces_[thread].data(), points + 3 * first,
                          samples, Keep::kNothing, values + 4 * first);
    });
}

void FusedField::forward_with_gradient(const float* points, size_t count, float* values,
                                       float* grad_distance, float* grad_luma) {
    const Lock lock(mutex_);
    evaluate_with_gradient(points, count, values, grad_distance, grad_luma);
}

void FusedField::evaluate_with_gradient(const float* points, size_t count, float* values,
                                        float* grad_distance, float* grad_luma) {
    AlignedArray<float> seeds(8 * static_cast<size_t>(backend_->block));
    float* const distance_seed = seeds.data();
    float* const luma_seed = distance_seed + 4 * backend_->block;
    for (int s = 0; s < backend_->block; ++s) {
        distance_seed[4 * s] = 1.0f;
        copy(kLuma, 3, luma_seed + 4 * s + 1);
    }
    for_each_block(count, backend_->block, [&](int thread, size_t first, int samples) {
        void* const workspace = workspaces_[thread].data();
        backend_->forward(shape_, packed_.data(), workspace, points + 3 * first, samples,
                          Keep::kSlopes, values + 4 * first);
        backend_->backward(shape_, packed_.data(), workspace, distance_seed, samples,
                           grad_distance + 3 * first, nullptr);
        if (grad_luma != nullptr) {
            backend_->backward(shape_, packed_.data(), workspace, luma_seed, samples,
                               grad_luma + 3 * first, nullptr);
        }
    });
}

void FusedField::backward(const float* points, size_t count, const float* grad_values,
                          float* grad_points) {
    const Lock lock(mutex_);
    uncollected_ = true;
    AlignedArray<float> values(4 * static_cast<size_t>(backend_->block * pool_.threads()));
    for_each_block(count, backend_->block, [&](int thread, size_t first, int samples) {
        void* const workspace = workspaces_[thread].data();
        backend_->forward(shape_, packed_.data(), workspace, points + 3 * first, samples,
                          Keep::kAll, values.data() + 4 * thread * backend_->block);
        backend_->backward(shape_, packed_.data(), workspace, grad_values + 4 * first, samples,
                           grad_points == nullptr ? nullptr : grad_points + 3 * first,
                           accumulators_[thread].data());
    });
}

// values, differentiate() from values to grad_values, and back. Where the samples fit into one
// block, what the forward pass kept serves the backward pass; else it is repeated.
void FusedField::train_samples(int thread, int count, const float* points, float* values,
                               float* grad_values, float* grad_points,
                               const std::function<void()>& differentiate) {
    void* const workspace = workspaces_[thread].data();
    const int block = backend_->block;
    const bool once = count <= block;
    const auto forward = [&](int first, Keep keep) {
        backend_->forward(shape_, packed_.data(), workspace, points + 3 * first,
                          std::min(block, count - first), keep, values + 4 * first);
    };
    for (int first = 0; first < count; first += block) {
        forward(first, once ? Keep::kAll : Keep::kNothing);
    }
    differentiate();
    for (int first = 0; first < count; first += block) {
        if (!once) forward(first, Keep::kAll);
        backend_->backward(shape_, packed_.data(), workspace, grad_values + 4 * first,
                           std::min(block, count - first), grad_points + 3 * first,
                           accumulators_[thread].data());
    }
}

void FusedField::train_rays(const RaySettings& settings, const RayBatch& batch, float* losses,
                            float* grad_origins, float* grad_directions) {
    const Lock lock(mutex_);
    uncollected_ = true;
    const int samples = batch.samples;
    const int rays_at_once = std::max(1, backend_->block / samples);
    const size_t room = static_cast<size_t>(rays_at_once * samples);
    AlignedArray<float> memory(14 * room * static_cast<size_t>(pool_.threads()));
    const float mean = 1.0f / static_cast<float>(batch.rays);

    for_each_block(batch.rays, rays_at_once, [&](int thread, size_t first, int rays) {
        float* const points = memory.data() + 14 * room * thread;
        float* const grad_points = points + 3 * room;
        float* const values = grad_points + 3 * room;
        float* const grad_values = values + 4 * room;
        const float* const along = batch.along + first * samples;
        place_samples(batch, first, rays, points);
        train_samples(thread, rays * samples, points, values, grad_values, grad_points, [&] {
            for (int i = 0; i < rays; ++i) {
                const size_t ray = first + i;
                const float weight = batch.weights == nullptr ? 1.0f : batch.weights[ray];
                ray_losses(settings, {batch.distances[ray], batch.colors + 3 * ray}, samples,
                           along + i * samples, values + 4 * i * samples, weight * mean,
                           losses + 3 * ray, grad_values + 4 * i * samples);
            }
        });
        gather_rays(batch, first, rays, grad_points, grad_origins, grad_directions);
    });
}

void FusedField::train_posed_rays(const RaySettings& settings, const SamplingSettings& sampling,
                                  uint64_t seed, const PosedRays& rays, float* losses,
                                  float* grad_twists) {
    const RegionRays placed = to_region(rays);
    const int samples = sampling.free_samples + sampling.surface_samples;
    std::vector<float> along(rays.rays * samples);
    sample_rays(sampling, seed, rays.rays, rays.distances, along.data());
    std::vector<float> gradients(6 * rays.rays);
    float* const grad_directions = gradients.data() + 3 * rays.rays;
    train_rays(settings,
               {rays.rays, samples, placed.origins.data(), placed.directions.data(), rays.distances,
                rays.colors, along.data(), rays.weights},
               losses, gradients.data(), grad_directions);
    twist_gradients(rays, gradients.data(), grad_directions, grad_twists);
}

void FusedField::normal_equations(const AlignmentSettings& settings, const float* points,
                                  AlignmentPoints measured, double* information, double* gradient,
                                  float* distance, bool* usable) {
    const Lock lock(mutex_);
    const size_t count = measured.count;
    AlignedArray<float> memory(10 * count);
    float* const values = memory.data();
    float* const grad_distance = values + 4 * count;
    float* const grad_luma = settings.color_weight > 0.0 ? grad_distance + 3 * count : nullptr;
    evaluate_with_gradient(points, count, values, grad_distance, grad_luma);
    measured.values = values;
    measured.grad_distance = grad_distance;
    measured.grad_luma = grad_luma;
    meslam::normal_equations(settings, measured, information, gradient, distance, usable);
}

void FusedField::collect_gradients() {
    if (!uncollected_) return;
    for (AlignedArray<float>& accumulator : accumulators_) {
        backend_->collect(shape_, accumulator.data(), gradients_.data());
    }
    uncollected_ = false;
}

bool FusedField::adam_step(const AdamOptions& options) {
    const Lock lock(mutex_);
    const FlushDenormals flush;
    collect_gradients();
    const bool usable = backend_->all_finite(gradients_.data(), shape_.parameters);
    if (usable) {
        ++step_;
        AdamSettings settings{};
        settings.beta1 = options.beta1;
        settings.beta2 = options.beta2;
        settings.epsilon = options.epsilon;
        settings.bias_correction1 =
            static_cast<float>(1.0 - std::pow(static_cast<double>(options.beta1), step_));
        settings.bias_correction2 =
            static_cast<float>(1.0 - std::pow(static_cast<double>(options.beta2), step_));
        const auto update = [&](size_t first, size_t last, float learning_rate) {
            settings.learning_rate = learning_rate;
            backend_->adam(settings, last - first, gradients_.data() + first,
                           parameters_.data() + first, first_moment_.data() + first,
                           second_moment_.data() + first);
        };
        update(0, shape_.weight1, options.learning_rate * options.encoding_scale);
        update(shape_.weight1, shape_.parameters, options.learning_rate);
        backend_->pack(shape_, parameters_.data(), packed_.data());
        float* const average = average_.data();
        const float* const latest = parameters_.data();
        for (size_t i = 0; i < shape_.parameters; ++i) {
            average[i] += options.average_share * (latest[i] - average[i]);
        }
    }
    std::fill_n(gradients_.data(), shape_.parameters, 0.0f);
    return usable;
}

}  // namespace meslam
