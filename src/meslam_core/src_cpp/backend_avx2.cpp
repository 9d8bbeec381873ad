// Single precision on AVX2 with FMA: vectors of eight.
#include "backend.hpp"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC target("avx2,fma")
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

#else

namespace meslam {

const Backend* avx2_backend() { return nullptr; }

}  // namespace meslam

#endif
