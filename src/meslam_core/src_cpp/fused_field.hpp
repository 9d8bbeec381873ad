// The field of a region with its gradients and its optimiser, on one backend.
#pragma once

#include <functional>
#include <mutex>
#include <string>
#include <vector>

#include "aligned_array.hpp"
#include "alignment.hpp"
#include "backend.hpp"
#include "posed_rays.hpp"
#include "ray_losses.hpp"
#include "ray_sampling.hpp"
#include "thread_pool.hpp"

namespace meslam {

struct AdamOptions {
    float learning_rate;
    float beta1;
    float beta2;
    float epsilon;
    // Factor on the learning rate of B and phi.
    float encoding_scale;
    // Share of the average over the steps that the parameters after this one take.
    float average_share;
};

// Rays in region coordinates with their samples; what lies at a sample is origin + along *
// direction.
struct RayBatch {
    size_t rays;
    int samples;
    const float* origins;     // (rays,3)
    const float* directions;  // (rays,3): change of region coordinates a metre
    const float* distances;   // (rays): of the measured surface [m]
    const float* colors;      // (rays,3): measured, in [0, 1]
    const float* along;       // (rays,samples): ascending [m]
    const float* weights;     // (rays): factors on the rays' losses; null for ones
};

// Calls from several threads are safe and follow one another. Results depend on the number of
// threads (the order of the sums) but not on their timing.
class FusedField {
public:
    FusedField(int width, int embedding, const std::string& isa, int threads);

    const NetworkShape& shape() const { return shape_; }
    const char* isa() const { return backend_->name; }
    int threads() const { return pool_.threads(); }

    void get_parameters(float* to) const;
    // What the parameters were on average over the last steps since set_parameters.
    void get_average(float* to) const;
    void set_parameters(const float* from);
    // Sum of all backward calls since the last zero_gradients or adam_step.
    void get_gradients(float* to);
    void zero_gradients();
    void get_optimizer(float* first_moment, float* second_moment, long& step) const;
    void set_optimizer(const float* first_moment, const float* second_moment, long step);
    void reset_optimizer();

    // points (count,3) to values (count,4).
    void forward(const float* points, size_t count, float* values);
    // Also the gradients (count,3) of the first value and of the luma; grad_luma may be null.
    void forward_with_gradient(const float* points, size_t count, float* values,
                               float* grad_distance, float* grad_luma);
    // Repeats the forward pass block by block, adds to the gradients, writes grad_points (count,3)
    // unless it is null.
    void backward(const float* points, size_t count, const float* grad_values, float* grad_points);
    // Forward pass, rendering, losses and backward pass of rays in one go. The gradients are those
    // of the mean over the rays of weight times loss. Writes losses (rays,3), before the weights,
    // and grad_origins and grad_directions (rays,3).
    void train_rays(const RaySettings& settings, const RayBatch& batch, float* losses,
                    float* grad_origins, float* grad_directions);
    // The same from cameras' poses, with samples drawn here; writes losses (rays,3) and grad_twists
    // (poses,6), see posed_rays.hpp.
    void train_posed_rays(const RaySettings& settings, const SamplingSettings& sampling,
                          uint64_t seed, const PosedRays& rays, float* losses, float* grad_twists);
    // See alignment.hpp; `measured` needs no values and gradients: they are computed at points.
    void normal_equations(const AlignmentSettings& settings, const float* points,
                          AlignmentPoints measured, double* information, double* gradient,
                          float* distance, bool* usable);
    // One step with the gradients of the backward calls, which it uses up. False, and nothing
    // changed, where they are not finite.
    bool adam_step(const AdamOptions& options);

private:
    void for_each_block(size_t count, size_t block,
                        const std::function<void(int, size_t, int)>& task);
    void evaluate_with_gradient(const float* points, size_t count, float* values,
                                float* grad_distance, float* grad_luma);
    void train_samples(int thread, int count, const float* points, float* values,
                       float* grad_values, float* grad_points,
                       const std::function<void()>& differentiate);
    void collect_gradients();

    const Backend* const backend_;
    const NetworkShape shape_;
    mutable std::mutex mutex_;
    ThreadPool pool_;
    AlignedArray<float> parameters_;
    AlignedArray<float> average_;
    AlignedArray<float> gradients_;
    AlignedArray<float> first_moment_;
    AlignedArray<float> second_moment_;
    long step_ = 0;
    AlignedArray<char> packed_;
    std::vector<AlignedArray<char>> workspaces_;
    std::vector<AlignedArray<float>> accumulators_;
    bool uncollected_ = false;
};

}  // namespace meslam
