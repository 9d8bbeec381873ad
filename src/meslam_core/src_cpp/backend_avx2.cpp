// Single precision on AVX2 with FMA: vectors of eight.
#include "backend.hpp"

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif
#define MESLAM_VECTOR_BYTES 32
#define MESLAM_TILE_ROWS 6
#define MESLAM_TILE_VECTORS 2
#include "float_backend.hpp"

namespace meslam {

const Backend* avx2_backend() {
    static constexpr Backend backend = make_float_backend("avx2");
    return &backend;
}

}  // namespace meslam

#if defined(__clang__)
#pragma clang attribute pop
#endif

#else

namespace meslam {

const Backend* avx2_backend() { return nullptr; }

}  // namespace meslam

#endif
