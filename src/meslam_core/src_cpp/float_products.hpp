// Register-tiled single-precision products, for the including file's instruction set.
#pragma once

#include "vector_math.hpp"

namespace meslam {
namespace {

// Vectors of one row that a tile holds; a packed panel of a right factor is as wide.
constexpr int kTileVectors = MESLAM_TILE_VECTORS;
constexpr int kTileRows = MESLAM_TILE_ROWS;
constexpr int kPanel = kTileVectors * kLanes;

enum class Epilogue {
    kStore,       // c = a b
    kBias,        // c = a b + bias
    kBiasRelu,    // c = relu(a b + bias)
    kGate,        // c = a b where the kept activation is positive, else 0
    kAccumulate,  // c += a b
};

// The left factor is read one number at a time, so its two strides are free: the transpose of a
// matrix is the same matrix with the strides exchanged.
struct Left {
    const float* start;
    ptrdiff_t row;
    ptrdiff_t depth;
};

// The right factor is read in vectors along its columns; `panel` leads from one panel of columns to
// the next.
struct Right {
    const float* start;
    ptrdiff_t depth;
    ptrdiff_t panel;
};

// `extra` is the bias (row stride 0) or the activation that gates.
struct Target {
    float* start;
    ptrdiff_t row;
    const float* extra;
    ptrdiff_t extra_row;
};

template <Epilogue kEpilogue, int kRows, int kVectors>
MESLAM_INLINE void multiply_tile(const Left& left, const float* right, ptrdiff_t right_depth,
                                 int depth, float* target, ptrdiff_t target_row, const float* extra,
                                 ptrdiff_t extra_row) {
    Vector sums[kRows][kVectors];
    MESLAM_UNROLL
    for (int i = 0; i < kRows; ++i) {
        MESLAM_UNROLL
        for (int j = 0; j < kVectors; ++j) {
            if (kEpilogue == Epilogue::kBias || kEpilogue == Epilogue::kBiasRelu) {
                sums[i][j] = load(extra + j * kLanes);
            } else {
                sums[i][j] = Vector{};
            }
        }
    }
    const float* a = left.start;
    for (int k = 0; k < depth; ++k) {
        Vector b[kVectors];
        MESLAM_UNROLL
        for (int j = 0; j < kVectors; ++j) b[j] = load(right + j * kLanes);
        MESLAM_UNROLL
        for (int i = 0; i < kRows; ++i) {
            const Vector factor = broadcast(a[i * left.row]);
            MESLAM_UNROLL
            for (int j = 0; j < kVectors; ++j) sums[i][j] += factor * b[j];
        }
        a += left.depth;
        right += right_depth;
    }
    MESLAM_UNROLL
    for (int i = 0; i < kRows; ++i) {
        MESLAM_UNROLL
        for (int j = 0; j < kVectors; ++j) {
            float* to = target + i * target_row + j * kLanes;
            Vector sum = sums[i][j];
            if (kEpilogue == Epilogue::kBiasRelu) sum = relu(sum);
            if (kEpilogue == Epilogue::kAccumulate) sum += load(to);
            if (kEpilogue == Epilogue::kGate) {
                sum = load(extra + i * extra_row + j * kLanes) > 0.0f ? sum : Vector{};
            }
            store(to, sum);
        }
    }
}

// One panel of columns, all rows: full tiles, then the rest in tiles of 4, 2 and 1 rows.
template <Epilogue kEpilogue, int kRows, int kVectors>
MESLAM_INLINE void multiply_rows(int& row, int rows, const Left& left, const Right& right,
                                 int depth, const float* right_start, const Target& target,
                                 int column) {
    for (; row + kRows <= rows; row += kRows) {
        const Left here{left.start + row * left.row, left.row, left.depth};
        const float* extra =
            target.extra == nullptr ? nullptr : target.extra + row * target.extra_row + column;
        multiply_tile<kEpilogue, kRows, kVectors>(here, right_start, right.depth, depth,
                                                  target.start + row * target.row + column,
                                                  target.row, extra, target.extra_row);
    }
}

// target (rows, columns) = left (rows, depth) right (depth, columns); columns is a multiple of
// kVectors * kLanes.
template <Epilogue kEpilogue, int kVectors = kTileVectors>
__attribute__((noinline)) void multiply(int rows, int columns, int depth, Left left, Right right,
                                        Target target) {
    const float* panel = right.start;
    for (int column = 0; column < columns; column += kVectors * kLanes, panel += right.panel) {
        int row = 0;
        multiply_rows<kEpilogue, kTileRows, kVectors>(row, rows, left, right, depth, panel, target,
                                                      column);
        if (kTileRows > 4) {
            multiply_rows<kEpilogue, 4, kVectors>(row, rows, left, right, depth, panel, target,
                                                  column);
        }
        multiply_rows<kEpilogue, 2, kVectors>(row, rows, left, right, depth, panel, target, column);
        multiply_rows<kEpilogue, 1, kVectors>(row, rows, left, right, depth, panel, target, column);
    }
}

// to += the sums of the columns of from (rows, columns).
void add_column_sums(const float* from, ptrdiff_t row_stride, int rows, int columns, float* to) {
    for (int column = 0; column < columns; column += kLanes) {
        Vector sum = load(to + column);
        for (int row = 0; row < rows; ++row) sum += load(from + row * row_stride + column);
        store(to + column, sum);
    }
}

// Packs the matrix whose element (k, n) is from[k * depth_stride + n * column_stride] in panels.
void pack_panels(const float* from, int depth, int columns, ptrdiff_t depth_stride,
                 ptrdiff_t column_stride, float* to) {
    for (int first = 0; first < columns; first += kPanel) {
        for (int k = 0; k < depth; ++k) {
            for (int n = first; n < first + kPanel; ++n) {
                *to++ = from[k * depth_stride + n * column_stride];
            }
        }
    }
}

}  // namespace
}  // namespace meslam
