// Bfloat16 by AVX-512's dot products of pairs.
#include "backend.hpp"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx2,fma")
#define MESLAM_BLOCK 64
#include "bf16_backend.hpp"

namespace meslam {

const Backend* avx512bf16_backend() {
    static constexpr Backend backend = make_bf16_backend("avx512bf16");
    return &backend;
}

}  // namespace meslam

#else

namespace meslam {

const Backend* avx512bf16_backend() { return nullptr; }

}  // namespace meslam

#endif
