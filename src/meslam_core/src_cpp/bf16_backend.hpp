// The field with bfloat16 products and single-precision sums. A backend_*.cpp defines MESLAM_BLOCK
// and, for tile instructions, MESLAM_USE_TILES, selects the instruction set and includes this.
#pragma once

#define MESLAM_VECTOR_BYTES 64
#include "bf16_backward.hpp"
#include "optimizer_steps.hpp"

namespace meslam {
namespace {

#if defined(MESLAM_USE_TILES)

struct TileConfiguration {
    uint8_t palette;
    uint8_t start_row;
    uint8_t reserved[14];
    uint16_t row_bytes[16];
    uint8_t rows[16];
};

// Other libraries use the tile registers too and may rely on the shapes that they have set.
void keep_thread_state(void* saved_state) {
    __asm__ volatile("sttilecfg %0" : "=m"(*static_cast<TileConfiguration*>(saved_state)));
    TileConfiguration full{};
    full.palette = 1;
    for (int i = 0; i < 8; ++i) {
        full.row_bytes[i] = 64;
        full.rows[i] = kSide;
    }
    __asm__ volatile("ldtilecfg %0" ::"m"(full));
}

void restore_thread_state(const void* saved_state) {
    const TileConfiguration* const saved = static_cast<const TileConfiguration*>(saved_state);
    if (saved->palette == 0) {
        __asm__ volatile("tilerelease");
    } else {
        __asm__ volatile("ldtilecfg %0" ::"m"(*saved));
    }
}

#else

void keep_thread_state(void*) {}
void restore_thread_state(const void*) {}

#endif

constexpr Backend make_bf16_backend(const char* name) {
    return {name,
            kBlock,
            packed_bytes,
            workspace_bytes,
            accumulator_floats,
            pack,
            keep_thread_state,
            restore_thread_state,
            forward,
            backward,
            collect,
            all_finite,
            adam};
}

}  // namespace
}  // namespace meslam
