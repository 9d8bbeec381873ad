#include "network_shape.hpp"

#include <stdexcept>
#include <string>

namespace meslam {

NetworkShape make_network_shape(int width, int embedding) {
    if (width != 64 && width != 128 && width != 256) {
        throw std::invalid_argument("width is " + std::to_string(width) +
                                    "; the kernel has 64, 128 and 256");
    }
    if (embedding < 32 || embedding > 512 || embedding % 32 != 0) {
        throw std::invalid_argument("embedding is " + std::to_string(embedding) +
                                    "; the kernel takes multiples of 32 from 32 to 512");
    }
    NetworkShape shape{};
    shape.width = width;
    shape.embedding = embedding;
    const size_t w = static_cast<size_t>(width);
    const size_t e = static_cast<size_t>(embedding);
    size_t next = 0;
    const auto place = [&next](size_t count) {
        const size_t start = next;
        next += count;
        return start;
    };
    shape.frequency = place(3 * e);
    shape.phase = place(e);
    shape.weight1 = place(w * e);
    shape.bias1 = place(w);
    shape.weight2 = place(w * w);
    shape.bias2 = place(w);
    shape.weight3 = place(w * (w + e));
    shape.bias3 = place(w);
    shape.weight4 = place(w * w);
    shape.bias4 = place(w);
    shape.weight5 = place(4 * w);
    shape.bias5 = place(4);
    shape.parameters = next;
    return shape;
}

}  // namespace meslam
