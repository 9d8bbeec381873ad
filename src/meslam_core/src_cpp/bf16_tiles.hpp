// Tiles of bfloat16 numbers, 1 KiB each, and how vectors get in and out of them.
//
// Three layouts, all a sequence of tiles of 16 rows of 64 bytes:
//   rows     16 samples by 32 features; left factor of the layers' products
//   pairs    32 samples by 16 features, samples 2k and 2k+1 interleaved in row k; right factor of
//            the weights' gradients
//   columns  16 features by 32 samples; left factor of the weights' gradients
// In pairs and columns the features of each group of 32 come in the order that the cheap
// interleaving of 128-bit lanes leaves: tile 0 has 0-3, 8-11, 16-19, 24-27, tile 1 the others. The
// gradients' accumulators have that order too; `collect` undoes it.
#pragma once

// GCC's own intrinsics leave registers undefined on purpose and then warn of them.
#if !defined(__clang__)
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif
#include <immintrin.h>

#include "vector_math.hpp"

namespace meslam {
namespace {

typedef uint16_t Bf16;

constexpr int kTile = 512;  // numbers of a bfloat16 tile
constexpr int kSums = 256;  // numbers of a single-precision tile, 16 by 16
constexpr int kSide = 16;   // rows of a tile
constexpr int kGroup = 32;  // samples or features handled together: two tiles' sides

// low in the lower half.
MESLAM_INLINE __m512i to_bf16(__m512 low, __m512 high) {
    return (__m512i)_mm512_cvtne2ps_pbh(high, low);
}

MESLAM_INLINE __m512i load_row(const Bf16* tile, int row) {
    return _mm512_load_si512(tile + row * kGroup);
}

MESLAM_INLINE void store_row(Bf16* tile, int row, __m512i numbers) {
    _mm512_store_si512(tile + row * kGroup, numbers);
}

// 16 by 16 transposition of 32-bit elements: pairs to columns, and weights to right factors.
MESLAM_INLINE void transpose_tile(const Bf16* from, Bf16* to) {
    __m512i a[16], b[16];
    MESLAM_UNROLL
    for (int i = 0; i < 16; ++i) a[i] = load_row(from, i);
    MESLAM_UNROLL
    for (int i = 0; i < 8; ++i) {
        b[2 * i] = _mm512_unpacklo_epi32(a[2 * i], a[2 * i + 1]);
        b[2 * i + 1] = _mm512_unpackhi_epi32(a[2 * i], a[2 * i + 1]);
    }
    MESLAM_UNROLL
    for (int i = 0; i < 4; ++i) {
        a[4 * i] = _mm512_unpacklo_epi64(b[4 * i], b[4 * i + 2]);
        a[4 * i + 1] = _mm512_unpackhi_epi64(b[4 * i], b[4 * i + 2]);
        a[4 * i + 2] = _mm512_unpacklo_epi64(b[4 * i + 1], b[4 * i + 3]);
        a[4 * i + 3] = _mm512_unpackhi_epi64(b[4 * i + 1], b[4 * i + 3]);
    }
    MESLAM_UNROLL
    for (int i = 0; i < 4; ++i) {
        b[i] = _mm512_shuffle_i32x4(a[i], a[i + 4], 0x88);
        b[i + 4] = _mm512_shuffle_i32x4(a[i], a[i + 4], 0xdd);
        b[i + 8] = _mm512_shuffle_i32x4(a[i + 8], a[i + 12], 0x88);
        b[i + 12] = _mm512_shuffle_i32x4(a[i + 8], a[i + 12], 0xdd);
    }
    MESLAM_UNROLL
    for (int i = 0; i < 8; ++i) {
        store_row(to, i, _mm512_shuffle_i32x4(b[i], b[i + 8], 0x88));
        store_row(to, i + 8, _mm512_shuffle_i32x4(b[i], b[i + 8], 0xdd));
    }
}

// Right factor (inputs, outputs) of a layer: tile (n, k) has outputs 16n.. and inputs 32k.., at
// to + (n * inputs / 32 + k) * kTile. weight is (outputs, inputs).
void pack_forward(const float* weight, int outputs, int inputs, Bf16* to) {
    alignas(64) Bf16 tile[kTile];
    for (int n = 0; n < outputs; n += kSide) {
        for (int k = 0; k < inputs; k += kGroup, to += kTile) {
            for (int row = 0; row < kSide; ++row) {
                const float* const from = weight + (n + row) * inputs + k;
                store_row(tile, row, to_bf16(_mm512_loadu_ps(from), _mm512_loadu_ps(from + 16)));
            }
            transpose_tile(tile, to);
        }
    }
}

// Right factor (outputs, inputs) of the way back: tile (n, k) has inputs 16n.. and outputs 32k..,
// at to + (n * outputs / 32 + k) * kTile.
void pack_backward(const float* weight, int outputs, int inputs, Bf16* to) {
    alignas(64) static const int16_t kFirst[32] = {0,  32, 1,  33, 2,  34, 3,  35, 4,  36, 5,
                                                   37, 6,  38, 7,  39, 8,  40, 9,  41, 10, 42,
                                                   11, 43, 12, 44, 13, 45, 14, 46, 15, 47};
    const __m512i first = _mm512_load_si512(kFirst);
    const __m512i second = _mm512_add_epi16(first, _mm512_set1_epi16(16));
    const ptrdiff_t steps = outputs / kGroup;
    for (int n = 0; n < inputs; n += kGroup) {
        for (int k = 0; k < outputs; k += kGroup) {
            Bf16* const tile = to + (n / kSide * steps + k / kGroup) * kTile;
            for (int row = 0; row < kSide; ++row) {
                const float* const even = weight + (k + 2 * row) * inputs + n;
                const float* const odd = even + inputs;
                const __m512i a = to_bf16(_mm512_loadu_ps(even), _mm512_loadu_ps(even + 16));
                const __m512i b = to_bf16(_mm512_loadu_ps(odd), _mm512_loadu_ps(odd + 16));
                store_row(tile, row, _mm512_permutex2var_epi16(a, first, b));
                store_row(tile + steps * kTile, row, _mm512_permutex2var_epi16(a, second, b));
            }
        }
    }
}

// gradient (rows, columns) += the accumulator's tiles, put back in order.
void collect_tiles(const float* sums, int rows, int columns, float* gradient) {
    const __m512i first = _mm512_setr_epi32(0, 1, 2, 3, 16, 17, 18, 19, 4, 5, 6, 7, 20, 21, 22, 23);
    const __m512i second = _mm512_add_epi32(first, _mm512_set1_epi32(8));
    for (int row = 0; row < rows; ++row) {
        const int half = row / 4 % 2, place = row % kGroup / 8 * 4 + row % 4;
        const float* from =
            sums + (row / kGroup * 2 + half) * ptrdiff_t{columns} * kSide + place * kSide;
        float* const to = gradient + row * ptrdiff_t{columns};
        for (int column = 0; column < columns; column += kGroup, from += 2 * kSums) {
            const __m512 a = _mm512_load_ps(from), b = _mm512_load_ps(from + kSums);
            const __m512 low = _mm512_permutex2var_ps(a, first, b);
            const __m512 high = _mm512_permutex2var_ps(a, second, b);
            _mm512_storeu_ps(to + column, low + _mm512_loadu_ps(to + column));
            _mm512_storeu_ps(to + column + 16, high + _mm512_loadu_ps(to + column + 16));
        }
    }
}

}  // namespace
}  // namespace meslam
