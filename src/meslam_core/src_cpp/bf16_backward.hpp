// The way from the gradient of values to those of points and parameters with bfloat16 products.
#pragma once

#include "backend.hpp"
#include "bf16_forward.hpp"

namespace meslam {
namespace {

// Gradient with respect to the output layer's sums: through the sigmoid for the colours. As a left
// factor it is padded with zeros to 32 columns.
void start_slopes(const Workspace& work, const float* grad_values, int count) {
    const int padded = groups_of(count) * kGroup;
    memset(work.slopes + 4 * count, 0, 4 * sizeof(float) * (padded - count));
    memcpy(work.slopes, grad_values, 4 * sizeof(float) * count);
    for (int i = 0; i < 4 * count; i += kLanes) {
        const __m512 value = _mm512_load_ps(work.values + i);
        const __m512 gradient = _mm512_load_ps(work.slopes + i);
        const __m512 through = gradient * value * (1.0f - value);
        _mm512_store_ps(work.slopes + i, _mm512_mask_blend_ps(0x1111, through, gradient));
    }
    memset(work.slopes + 4 * count, 0, 4 * sizeof(float) * (padded - count));
    for (int s = 0; s < padded; ++s) {
        const __m512 four = _mm512_zextps128_ps512(_mm_load_ps(work.slopes + 4 * s));
        store_row(work.slope_rows, s, to_bf16(four, _mm512_setzero_ps()));
    }
}

// The slopes transposed, and their sums.
void sum_slopes(const Workspace& work, const Accumulator& sums, int groups) {
    const __m512i every_fourth =
        _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 0, 4, 8, 12, 16, 20, 24, 28);
    __m512 total = _mm512_load_ps(sums.bias[4]);
    for (int group = 0; group < groups; ++group) {
        const float* const from = work.slopes + 4 * kGroup * group;
        __m512 v[8];
        MESLAM_UNROLL
        for (int i = 0; i < 8; ++i) {
            v[i] = _mm512_load_ps(from + i * kLanes);
            total += v[i];
        }
        Bf16* const tile = work.slope_columns + group * kTile;
        for (int output = 0; output < 4; ++output) {
            const __m512i index = _mm512_add_epi32(every_fourth, _mm512_set1_epi32(output));
            const auto sixteen = [&](int first) {
                return _mm512_mask_blend_ps(
                    0xff00, _mm512_permutex2var_ps(v[first], index, v[first + 1]),
                    _mm512_permutex2var_ps(v[first + 2], index, v[first + 3]));
            };
            store_row(tile, output, to_bf16(sixteen(0), sixteen(4)));
        }
        for (int row = 4; row < kSide; ++row) store_row(tile, row, _mm512_setzero_si512());
    }
    _mm512_store_ps(sums.bias[4], total);
}

// Gradient with respect to the sums of `layer`: the product where the activation is positive. In
// rows for the next product; where the weights are trained also in columns, with its bias.
template <bool kWithWeights>
void descend(const Workspace& work, int layer, const Term& term, int groups, Bf16* rows,
             float* bias) {
    const int row_tiles = work.hidden_tiles / 2;
    const int active_tiles = work.row_tiles(layer);
    const Bf16* const active = work.hidden_rows[layer];
    Bf16* const columns = work.gradient_columns;
    const Term terms[1] = {term};
    multiply_and_finish<Start::kZero>(
        groups, row_tiles, terms, nullptr,
        [=](int sample_group, int feature_group, const float* sums) {
            alignas(64) Bf16 pairs[2 * kTile];
            const __m512bh ones = (__m512bh)_mm512_set1_epi16(0x3f80);
            __m512 bias_low = _mm512_setzero_ps(), bias_high = _mm512_setzero_ps();
            for (int row = 0; row < kGroup; row += 2) {
                const float* const from = sums + row / kSide * 2 * kSums + row % kSide * kSide;
                const int tile_row = 2 * sample_group + row / kSide;
                const Bf16* const gate = active + (tile_row * active_tiles + feature_group) * kTile;
                Bf16* const tile = rows + (tile_row * row_tiles + feature_group) * kTile;
                __m512i gradient[2];
                MESLAM_UNROLL
                for (int odd = 0; odd < 2; ++odd) {
                    const float* const here = from + odd * kSide;
                    const __m512i gates = load_row(gate, row % kSide + odd);
                    gradient[odd] = _mm512_maskz_mov_epi16(
                        _mm512_test_epi16_mask(gates, gates),
                        to_bf16(_mm512_load_ps(here), _mm512_load_ps(here + kSums)));
                    store_row(tile, row % kSide + odd, gradient[odd]);
                }
                if (kWithWeights) {
                    const __m512i low = _mm512_unpacklo_epi16(gradient[0], gradient[1]);
                    const __m512i high = _mm512_unpackhi_epi16(gradient[0], gradient[1]);
                    bias_low = _mm512_dpbf16_ps(bias_low, (__m512bh)low, ones);
                    bias_high = _mm512_dpbf16_ps(bias_high, (__m512bh)high, ones);
                    store_row(pairs, row / 2, low);
                    store_row(pairs + kTile, row / 2, high);
                }
            }
            if (kWithWeights) {
                float* const to = bias + feature_group * kGroup;
                _mm512_store_ps(to, bias_low + _mm512_load_ps(to));
                _mm512_store_ps(to + kSide, bias_high + _mm512_load_ps(to + kSide));
                Bf16* const tile =
                    columns + (2 * feature_group * kBlockGroups + sample_group) * kTile;
                transpose_tile(pairs, tile);
                transpose_tile(pairs + kTile, tile + kBlockGroups * kTile);
            }
        });
}

// From the gradient of the embedding's angles to that of the points, B and phi.
template <bool kWithWeights>
void finish_embedding(const NetworkShape& shape, const PackedWeights& packed, const Workspace& work,
                      int count, float* grad_points, float* frequency) {
    constexpr int kAtOnce = 4;
    const int e = shape.embedding;
    for (int first = 0; first < groups_of(count) * kGroup; first += kAtOnce) {
        const float* const gradient = work.embedding_gradient +
                                      first / kSide * work.embedding_tiles * kSums +
                                      first % kSide * kSide;
        Vector to_points[kAtOnce][3];
        MESLAM_UNROLL
        for (int i = 0; i < kAtOnce; ++i) {
            MESLAM_UNROLL
            for (int axis = 0; axis < 3; ++axis) to_points[i][axis] = Vector{};
        }
        for (int j = 0; j < e; j += kLanes) {
            Vector b[3], sums[4];
            MESLAM_UNROLL
            for (int axis = 0; axis < 3; ++axis) {
                b[axis] = load(packed.directions + axis * e + j);
                if (kWithWeights) sums[axis] = load(frequency + axis * e + j);
            }
            if (kWithWeights) sums[3] = load(frequency + 3 * e + j);
            MESLAM_UNROLL
            for (int i = 0; i < kAtOnce; ++i) {
                const Vector angle = load(gradient + j / kSide * kSums + i * kSide);
                MESLAM_UNROLL
                for (int axis = 0; axis < 3; ++axis) {
                    to_points[i][axis] += angle * b[axis];
                    if (kWithWeights) {
                        sums[axis] += work.points[4 * (first + i) + axis] * angle;
                    }
                }
                if (kWithWeights) sums[3] += angle;
            }
            if (kWithWeights) {
                MESLAM_UNROLL
                for (int axis = 0; axis < 4; ++axis) {
                    store(frequency + axis * e + j, sums[axis]);
                }
            }
        }
        if (grad_points == nullptr) continue;
        for (int i = 0; i < kAtOnce && first + i < count; ++i) {
            for (int axis = 0; axis < 3; ++axis) {
                grad_points[3 * (first + i) + axis] =
                    _mm512_reduce_add_ps((__m512)to_points[i][axis]);
            }
        }
    }
}

template <bool kWithWeights>
void backward_block(const NetworkShape& shape, const PackedWeights& packed, const Workspace& work,
                    int count, float* grad_points, const Accumulator& sums) {
    const int groups = groups_of(count);
    const int steps = work.hidden_tiles / 2;
    const ptrdiff_t side = ptrdiff_t{steps} * kTile;
    Bf16* const a = work.gradient_rows[0];
    Bf16* const b = work.gradient_rows[1];  // kept to the end: the embedding feeds this layer too
    Bf16* const c = work.gradient_rows[2];
    const auto rows = [&](const Bf16* gradient) { return Factor{gradient, side, kTile}; };
    // The part of a layer's right factor that starts at its 16-wide column tile `first`.
    const auto back = [&](int layer, int first) {
        return Factor{packed.backward[layer] + first * side, side, kTile};
    };
    // weight += gradient^T input: of all groups of samples at once.
    const auto add_weights = [&](int layer, const Bf16* pairs, int pair_tiles, int input_tiles) {
        if (!kWithWeights) return;
        const Factor left{work.gradient_columns, kBlockGroups * kTile, kTile};
        const Factor right{pairs, kTile, ptrdiff_t{pair_tiles} * kTile};
        accumulate<2>(work.hidden_tiles, input_tiles, {left, right, groups}, sums.weight[layer]);
    };

    if (kWithWeights) {
        sum_slopes(work, sums, groups);
        const Factor left{work.slope_columns, 0, kTile};
        const Factor right{work.hidden_pairs[3], kTile, ptrdiff_t{work.hidden_tiles} * kTile};
        accumulate<1>(1, work.hidden_tiles, {left, right, groups}, sums.weight[4]);
    }
    const Factor slopes{work.slope_rows, kTile, kTile};
    descend<kWithWeights>(work, 3, {slopes, {packed.backward[4], kTile, kTile}, 1}, groups, a,
                          sums.bias[3]);
    add_weights(3, work.hidden_pairs[2], work.hidden_tiles, work.hidden_tiles);
    descend<kWithWeights>(work, 2, {rows(a), back(3, 0), steps}, groups, b, sums.bias[2]);
    add_weights(2, work.joined_pairs, work.joined_tiles, work.joined_tiles);
    descend<kWithWeights>(work, 1, {rows(b), back(2, 0), steps}, groups, a, sums.bias[1]);
    add_weights(1, work.hidden_pairs[0], work.hidden_tiles, work.hidden_tiles);
    descend<kWithWeights>(work, 0, {rows(a), back(1, 0), steps}, groups, c, sums.bias[0]);
    add_weights(0, work.joined_pairs + work.hidden_tiles * kTile, work.joined_tiles,
                work.embedding_tiles);
    const Term both[2] = {{rows(b), back(2, work.hidden_tiles), steps},
                          {rows(c), back(0, 0), steps}};
    const int tiles = work.embedding_tiles;
    const float* const cosine = work.cosine;
    float* const gradient = work.embedding_gradient;
    multiply_and_finish<Start::kZero>(
        groups, tiles / 2, both, nullptr,
        [=](int sample_group, int feature_group, const float* from) {
            for (int i = 0; i < 2; ++i) {
                const ptrdiff_t start =
                    ((2 * sample_group + i) * tiles + 2 * feature_group) * kSums;
                for (int j = 0; j < 2 * kSums; j += kLanes) {
                    store(gradient + start + j,
                          load(from + i * 2 * kSums + j) * load(cosine + start + j));
                }
            }
        });
    finish_embedding<kWithWeights>(shape, packed, work, count, grad_points, sums.frequency);
}

void backward(const NetworkShape& shape, const void* packed_memory, void* workspace,
              const float* grad_values, int count, float* grad_points, float* accumulator) {
    const PackedWeights packed(shape, const_cast<void*>(packed_memory));
    const Workspace work(shape, workspace);
    const Accumulator sums(shape, accumulator);
    start_slopes(work, grad_values, count);
    if (accumulator == nullptr) {
        backward_block<false>(shape, packed, work, count, grad_points, sums);
    } else {
        backward_block<true>(shape, packed, work, count, grad_points, sums);
    }
}

}  // namespace
}  // namespace meslam
