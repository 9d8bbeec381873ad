// Memory aligned for the widest vectors and tiles.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>

namespace meslam {

template <class T>
class AlignedArray {
public:
    AlignedArray() = default;

    // Filled with zero bytes.
    explicit AlignedArray(size_t count) : count_(count) {
        const size_t bytes = (count * sizeof(T) + 63) / 64 * 64 + 64;
        memory_.reset(static_cast<T*>(std::aligned_alloc(64, bytes)));
        if (memory_ == nullptr) throw std::bad_alloc();
        std::memset(static_cast<void*>(memory_.get()), 0, bytes);
    }

    T* data() { return memory_.get(); }
    const T* data() const { return memory_.get(); }
    size_t size() const { return count_; }

private:
    struct Free {
        void operator()(T* memory) const { std::free(memory); }
    };
    size_t count_ = 0;
    std::unique_ptr<T, Free> memory_;
};

}  // namespace meslam
