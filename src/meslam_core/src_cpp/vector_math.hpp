// Short vectors and the functions of the field over them, for the instruction set of the including
// file, which defines MESLAM_VECTOR_BYTES. Everything has internal linkage: the same names exist
// once for each instruction set.
#pragma once

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define MESLAM_INLINE inline __attribute__((always_inline))
// Sums live in registers only if the loops over them are gone before registers are assigned.
#define MESLAM_UNROLL _Pragma("GCC unroll 16")

namespace meslam {
namespace {

constexpr int kLanes = MESLAM_VECTOR_BYTES / 4;

typedef float Vector __attribute__((vector_size(MESLAM_VECTOR_BYTES), may_alias));
typedef int32_t IntVector __attribute__((vector_size(MESLAM_VECTOR_BYTES), may_alias));
typedef float UnalignedVector
    __attribute__((vector_size(MESLAM_VECTOR_BYTES), aligned(4), may_alias));

MESLAM_INLINE Vector load(const float* from) {
    return *reinterpret_cast<const UnalignedVector*>(from);
}

MESLAM_INLINE void store(float* to, Vector value) {
    *reinterpret_cast<UnalignedVector*>(to) = value;
}

MESLAM_INLINE Vector broadcast(float value) { return value - Vector{}; }

MESLAM_INLINE Vector relu(Vector x) { return x < 0.0f ? Vector{} : x; }

MESLAM_INLINE Vector clamp(Vector x, float low, float high) {
    x = x < low ? broadcast(low) : x;
    return x > high ? broadcast(high) : x;
}

// Adding this number leaves the integer nearest to x in the low bits of the sum.
constexpr float kRounder = 12582912.0f;

// sin(pi x) and cos(pi x): x less its nearest integer, odd and even minimax polynomials on
// [-1/2, 1/2] with errors of 3e-9 and 5e-8, and the sign of the integer's parity.
MESLAM_INLINE void sine_and_cosine_of_pi(Vector x, Vector& sine, Vector& cosine) {
    const Vector rounded = x + kRounder;
    const IntVector sign = reinterpret_cast<IntVector>(rounded) << 31;
    const Vector r = x - (rounded - kRounder);
    const Vector u = r * r;
    const Vector s =
        r * (3.141592580e+00f +
             u * (-5.167706879e+00f +
                  u * (2.550031377e+00f + u * (-5.980451718e-01f + u * 7.722012434e-02f))));
    const Vector c = 9.999999535e-01f +
                     u * (-4.934792859e+00f +
                          u * (4.058411915e+00f + u * (-1.331880163e+00f + u * 2.196967985e-01f)));
    sine = reinterpret_cast<Vector>(reinterpret_cast<IntVector>(s) ^ sign);
    cosine = reinterpret_cast<Vector>(reinterpret_cast<IntVector>(c) ^ sign);
}

// The logit is clamped to +-20, where the sigmoid is 2e-9 from its limit.
MESLAM_INLINE Vector sigmoid(Vector x) {
    const Vector t = clamp(x, -20.0f, 20.0f) * -1.44269504f;
    const Vector rounded = t + kRounder;
    const IntVector exponent = (reinterpret_cast<IntVector>(rounded) << 23) + (127 << 23);
    const Vector r = t - (rounded - kRounder);
    const Vector power =
        1.000000072e+00f +
        r * (6.931469671e-01f +
             r * (2.402211972e-01f +
                  r * (5.550713276e-02f + r * (9.675541535e-03f + r * 1.327647178e-03f))));
    return 1.0f / (1.0f + power * reinterpret_cast<Vector>(exponent));
}

}  // namespace
}  // namespace meslam
