// Flushing of denormal numbers to zero.
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

namespace meslam {

// For the lifetime of the object, on its thread. The moments of weights that no longer learn decay
// to denormal numbers and stay there; each of them would cost a hundred cycles in every step.
class FlushDenormals {
public:
#if defined(__x86_64__)
    FlushDenormals() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ | 0x8040u); }
    ~FlushDenormals() { _mm_setcsr(saved_); }
#elif defined(__aarch64__)
    FlushDenormals() {
        __asm__ volatile("mrs %0, fpcr" : "=r"(saved_));
        const uint64_t flushing = saved_ | (uint64_t{1} << 24);
        __asm__ volatile("msr fpcr, %0" ::"r"(flushing));
    }
    ~FlushDenormals() { __asm__ volatile("msr fpcr, %0" ::"r"(saved_)); }
#else
    FlushDenormals() = default;
    ~FlushDenormals() = default;
#endif
    FlushDenormals(const FlushDenormals&) = delete;
    FlushDenormals& operator=(const FlushDenormals&) = delete;

private:
#if defined(__x86_64__)
    unsigned int saved_;
#elif defined(__aarch64__)
    uint64_t saved_;
#endif
};

}  // namespace meslam
