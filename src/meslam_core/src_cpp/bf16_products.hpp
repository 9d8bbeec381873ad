// Products of bfloat16 tiles with single-precision sums, by tile instructions (where the including
// file defines MESLAM_USE_TILES) or by dot products of pairs.
#pragma once

#include "bf16_tiles.hpp"

namespace meslam {
namespace {

// Tile (i, k) of a factor lies at start + i * side + k * depth; i counts rows of a left factor and
// columns of a right one.
struct Factor {
    const Bf16* start;
    ptrdiff_t side;
    ptrdiff_t depth;

    Factor at(int i) const { return {start + i * side, side, depth}; }
};

// A product of two factors over `steps` tiles of depth.
struct Term {
    Factor left;
    Factor right;
    int steps;
};

enum class Start { kZero, kBias, kSums };

#if defined(MESLAM_USE_TILES)

// The compiler does not know that these touch memory unless it is told: <amxtileintrin.h> does not.
template <int kRegister>
MESLAM_INLINE void load_tile(const void* from, ptrdiff_t stride) {
    __asm__ volatile("tileloadd (%0,%1,1), %%tmm%c2" ::"r"(from), "r"(stride), "i"(kRegister)
                     : "memory");
}

template <int kRegister>
MESLAM_INLINE void store_tile(void* to, ptrdiff_t stride) {
    __asm__ volatile("tilestored %%tmm%c2, (%0,%1,1)" ::"r"(to), "r"(stride), "i"(kRegister)
                     : "memory");
}

template <int kRegister>
MESLAM_INLINE void clear_tile() {
    __asm__ volatile("tilezero %%tmm%c0" ::"i"(kRegister));
}

template <int kSumsRegister, int kLeft, int kRight>
MESLAM_INLINE void multiply_tiles() {
    __asm__ volatile("tdpbf16ps %%tmm%c2, %%tmm%c1, %%tmm%c0" ::"i"(kSumsRegister), "i"(kLeft),
                     "i"(kRight));
}

// Registers 0 to 3 sum, 4 and 5 are the left factor's rows, 6 and 7 the right one's columns.
template <int kRows, int kColumns, int kTerms, Start kStart>
MESLAM_INLINE void multiply_group(const Term* terms, const float* bias, float* sums,
                                  ptrdiff_t sums_row) {
    constexpr ptrdiff_t kStride = 64;
    if (kStart == Start::kZero) {
        clear_tile<0>();
        if (kColumns > 1) clear_tile<1>();
        if (kRows > 1) clear_tile<2>();
        if (kRows > 1 && kColumns > 1) clear_tile<3>();
    } else {
        // A row stride of zero repeats the bias in every row.
        const ptrdiff_t stride = kStart == Start::kBias ? 0 : kStride;
        const float* const top = kStart == Start::kBias ? bias : sums;
        const float* const bottom = kStart == Start::kBias ? bias : sums + sums_row;
        constexpr int kNext = kStart == Start::kBias ? kSide : kSums;
        load_tile<0>(top, stride);
        if (kColumns > 1) load_tile<1>(top + kNext, stride);
        if (kRows > 1) load_tile<2>(bottom, stride);
        if (kRows > 1 && kColumns > 1) load_tile<3>(bottom + kNext, stride);
    }
    for (int term = 0; term < kTerms; ++term) {
        const Factor& left = terms[term].left;
        const Factor& right = terms[term].right;
        const Bf16* a = left.start;
        const Bf16* b = right.start;
        for (int k = 0; k < terms[term].steps; ++k, a += left.depth, b += right.depth) {
            load_tile<6>(b, kStride);
            load_tile<4>(a, kStride);
            multiply_tiles<0, 4, 6>();
            if (kRows > 1) {
                load_tile<5>(a + left.side, kStride);
                multiply_tiles<2, 5, 6>();
            }
            if (kColumns > 1) {
                load_tile<7>(b + right.side, kStride);
                multiply_tiles<1, 4, 7>();
                if (kRows > 1) multiply_tiles<3, 5, 7>();
            }
        }
    }
    store_tile<0>(sums, kStride);
    if (kColumns > 1) store_tile<1>(sums + kSums, kStride);
    if (kRows > 1) store_tile<2>(sums + sums_row, kStride);
    if (kRows > 1 && kColumns > 1) store_tile<3>(sums + sums_row + kSums, kStride);
}

#else

// Eight rows of sums at a time stay in registers.
template <int kRows, int kColumns, int kTerms, Start kStart>
MESLAM_INLINE void multiply_group(const Term* terms, const float* bias, float* sums,
                                  ptrdiff_t sums_row) {
    constexpr int kAtOnce = 8;
    for (int first = 0; first < kRows * kSide; first += kAtOnce) {
        const int row_tile = first / kSide, row = first % kSide;
        float* const to = sums + row_tile * sums_row + row * kSide;
        __m512 sum[kAtOnce][kColumns];
        MESLAM_UNROLL
        for (int i = 0; i < kAtOnce; ++i) {
            MESLAM_UNROLL
            for (int j = 0; j < kColumns; ++j) {
                if (kStart == Start::kZero) sum[i][j] = _mm512_setzero_ps();
                if (kStart == Start::kBias) sum[i][j] = _mm512_loadu_ps(bias + j * kSide);
                if (kStart == Start::kSums) sum[i][j] = _mm512_load_ps(to + j * kSums + i * kSide);
            }
        }
        for (int term = 0; term < kTerms; ++term) {
            const Factor& left = terms[term].left;
            const Factor& right = terms[term].right;
            const Bf16* a = left.start + row_tile * left.side + row * kGroup;
            const Bf16* b = right.start;
            for (int k = 0; k < terms[term].steps; ++k, a += left.depth, b += right.depth) {
                for (int pair = 0; pair < kSide; ++pair) {
                    __m512bh right_pairs[kColumns];
                    MESLAM_UNROLL
                    for (int j = 0; j < kColumns; ++j) {
                        right_pairs[j] = (__m512bh)load_row(b + j * right.side, pair);
                    }
                    MESLAM_UNROLL
                    for (int i = 0; i < kAtOnce; ++i) {
                        int32_t numbers;
                        memcpy(&numbers, a + i * kGroup + 2 * pair, sizeof numbers);
                        const __m512bh left_pair = (__m512bh)_mm512_set1_epi32(numbers);
                        MESLAM_UNROLL
                        for (int j = 0; j < kColumns; ++j) {
                            sum[i][j] = _mm512_dpbf16_ps(sum[i][j], left_pair, right_pairs[j]);
                        }
                    }
                }
            }
        }
        MESLAM_UNROLL
        for (int i = 0; i < kAtOnce; ++i) {
            MESLAM_UNROLL
            for (int j = 0; j < kColumns; ++j) {
                _mm512_store_ps(to + j * kSums + i * kSide, sum[i][j]);
            }
        }
    }
}

#endif

// For every group of 32 rows and 32 columns: its sums, then finish(row_group, column_group, sums).
// A group's products are started before the previous group is finished, so that the tile unit and
// the vector units work at the same time.
template <Start kStart, int kTerms = 1, class Finish>
MESLAM_INLINE void multiply_and_finish(int row_groups, int column_groups,
                                       const Term (&terms)[kTerms], const float* bias,
                                       Finish finish) {
    alignas(64) float sums[2][4 * kSums];
    int last_row = 0, last_column = 0, parity = 0;
    bool pending = false;
    for (int column = 0; column < column_groups; ++column) {
        for (int row = 0; row < row_groups; ++row) {
            Term here[kTerms];
            for (int i = 0; i < kTerms; ++i) {
                here[i] = {terms[i].left.at(2 * row), terms[i].right.at(2 * column),
                           terms[i].steps};
            }
            multiply_group<2, 2, kTerms, kStart>(
                here, bias == nullptr ? nullptr : bias + column * kGroup, sums[parity], 2 * kSums);
            if (pending) finish(last_row, last_column, sums[1 - parity]);
            pending = true;
            last_row = row;
            last_column = column;
            parity = 1 - parity;
        }
    }
    if (pending) finish(last_row, last_column, sums[1 - parity]);
}

// sums (rows, columns; tiles in rows of `columns` tiles) += left right. With kRows 1 the left
// factor is one row of tiles.
template <int kRows>
void accumulate(int row_tiles, int column_tiles, const Term& term, float* sums) {
    const ptrdiff_t sums_row = ptrdiff_t{column_tiles} * kSums;
    for (int row = 0; row < row_tiles; row += kRows) {
        for (int column = 0; column < column_tiles; column += 2) {
            const Term here[1] = {{term.left.at(row), term.right.at(column), term.steps}};
            multiply_group<kRows, 2, 1, Start::kSums>(
                here, nullptr, sums + row * sums_row + column * kSums, sums_row);
        }
    }
}

}  // namespace
}  // namespace meslam
