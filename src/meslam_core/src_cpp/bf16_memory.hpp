// Where the bfloat16 backends keep weights, activations and sums of gradients.
#pragma once

#include "arena.hpp"
#include "bf16_products.hpp"
#include "network_shape.hpp"

namespace meslam {
namespace {

constexpr int kBlock = MESLAM_BLOCK;
constexpr int kBlockGroups = kBlock / kGroup;
constexpr float kInversePi = 0.318309886f;

struct PackedWeights {
    float* frequency;   // (3,E) divided by pi
    float* phase;       // (E) divided by pi
    float* directions;  // (3,E): B transposed, for the gradient of the points
    Bf16* forward[5];   // right factors; the last has the output layer, padded to 16 columns
    Bf16* backward[5];  // right factors of the way back; the last padded to 32 rows
    float* bias[5];
    float* padded_output;  // (32,W): W5 and rows of zeros
    uintptr_t end;

    PackedWeights(const NetworkShape& shape, void* memory) {
        const size_t w = shape.width, e = shape.embedding;
        Arena arena(memory);
        frequency = arena.take(3 * e);
        phase = arena.take(e);
        directions = arena.take(3 * e);
        const size_t inputs[5] = {e, w, w + e, w, w};
        const size_t outputs[5] = {w, w, w, w, kGroup};
        for (int layer = 0; layer < 5; ++layer) {
            forward[layer] = arena.take<Bf16>(inputs[layer] * outputs[layer]);
            backward[layer] = arena.take<Bf16>(inputs[layer] * outputs[layer]);
            bias[layer] = arena.take(outputs[layer]);
        }
        padded_output = arena.take(kGroup * w);
        end = arena.next;
    }
};

struct Workspace {
    int hidden_tiles, joined_tiles, embedding_tiles;  // of 16 features
    float* points;                                    // (block,4): x, y, z, 0
    float* values;                                    // (block,4)
    float* slopes;  // (block,4): gradient with respect to the output layer's sums
    float* narrow;  // the output layer's sums in tiles
    float* cosine;  // in tiles of 16 samples by 16 features, as the next
    float* embedding_gradient;
    Bf16* joined_rows;  // h2 and the embedding, the third layer's input
    Bf16* joined_pairs;
    Bf16* hidden_rows[4];  // of h1 to h4; h2 is the first part of joined_rows
    Bf16* hidden_pairs[4];
    Bf16* gradient_rows[3];
    Bf16* gradient_columns;
    Bf16* slope_rows;
    Bf16* slope_columns;
    uintptr_t end;

    Workspace(const NetworkShape& shape, void* memory) {
        const size_t w = shape.width, e = shape.embedding;
        hidden_tiles = shape.width / kSide;
        embedding_tiles = shape.embedding / kSide;
        joined_tiles = hidden_tiles + embedding_tiles;
        Arena arena(memory);
        points = arena.take(4 * kBlock);
        values = arena.take(4 * kBlock);
        slopes = arena.take(4 * kBlock);
        narrow = arena.take(kSide * kBlock);
        cosine = arena.take(e * kBlock);
        embedding_gradient = arena.take(e * kBlock);
        joined_rows = arena.take<Bf16>((w + e) * kBlock);
        joined_pairs = arena.take<Bf16>((w + e) * kBlock);
        for (int i = 0; i < 4; ++i) {
            hidden_rows[i] = i == 1 ? joined_rows : arena.take<Bf16>(w * kBlock);
            hidden_pairs[i] = i == 1 ? joined_pairs : arena.take<Bf16>(w * kBlock);
        }
        for (Bf16*& rows : gradient_rows) rows = arena.take<Bf16>(w * kBlock);
        gradient_columns = arena.take<Bf16>(w * kBlock);
        slope_rows = arena.take<Bf16>(kGroup * kBlock);
        slope_columns = arena.take<Bf16>(kSide * kBlock);
        end = arena.next;
    }

    // Tiles in a row of tiles of hidden_rows[i], and of pairs.
    int row_tiles(int i) const { return (i == 1 ? joined_tiles : hidden_tiles) / 2; }
    int pair_tiles(int i) const { return i == 1 ? joined_tiles : hidden_tiles; }
};

// Sums of the gradients over all blocks; weights in tiles.
struct Accumulator {
    float* frequency;  // (4,E): B transposed, then phi
    float* weight[5];  // the last has 16 rows, 4 of them used
    float* bias[5];    // the last: 16 partial sums of the four
    uintptr_t end;

    Accumulator(const NetworkShape& shape, void* memory) {
        const size_t w = shape.width, e = shape.embedding;
        Arena arena(memory);
        frequency = arena.take(4 * e);
        const size_t inputs[5] = {e, w, w + e, w, w};
        const size_t outputs[5] = {w, w, w, w, kSide};
        for (int layer = 0; layer < 5; ++layer) {
            weight[layer] = arena.take(inputs[layer] * outputs[layer]);
            bias[layer] = arena.take(outputs[layer]);
        }
        end = arena.next;
    }
};

size_t packed_bytes(const NetworkShape& shape) { return PackedWeights(shape, nullptr).end; }

size_t workspace_bytes(const NetworkShape& shape) { return Workspace(shape, nullptr).end; }

size_t accumulator_floats(const NetworkShape& shape) {
    return Accumulator(shape, nullptr).end / sizeof(float);
}

void pack(const NetworkShape& shape, const float* parameters, void* memory) {
    const PackedWeights packed(shape, memory);
    const int w = shape.width, e = shape.embedding;
    for (int j = 0; j < e; ++j) {
        for (int axis = 0; axis < 3; ++axis) {
            const float b = parameters[shape.frequency + 3 * j + axis];
            packed.frequency[axis * e + j] = b * kInversePi;
            packed.directions[axis * e + j] = b;
        }
        packed.phase[j] = parameters[shape.phase + j] * kInversePi;
    }
    memset(packed.padded_output, 0, sizeof(float) * kGroup * w);
    memcpy(packed.padded_output, parameters + shape.weight5, sizeof(float) * 4 * w);
    const float* const weights[5] = {parameters + shape.weight1, parameters + shape.weight2,
                                     parameters + shape.weight3, parameters + shape.weight4,
                                     packed.padded_output};
    const size_t biases[5] = {shape.bias1, shape.bias2, shape.bias3, shape.bias4, shape.bias5};
    const int inputs[5] = {e, w, w + e, w, w};
    for (int layer = 0; layer < 5; ++layer) {
        const bool last = layer == 4;
        pack_forward(weights[layer], last ? kSide : w, inputs[layer], packed.forward[layer]);
        pack_backward(weights[layer], last ? kGroup : w, inputs[layer], packed.backward[layer]);
        memset(packed.bias[layer], 0, sizeof(float) * (last ? kGroup : w));
        memcpy(packed.bias[layer], parameters + biases[layer], sizeof(float) * (last ? 4 : w));
    }
}

void collect(const NetworkShape& shape, float* sums, float* gradients) {
    const Accumulator from(shape, sums);
    const int w = shape.width, e = shape.embedding;
    for (int j = 0; j < e; ++j) {
        for (int axis = 0; axis < 3; ++axis) {
            gradients[shape.frequency + 3 * j + axis] += from.frequency[axis * e + j];
        }
        gradients[shape.phase + j] += from.frequency[3 * e + j];
    }
    const size_t weights[4] = {shape.weight1, shape.weight2, shape.weight3, shape.weight4};
    const size_t biases[4] = {shape.bias1, shape.bias2, shape.bias3, shape.bias4};
    const int inputs[4] = {e, w, w + e, w};
    for (int layer = 0; layer < 4; ++layer) {
        collect_tiles(from.weight[layer], w, inputs[layer], gradients + weights[layer]);
        for (int i = 0; i < w; ++i) {
            // Entry i of a group of 32: tile i/16, and within it lanes of four (see
            // bf16_tiles.hpp).
            const int half = i / 16 % 2, lane = i % 16;
            gradients[biases[layer] + i / kGroup * kGroup + lane / 4 * 8 + half * 4 + lane % 4] +=
                from.bias[layer][i];
        }
    }
    // Its four rows stand in order in the accumulator's one row of tiles; its columns do not.
    for (int output = 0; output < 4; ++output) {
        for (int i = 0; i < w; ++i) {
            const int half = i / 16 % 2, lane = i % 16;
            gradients[shape.weight5 + output * w + i / kGroup * kGroup + lane / 4 * 8 + half * 4 +
                      lane % 4] += from.weight[4][i / kSide * kSums + output * kSide + lane];
        }
        for (int i = 0; i < 4; ++i) gradients[shape.bias5 + output] += from.bias[4][4 * i + output];
    }
    memset(sums, 0, from.end - reinterpret_cast<uintptr_t>(sums));
}

}  // namespace
}  // namespace meslam
