// Single precision on vectors of four, which every 64-bit CPU has (SSE2, NEON).
#define MESLAM_VECTOR_BYTES 16
#if defined(__aarch64__)
#define MESLAM_TILE_ROWS 6
#define MESLAM_TILE_VECTORS 4
#else
#define MESLAM_TILE_ROWS 4
#define MESLAM_TILE_VECTORS 2
#endif
#include "float_backend.hpp"

namespace meslam {

const Backend* portable_backend() {
    static constexpr Backend backend = make_float_backend("portable");
    return &backend;
}

}  // namespace meslam
