// Bfloat16 by AVX-512's dot products of pairs.
#include "backend.hpp"

#if defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 11)
#include <immintrin.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512bw,avx512dq,"       \
                                                   "avx512vl,avx512bf16,avx2,fma"))), \
                             apply_to = function)
#else
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx2,fma")
#endif
#define MESLAM_BLOCK 64
#include "bf16_backend.hpp"

namespace meslam {

const Backend* avx512bf16_backend() {
    static constexpr Backend backend = make_bf16_backend("avx512bf16");
    return &backend;
}

}  // namespace meslam

#if defined(__clang__)
#pragma clang attribute pop
#endif

#else

namespace meslam {

const Backend* avx512bf16_backend() { return nullptr; }

}  // namespace meslam

#endif
