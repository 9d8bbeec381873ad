// The way from points to values with bfloat16 products.
#pragma once

#include "backend.hpp"
#include "bf16_memory.hpp"

namespace meslam {
namespace {

// The number of groups of 32 samples that hold `count` samples.
MESLAM_INLINE int groups_of(int count) { return (count + kGroup - 1) / kGroup; }

template <bool kWithCosine, bool kWithPairs>
void embed(const NetworkShape& shape, const PackedWeights& packed, const Workspace& work,
           int groups) {
    const int e = shape.embedding;
    const int row_tiles = work.joined_tiles / 2;
    for (int j = 0; j < e; j += kGroup) {
        Vector b[3][2], phase[2];
        for (int half = 0; half < 2; ++half) {
            for (int axis = 0; axis < 3; ++axis) {
                b[axis][half] = load(packed.frequency + axis * e + j + half * kSide);
            }
            phase[half] = load(packed.phase + j + half * kSide);
        }
        const int feature_tile = work.hidden_tiles + j / kSide;
        Bf16* const rows = work.joined_rows + feature_tile / 2 * kTile;
        Bf16* const pairs = work.joined_pairs + feature_tile * kTile;
        float* const cosines = work.cosine + j / kSide * kSums;
        for (int s = 0; s < groups * kGroup; s += 2) {
            __m512i sines[2];
            for (int odd = 0; odd < 2; ++odd) {
                const int sample = s + odd;
                const float* const p = work.points + 4 * sample;
                Vector sine[2], cosine[2];
                for (int half = 0; half < 2; ++half) {
                    const Vector z =
                        p[0] * b[0][half] + (p[1] * b[1][half] + (p[2] * b[2][half] + phase[half]));
                    sine_and_cosine_of_pi(z, sine[half], cosine[half]);
                    if (kWithCosine) {
                        store(cosines + sample / kSide * work.embedding_tiles * kSums +
                                  half * kSums + sample % kSide * kSide,
                              cosine[half]);
                    }
                }
                sines[odd] = to_bf16((__m512)sine[0], (__m512)sine[1]);
                store_row(rows + sample / kSide * row_tiles * kTile, sample % kSide, sines[odd]);
            }
            if (kWithPairs) {
                Bf16* const tile = pairs + s / kGroup * work.joined_tiles * kTile;
                store_row(tile, s % kGroup / 2, _mm512_unpacklo_epi16(sines[0], sines[1]));
                store_row(tile + kTile, s % kGroup / 2, _mm512_unpackhi_epi16(sines[0], sines[1]));
            }
        }
    }
}

// One layer: relu of the sums in rows, and in pairs where the weights will be trained.
template <bool kWithPairs>
void hidden_layer(const PackedWeights& packed, const Workspace& work, int layer, const Factor& left,
                  int steps, int groups) {
    const Term terms[1] = {{left, {packed.forward[layer], ptrdiff_t{steps} * kTile, kTile}, steps}};
    const int row_tiles = work.row_tiles(layer), pair_tiles = work.pair_tiles(layer);
    Bf16* const rows = work.hidden_rows[layer];
    Bf16* const pairs = work.hidden_pairs[layer];
    multiply_and_finish<Start::kBias>(
        groups, work.hidden_tiles / 2, terms, packed.bias[layer],
        [=](int sample_group, int feature_group, const float* sums) {
            for (int row = 0; row < kGroup; row += 2) {
                const float* const from = sums + row / kSide * 2 * kSums + row % kSide * kSide;
                Bf16* const tile =
                    rows + ((2 * sample_group + row / kSide) * row_tiles + feature_group) * kTile;
                // As integers, positive bfloat16 numbers are positive and negative ones negative.
                const __m512i zero = _mm512_setzero_si512();
                const __m512i even = _mm512_max_epi16(
                    zero, to_bf16(_mm512_load_ps(from), _mm512_load_ps(from + kSums)));
                const __m512i odd = _mm512_max_epi16(
                    zero,
                    to_bf16(_mm512_load_ps(from + kSide), _mm512_load_ps(from + kSide + kSums)));
                store_row(tile, row % kSide, even);
                store_row(tile, row % kSide + 1, odd);
                if (kWithPairs) {
                    Bf16* const pair =
                        pairs + (sample_group * pair_tiles + 2 * feature_group) * kTile;
                    store_row(pair, row / 2, _mm512_unpacklo_epi16(even, odd));
                    store_row(pair + kTile, row / 2, _mm512_unpackhi_epi16(even, odd));
                }
            }
        });
}

// Sigmoid of the colours. Points that are not finite must show in the values: the largest of a
// bfloat16 NaN and zero may be zero.
void finish_values(const Workspace& work, int count, float* values) {
    for (int s = 0; s < count; ++s) {
        memcpy(work.values + 4 * s, work.narrow + s * kSide, 4 * sizeof(float));
    }
    for (int i = 0; i < 4 * count; i += kLanes) {
        const __m512 sums = _mm512_load_ps(work.values + i);
        const __m512 zeros = _mm512_load_ps(work.points + i) * 0.0f;
        __m512 mark = zeros + _mm512_permute_ps(zeros, 0xb1);
        mark = mark + _mm512_permute_ps(mark, 0x4e);
        const __m512 colors = (__m512)sigmoid((Vector)sums);
        _mm512_store_ps(work.values + i, _mm512_mask_blend_ps(0x1111, colors, sums) + mark);
    }
    memcpy(values, work.values, 4 * sizeof(float) * count);
}

template <bool kWithCosine, bool kWithPairs>
void forward_block(const NetworkShape& shape, const PackedWeights& packed, const Workspace& work,
                   int count, float* values) {
    const int groups = groups_of(count);
    embed<kWithCosine, kWithPairs>(shape, packed, work, groups);
    const int hidden_steps = work.hidden_tiles / 2, embedding_steps = work.embedding_tiles / 2;
    const ptrdiff_t hidden_side = ptrdiff_t{hidden_steps} * kTile;
    const ptrdiff_t joined_side = hidden_side + ptrdiff_t{embedding_steps} * kTile;
    const Factor embedded{work.joined_rows + hidden_side, joined_side, kTile};
    const Factor joined{work.joined_rows, joined_side, kTile};
    hidden_layer<kWithPairs>(packed, work, 0, embedded, embedding_steps, groups);
    hidden_layer<kWithPairs>(packed, work, 1, {work.hidden_rows[0], hidden_side, kTile},
                             hidden_steps, groups);
    hidden_layer<kWithPairs>(packed, work, 2, joined, hidden_steps + embedding_steps, groups);
    hidden_layer<kWithPairs>(packed, work, 3, {work.hidden_rows[2], hidden_side, kTile},
                             hidden_steps, groups);
    for (int group = 0; group < groups; ++group) {
        const Factor left{work.hidden_rows[3] + 2 * group * hidden_side, hidden_side, kTile};
        const Term term[1] = {{left, {packed.forward[4], 0, kTile}, hidden_steps}};
        multiply_group<2, 1, 1, Start::kBias>(term, packed.bias[4], work.narrow + 2 * group * kSums,
                                              kSums);
    }
    finish_values(work, count, values);
}

void forward(const NetworkShape& shape, const void* packed_memory, void* workspace,
             const float* points, int count, Keep keep, float* values) {
    const PackedWeights packed(shape, const_cast<void*>(packed_memory));
    const Workspace work(shape, workspace);
    memset(work.points, 0, 4 * sizeof(float) * groups_of(count) * kGroup);
    for (int s = 0; s < count; ++s) {
        memcpy(work.points + 4 * s, points + 3 * s, 3 * sizeof(float));
    }
    if (keep == Keep::kAll) {
        forward_block<true, true>(shape, packed, work, count, values);
    } else if (keep == Keep::kSlopes) {
        forward_block<true, false>(shape, packed, work, count, values);
    } else {
        forward_block<false, false>(shape, packed, work, count, values);
    }
}

}  // namespace
}  // namespace meslam
