// Hands out consecutive 64-byte aligned arrays of one allocation.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace meslam {
namespace {

// From null it only counts: `next` is then the size.
struct Arena {
    uintptr_t next;

    explicit Arena(const void* start) : next(reinterpret_cast<uintptr_t>(start)) {}

    template <class T = float>
    T* take(size_t count) {
        T* const start = reinterpret_cast<T*>(next);
        next += (count * sizeof(T) + 63) / 64 * 64;
        return start;
    }
};

}  // namespace
}  // namespace meslam
