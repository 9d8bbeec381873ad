// The network's sizes and where each of its parameters starts in the flat vector.
#pragma once

#include <stddef.h>

namespace meslam {

// Plain data on purpose: this header is read by files compiled for different instruction sets, and
// an inline function shared by them could be linked in the version the CPU does not have.
struct NetworkShape {
    int width;
    int embedding;
    // Starts in the flat float32 vector, in its order: B (E,3), phi (E), W1 (W,E), b1, W2 (W,W),
    // b2, W3 (W,W+E) with the columns of h2 first, b3, W4 (W,W), b4, W5 (4,W), b5 (4).
    size_t frequency, phase;
    size_t weight1, bias1;
    size_t weight2, bias2;
    size_t weight3, bias3;
    size_t weight4, bias4;
    size_t weight5, bias5;
    size_t parameters;
};

// Throws std::invalid_argument for sizes that the kernel has no code for.
NetworkShape make_network_shape(int width, int embedding);

}  // namespace meslam
