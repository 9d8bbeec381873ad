// Single precision on AVX-512: vectors of sixteen.
#include "backend.hpp"

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512bw,avx512dq," \
                                                   "avx512vl,avx2,fma"))),      \
                             apply_to = function)
#else
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")
#endif
#define MESLAM_VECTOR_BYTES 64
#define MESLAM_TILE_ROWS 12
#define MESLAM_TILE_VECTORS 2
#include "float_backend.hpp"

namespace meslam {

const Backend* avx512_backend() {
    static constexpr Backend backend = make_float_backend("avx512");
    return &backend;
}

}  // namespace meslam

#if defined(__clang__)
#pragma clang attribute pop
#endif

#else

namespace meslam {

const Backend* avx512_backend() { return nullptr; }

}  // namespace meslam

#endif
