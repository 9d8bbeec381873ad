#include "cpu_features.hpp"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <stdexcept>

#if defined(__x86_64__)
#include <cpuid.h>
#endif
#if defined(__x86_64__) && defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace meslam {
namespace {

struct CpuFeatures {
    bool avx2 = false;
    bool avx512 = false;
    bool avx512bf16 = false;
    bool amx = false;
    // AMD multiplies bfloat16 pairs at twice the rate of single precision, Intel at half of it.
    bool fast_pairs = false;
};

#if defined(__x86_64__)

uint64_t enabled_register_states() {
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (static_cast<uint64_t>(high) << 32) | low;
}

bool made_by_amd() {
    uint32_t a, b, c, d;
    constexpr uint32_t kAuth = 0x68747541;  // the first letters of AuthenticAMD
    return __get_cpuid(0, &a, &b, &c, &d) && b == kAuth;
}

// Linux hands the tile registers out on request only.
bool request_tile_registers() {
#if defined(__linux__)
    constexpr long kRequestPermission = 0x1023;  // ARCH_REQ_XCOMP_PERM
    constexpr long kTileData = 18;               // XFEATURE_XTILEDATA
    return syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
#else
    return false;
#endif
}

CpuFeatures detect() {
    CpuFeatures found;
    uint32_t a, b, c, d;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return found;
    const bool fma = c & (1u << 12);
    const bool os_saves_state = c & (1u << 27);
    if (!fma || !os_saves_state) return found;
    const uint64_t states = enabled_register_states();
    const auto all = [states](uint64_t mask) { return (states & mask) == mask; };
    if (!all(0x6) || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return found;
    const uint32_t features_b = b, features_d = d;
    found.avx2 = features_b & (1u << 5);
    constexpr uint32_t kFoundationDqBwVl = (1u << 16) | (1u << 17) | (1u << 30) | (1u << 31);
    found.avx512 = found.avx2 && all(0xe6) && (features_b & kFoundationDqBwVl) == kFoundationDqBwVl;
    if (!found.avx512 || !__get_cpuid_count(7, 1, &a, &b, &c, &d)) return found;
    found.avx512bf16 = a & (1u << 5);
    found.fast_pairs = made_by_amd();
    constexpr uint32_t kTilesAndBf16 = (1u << 24) | (1u << 22);
    found.amx = found.avx512bf16 && (features_d & kTilesAndBf16) == kTilesAndBf16 && all(0x60000) &&
                request_tile_registers();
    return found;
}

#else

CpuFeatures detect() { return {}; }

#endif

std::string join_names(const std::vector<const Backend*>& backends) {
    std::string names;
    for (const Backend* backend : backends) {
        if (!names.empty()) names += ", ";
        names += backend->name;
    }
    return names;
}

}  // namespace

std::vector<const Backend*> available_backends() {
    static const CpuFeatures cpu = detect();
    struct Candidate {
        const char* name;
        bool supported;
        const Backend* backend;
    };
    const Candidate candidates[] = {
        {"amx", cpu.amx, amx_backend()},
        {"avx512bf16", cpu.avx512bf16, avx512bf16_backend()},
        {"avx512", cpu.avx512, avx512_backend()},
        {"avx2", cpu.avx2, avx2_backend()},
        {"portable", true, portable_backend()},
    };
    const char* const variable = std::getenv(kCapVariable);
    const std::string cap = variable == nullptr ? "" : variable;
    bool reached = cap.empty() || cap == "auto";
    std::vector<const Backend*> available;
    for (const Candidate& candidate : candidates) {
        reached = reached || cap == candidate.name;
        if (reached && candidate.supported && candidate.backend != nullptr) {
            available.push_back(candidate.backend);
        }
    }
    if (!reached) {
        throw std::invalid_argument(std::string(kCapVariable) + " is '" + cap +
                                    "'; it may be auto, amx, avx512bf16, avx512, avx2 or portable");
    }
    // A cap that names the slow pairs asks for them.
    if (!cpu.fast_pairs && cap != "avx512bf16") {
        const auto pairs = std::find(available.begin(), available.end(), avx512bf16_backend());
        if (pairs != available.end()) std::iter_swap(pairs, pairs + 1);
    }
    return available;
}

const Backend* find_backend(const std::string& name) {
    const std::vector<const Backend*> available = available_backends();
    if (name == "auto") return available.front();
    for (const Backend* backend : available) {
        if (name == backend->name) return backend;
    }
    throw std::invalid_argument("instruction set '" + name +
                                "' is not available here; there are: " + join_names(available) +
                                " (and auto, the first of them)");
}

}  // namespace meslam
