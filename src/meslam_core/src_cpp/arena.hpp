// Hands out consecutive 64-byte aligned arrays of one allocation.
#pragma once

#include <stddef.h>

namespace meslam {
namespace {

// With a null start it only counts: `next` is then the size.
struct Arena {
    char* next;

    template <class T = float>
    T* take(size_t count) {
        T* const start = reinterpret_cast<T*>(next);
        next += (count * sizeof(T) + 63) / 64 * 64;
        return start;
    }
};

}  // namespace
}  // namespace meslam
