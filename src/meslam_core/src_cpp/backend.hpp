// What an instruction set must offer; everything above it is compiled once and knows none of them.
#pragma once

#include <stddef.h>

#include "network_shape.hpp"

namespace meslam {

// How much of a block's forward pass is kept for what follows it.
enum class Keep {
    kNothing,  // values only
    kSlopes,   // what the gradient with respect to the points needs
    kAll,      // what the gradients of the weights need too
};

struct AdamSettings {
    float learning_rate;
    float beta1;
    float beta2;
    float epsilon;
    // 1 - beta^t of the step being made.
    float bias_correction1;
    float bias_correction2;
};

struct Backend {
    const char* name;
    // Samples that one call of forward takes at most.
    int block;
    size_t (*packed_bytes)(const NetworkShape&);
    size_t (*workspace_bytes)(const NetworkShape&);
    size_t (*accumulator_floats)(const NetworkShape&);

    // Writes the parameters in the order in which the products read them.
    void (*pack)(const NetworkShape&, const float* parameters, void* packed);

    // State of the calling thread that the products need; leave restores what enter found.
    void (*enter)(void* saved_state);
    void (*leave)(const void* saved_state);

    // points (count,3) to values (count,4): signed distance before clipping, then red, green, blue
    // after the sigmoid. `workspace` keeps the activations that backward needs.
    void (*forward)(const NetworkShape&, const void* packed, void* workspace, const float* points,
                    int count, Keep keep, float* values);

    // Goes back through the block of the last forward call. grad_values (count,4) is the gradient
    // with respect to `values`. Adds to `accumulator` unless it is null: forward must then have
    // kept everything. Writes grad_points (count,3) unless it is null.
    void (*backward)(const NetworkShape&, const void* packed, void* workspace,
                     const float* grad_values, int count, float* grad_points, float* accumulator);

    // Adds an accumulator, whose order is the backend's own, to gradients in parameter order, and
    // clears it.
    void (*collect)(const NetworkShape&, float* accumulator, float* gradients);

    bool (*all_finite)(const float* numbers, size_t count);
    void (*adam)(const AdamSettings&, size_t count, const float* gradients, float* parameters,
                 float* first_moment, float* second_moment);
};

// Bytes that enter may use to save a thread's state.
constexpr size_t kSavedStateBytes = 64;

// Null where the compiler or the target has no such instructions.
const Backend* portable_backend();
const Backend* avx2_backend();
const Backend* avx512_backend();
const Backend* avx512bf16_backend();
const Backend* amx_backend();

}  // namespace meslam
