// Bfloat16 by AMX tiles.
#include "backend.hpp"

#if defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 11)
#include <immintrin.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("amx-tile,amx-bf16,avx512f,avx512bw,"       \
                                                   "avx512dq,avx512vl,avx512bf16,avx2,fma"))), \
                             apply_to = function)
#else
#pragma GCC target("amx-tile,amx-bf16,avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx2,fma")
#endif
#define MESLAM_USE_TILES
#define MESLAM_BLOCK 192
#include "bf16_backend.hpp"

namespace meslam {

const Backend* amx_backend() {
    static constexpr Backend backend = make_bf16_backend("amx");
    return &backend;
}

}  // namespace meslam

#if defined(__clang__)
#pragma clang attribute pop
#endif

#else

namespace meslam {

const Backend* amx_backend() { return nullptr; }

}  // namespace meslam

#endif
