// The field in single precision. A backend_*.cpp defines MESLAM_VECTOR_BYTES, MESLAM_TILE_ROWS and
// MESLAM_TILE_VECTORS, selects the instruction set and includes this.
#pragma once

#include "arena.hpp"
#include "backend.hpp"
#include "float_products.hpp"
#include "optimizer_steps.hpp"
#include "vector_math.hpp"

namespace meslam {
namespace {

// A multiple of every tile's rows.
constexpr int kBlock = 120;
constexpr float kInversePi = 0.318309886f;
// Rows of a power-of-two length would fall on the same few cache sets.
constexpr int kRowPadding = 16;

struct PackedWeights {
    float* frequency;      // (3,E) divided by pi
    float* phase;          // (E) divided by pi
    float* back_to_point;  // (E,lanes): B, its three columns padded with zeros
    float* forward[4];     // right factors of the hidden layers: (in,out)
    float* backward[4];    // right factors of the way back: (out,in)
    float* output;         // (W,lanes): W5 transposed, padded
    float* output_back;    // (4,W)
    float* bias[4];
    float* output_bias;  // (lanes), padded
    uintptr_t end;

    PackedWeights(const NetworkShape& shape, void* memory) {
        const size_t w = shape.width, e = shape.embedding;
        Arena arena(memory);
        frequency = arena.take(3 * e);
        phase = arena.take(e);
        back_to_point = arena.take(e * kLanes);
        const size_t inputs[4] = {e, w, w + e, w};
        for (int layer = 0; layer < 4; ++layer) {
            forward[layer] = arena.take(inputs[layer] * w);
            backward[layer] = arena.take(inputs[layer] * w);
            bias[layer] = arena.take(w);
        }
        output = arena.take(w * kLanes);
        output_back = arena.take(4 * w);
        output_bias = arena.take(kLanes);
        end = arena.next;
    }
};

struct Workspace {
    ptrdiff_t hidden_row, joined_row, embedding_row;
    float* points;  // (block,4): x, y, z, 1
    float* values;  // (block,4)
    float* slopes;  // (block,4): gradient with respect to the output layer's sums
    float* joined;  // (block,W+E): h2 beside the embedding, the third layer's input
    float* hidden[4];
    float* cosine;
    float* gradient[2];         // (block,W): with respect to a hidden layer's sums
    float* embedding_gradient;  // (block,E)
    float* narrow;              // (block,lanes): products with few columns
    uintptr_t end;

    Workspace(const NetworkShape& shape, void* memory) {
        hidden_row = shape.width + kRowPadding;
        joined_row = shape.width + shape.embedding + kRowPadding;
        embedding_row = shape.embedding + kRowPadding;
        Arena arena(memory);
        points = arena.take(4 * kBlock);
        values = arena.take(4 * kBlock);
        slopes = arena.take(4 * kBlock);
        joined = arena.take(joined_row * kBlock);
        hidden[0] = arena.take(hidden_row * kBlock);
        hidden[1] = joined;
        hidden[2] = arena.take(hidden_row * kBlock);
        hidden[3] = arena.take(hidden_row * kBlock);
        cosine = arena.take(embedding_row * kBlock);
        gradient[0] = arena.take(hidden_row * kBlock);
        gradient[1] = arena.take(hidden_row * kBlock);
        embedding_gradient = arena.take(embedding_row * kBlock);
        narrow = arena.take(kLanes * kBlock);
        end = arena.next;
    }
};

size_t packed_bytes(const NetworkShape& shape) { return PackedWeights(shape, nullptr).end; }

size_t workspace_bytes(const NetworkShape& shape) { return Workspace(shape, nullptr).end; }

// The parameters' own order, but for B, which is transposed: (3,E).
size_t accumulator_floats(const NetworkShape& shape) { return shape.parameters; }

void pack(const NetworkShape& shape, const float* parameters, void* memory) {
    const PackedWeights packed(shape, memory);
    const int w = shape.width, e = shape.embedding;
    memset(packed.back_to_point, 0, sizeof(float) * e * kLanes);
    for (int j = 0; j < e; ++j) {
        for (int axis = 0; axis < 3; ++axis) {
            const float b = parameters[shape.frequency + 3 * j + axis];
            packed.frequency[axis * e + j] = b * kInversePi;
            packed.back_to_point[j * kLanes + axis] = b;
        }
        packed.phase[j] = parameters[shape.phase + j] * kInversePi;
    }
    const size_t weights[4] = {shape.weight1, shape.weight2, shape.weight3, shape.weight4};
    const size_t biases[4] = {shape.bias1, shape.bias2, shape.bias3, shape.bias4};
    const int inputs[4] = {e, w, w + e, w};
    for (int layer = 0; layer < 4; ++layer) {
        const float* const weight = parameters + weights[layer];
        pack_panels(weight, inputs[layer], w, 1, inputs[layer], packed.forward[layer]);
        pack_panels(weight, w, inputs[layer], inputs[layer], 1, packed.backward[layer]);
        memcpy(packed.bias[layer], parameters + biases[layer], sizeof(float) * w);
    }
    const float* const weight5 = parameters + shape.weight5;
    pack_panels(weight5, 4, w, w, 1, packed.output_back);
    memset(packed.output, 0, sizeof(float) * w * kLanes);
    for (int k = 0; k < w; ++k) {
        for (int n = 0; n < 4; ++n) packed.output[k * kLanes + n] = weight5[n * w + k];
    }
    memset(packed.output_bias, 0, sizeof(float) * kLanes);
    memcpy(packed.output_bias, parameters + shape.bias5, sizeof(float) * 4);
}

template <bool kWithCosine>
void embed(const NetworkShape& shape, const PackedWeights& packed, const Workspace& work,
           int count) {
    const int e = shape.embedding;
    float* const embedding = work.joined + shape.width;
    for (int j = 0; j < e; j += kLanes) {
        const Vector b0 = load(packed.frequency + j);
        const Vector b1 = load(packed.frequency + e + j);
        const Vector b2 = load(packed.frequency + 2 * e + j);
        const Vector phase = load(packed.phase + j);
        for (int s = 0; s < count; ++s) {
            const float* const p = work.points + 4 * s;
            Vector sine, cosine;
            sine_and_cosine_of_pi(p[0] * b0 + (p[1] * b1 + (p[2] * b2 + phase)), sine, cosine);
            store(embedding + s * work.joined_row + j, sine);
            if (kWithCosine) store(work.cosine + s * work.embedding_row + j, cosine);
        }
    }
}

// Sigmoid of every fourth number but the first of each four.
void finish_values(const Workspace& work, int count, float* values) {
    for (int s = 0; s < count; ++s) {
        memcpy(work.values + 4 * s, work.narrow + s * kLanes, 4 * sizeof(float));
    }
    IntVector lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = i % 4;
    for (int i = 0; i < 4 * count; i += kLanes) {
        const Vector sums = load(work.values + i);
        store(work.values + i, lane == 0 ? sums : sigmoid(sums));
    }
    memcpy(values, work.values, 4 * sizeof(float) * count);
}

void forward(const NetworkShape& shape, const void* packed_memory, void* workspace,
             const float* points, int count, Keep keep, float* values) {
    const PackedWeights packed(shape, const_cast<void*>(packed_memory));
    const Workspace work(shape, workspace);
    const int w = shape.width, e = shape.embedding;
    for (int s = 0; s < count; ++s) {
        memcpy(work.points + 4 * s, points + 3 * s, 3 * sizeof(float));
        work.points[4 * s + 3] = 1.0f;
    }
    if (keep == Keep::kNothing) {
        embed<false>(shape, packed, work, count);
    } else {
        embed<true>(shape, packed, work, count);
    }
    const auto layer = [&](int index, const float* input, ptrdiff_t input_row, int inputs,
                           ptrdiff_t output_row) {
        multiply<Epilogue::kBiasRelu>(count, w, inputs, {input, input_row, 1},
                                      {packed.forward[index], kPanel, inputs * kPanel},
                                      {work.hidden[index], output_row, packed.bias[index], 0});
    };
    layer(0, work.joined + w, work.joined_row, e, work.hidden_row);
    layer(1, work.hidden[0], work.hidden_row, w, work.joined_row);
    layer(2, work.joined, work.joined_row, w + e, work.hidden_row);
    layer(3, work.hidden[2], work.hidden_row, w, work.hidden_row);
    multiply<Epilogue::kBias, 1>(count, kLanes, w, {work.hidden[3], work.hidden_row, 1},
                                 {packed.output, kLanes, 0},
                                 {work.narrow, kLanes, packed.output_bias, 0});
    finish_values(work, count, values);
}

// Gradient with respect to the output layer's sums: through the sigmoid for the colours.
void start_slopes(const Workspace& work, const float* grad_values, int count) {
    memcpy(work.slopes, grad_values, 4 * sizeof(float) * count);
    IntVector lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = i % 4;
    for (int i = 0; i < 4 * count; i += kLanes) {
        const Vector value = load(work.values + i);
        const Vector gradient = load(work.slopes + i);
        store(work.slopes + i, lane == 0 ? gradient : gradient * value * (1.0f - value));
    }
}

void multiply_by_cosine(const NetworkShape& shape, const Workspace& work, int count) {
    for (int s = 0; s < count; ++s) {
        float* const gradient = work.embedding_gradient + s * work.embedding_row;
        const float* const cosine = work.cosine + s * work.embedding_row;
        for (int j = 0; j < shape.embedding; j += kLanes) {
            store(gradient + j, load(gradient + j) * load(cosine + j));
        }
    }
}

void backward(const NetworkShape& shape, const void* packed_memory, void* workspace,
              const float* grad_values, int count, float* grad_points, float* accumulator) {
    const PackedWeights packed(shape, const_cast<void*>(packed_memory));
    const Workspace work(shape, workspace);
    const int w = shape.width, e = shape.embedding;
    const ptrdiff_t row = work.hidden_row;
    start_slopes(work, grad_values, count);

    // weight (outputs, inputs) += gradient^T input, bias += the gradient's sum.
    const auto add_weights = [&](size_t weight, size_t bias, const float* gradient,
                                 ptrdiff_t gradient_row, int outputs, const float* input,
                                 ptrdiff_t input_row, int inputs) {
        if (accumulator == nullptr) return;
        multiply<Epilogue::kAccumulate>(outputs, inputs, count, {gradient, 1, gradient_row},
                                        {input, input_row, kPanel},
                                        {accumulator + weight, inputs, nullptr, 0});
        if (outputs == w) {
            add_column_sums(gradient, gradient_row, count, outputs, accumulator + bias);
        }
    };
    // gradient of the sums of a lower layer = gate(gradient weight).
    const auto descend = [&](int index, const float* gradient, float* lower,
                             const float* activation, ptrdiff_t activation_row) {
        multiply<Epilogue::kGate>(count, w, w, {gradient, row, 1},
                                  {packed.backward[index], kPanel, w * kPanel},
                                  {lower, row, activation, activation_row});
    };

    add_weights(shape.weight5, shape.bias5, work.slopes, 4, 4, work.hidden[3], row, w);
    if (accumulator != nullptr) {
        for (int s = 0; s < count; ++s) {
            for (int n = 0; n < 4; ++n) accumulator[shape.bias5 + n] += work.slopes[4 * s + n];
        }
    }
    float* const a = work.gradient[0];
    float* const b = work.gradient[1];
    multiply<Epilogue::kGate>(count, w, 4, {work.slopes, 4, 1},
                              {packed.output_back, kPanel, 4 * kPanel},
                              {a, row, work.hidden[3], row});
    add_weights(shape.weight4, shape.bias4, a, row, w, work.hidden[2], row, w);
    descend(3, a, b, work.hidden[2], row);
    add_weights(shape.weight3, shape.bias3, b, row, w, work.joined, work.joined_row, w + e);
    descend(2, b, a, work.joined, work.joined_row);
    multiply<Epilogue::kStore>(count, e, w, {b, row, 1},
                               {packed.backward[2] + w * w, kPanel, w * kPanel},
                               {work.embedding_gradient, work.embedding_row, nullptr, 0});
    add_weights(shape.weight2, shape.bias2, a, row, w, work.hidden[0], row, w);
    descend(1, a, b, work.hidden[0], row);
    add_weights(shape.weight1, shape.bias1, b, row, w, work.joined + w, work.joined_row, e);
    multiply<Epilogue::kAccumulate>(count, e, w, {b, row, 1},
                                    {packed.backward[0], kPanel, w * kPanel},
                                    {work.embedding_gradient, work.embedding_row, nullptr, 0});

    multiply_by_cosine(shape, work, count);
    if (accumulator != nullptr) {
        multiply<Epilogue::kAccumulate>(4, e, count, {work.points, 1, 4},
                                        {work.embedding_gradient, work.embedding_row, kPanel},
                                        {accumulator + shape.frequency, e, nullptr, 0});
    }
    if (grad_points != nullptr) {
        multiply<Epilogue::kStore, 1>(
            count, kLanes, e, {work.embedding_gradient, work.embedding_row, 1},
            {packed.back_to_point, kLanes, 0}, {work.narrow, kLanes, nullptr, 0});
        for (int s = 0; s < count; ++s) {
            memcpy(grad_points + 3 * s, work.narrow + s * kLanes, 3 * sizeof(float));
        }
    }
}

void collect(const NetworkShape& shape, float* accumulator, float* gradients) {
    const int e = shape.embedding;
    for (int axis = 0; axis < 3; ++axis) {
        for (int j = 0; j < e; ++j) {
            gradients[shape.frequency + 3 * j + axis] +=
                accumulator[shape.frequency + axis * e + j];
        }
    }
    for (size_t i = shape.phase; i < shape.parameters; ++i) gradients[i] += accumulator[i];
    memset(accumulator, 0, sizeof(float) * shape.parameters);
}

void keep_thread_state(void*) {}
void restore_thread_state(const void*) {}

constexpr Backend make_float_backend(const char* name) {
    return {name,
            kBlock,
            packed_bytes,
            workspace_bytes,
            accumulator_floats,
            pack,
            keep_thread_state,
            restore_thread_state,
            forward,
            backward,
            collect,
            all_finite,
            adam};
}

}  // namespace
}  // namespace meslam
