#include "texture_lookup.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#ifdef __SSE2__
#include <emmintrin.h>
#endif

namespace meslam {
namespace {

// Positions are rounded to 1/32 texel, so that weights of texels are whole numbers.
constexpr int kStepBits = 5;
constexpr int kSteps = 1 << kStepBits;
constexpr int kRounding = 1 << (2 * kStepBits - 1);
// A surface seen at a slant has a longer footprint, to this limit.
constexpr float kLeastCosine = 0.05f;
constexpr float kBelowCoarsest = 1e-3f;
// Rays whose places are found together, in a loop that compilers vectorise.
constexpr size_t kBlock = 256;

// The four texels about a position, from the upper left one on, and the position's steps past it.
struct Quad {
    const uint8_t* texels;
    size_t stride;
    int right, lower;
};

Quad quad(const TextureAtlas& atlas, int level, float x, float y) {
    const auto steps = [](float texels) {
        return static_cast<int>(std::lrintf(texels * static_cast<float>(kSteps)));
    };
    const int across = steps(x * atlas.scale[level] + atlas.left[level]);
    const int down = steps(y * atlas.scale[level] + atlas.top[level]);
    const int column = std::clamp(across >> kStepBits, 0, atlas.width - 3);
    const int row = std::clamp(down >> kStepBits, 0, atlas.height - 2);
    const size_t stride = 3 * static_cast<size_t>(atlas.width);
    return {atlas.texels + static_cast<size_t>(row) * stride + 3 * column, stride,
            across & (kSteps - 1), down & (kSteps - 1)};
}

#ifdef __SSE2__
// Red, green, blue and something that is no colour. Reads eight bytes of either row.
using Rgb = __m128;

__m128i wide(const uint8_t* texels) {
    const __m128i bytes = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(texels));
    return _mm_unpacklo_epi8(bytes, _mm_setzero_si128());
}

Rgb bilinear(const Quad& at) {
    const __m128i above = _mm_set1_epi16(static_cast<int16_t>(kSteps - at.lower));
    const __m128i below = _mm_set1_epi16(static_cast<int16_t>(at.lower));
    const __m128i mixed = _mm_add_epi16(_mm_mullo_epi16(wide(at.texels), above),
                                        _mm_mullo_epi16(wide(at.texels + at.stride), below));
    // Each channel beside that of the texel to the right, which is three numbers further.
    const __m128i pairs = _mm_unpacklo_epi16(mixed, _mm_srli_si128(mixed, 6));
    const __m128i sums = _mm_madd_epi16(pairs, _mm_set1_epi32((kSteps - at.right) | at.right << 16));
    const __m128i rounded = _mm_srli_epi32(_mm_add_epi32(sums, _mm_set1_epi32(kRounding)),
                                           2 * kStepBits);
    return _mm_cvtepi32_ps(rounded);
}

void store(const Rgb& fine, const Rgb& coarse, float share, float* color) {
    const __m128 step = _mm_mul_ps(_mm_sub_ps(coarse, fine), _mm_set1_ps(share));
    const __m128 result = _mm_add_ps(fine, step);
    _mm_storel_pi(reinterpret_cast<__m64*>(color), result);
    _mm_store_ss(color + 2, _mm_movehl_ps(result, result));
}
#else
struct Rgb {
    float channels[3];
};

Rgb bilinear(const Quad& at) {
    Rgb result;
    for (int channel = 0; channel < 3; ++channel) {
        const auto across = [&](const uint8_t* texels) {
            return texels[channel] * (kSteps - at.right) + texels[channel + 3] * at.right;
        };
        const int sum = across(at.texels) * (kSteps - at.lower) +
                        across(at.texels + at.stride) * at.lower;
        result.channels[channel] = static_cast<float>((sum + kRounding) >> (2 * kStepBits));
    }
    return result;
}

void store(const Rgb& fine, const Rgb& coarse, float share, float* color) {
    for (int channel = 0; channel < 3; ++channel) {
        const float from = fine.channels[channel];
        color[channel] = from + (coarse.channels[channel] - from) * share;
    }
}
#endif

// Where a block of rays ends in the finest level [px], and how much it sees there [px].
struct Places {
    float x[kBlock], y[kBlock], footprint[kBlock];
};

void find(const TriangleTexels& texels, const RayHits& hits, size_t first, size_t count,
          float focal_px, Places& places) {
    for (size_t i = 0; i < count; ++i) {
        const size_t ray = first + i;
        const bool hit = std::isfinite(hits.distance[ray]);
        const float* const row = texels.rows + TriangleTexels::kColumns * (hit ? hits.triangle[ray] : 0);
        const float second = hits.shares[2 * ray], third = hits.shares[2 * ray + 1];
        places.x[i] = row[0] + second * row[2] + third * row[4];
        places.y[i] = row[1] + second * row[3] + third * row[5];
        places.footprint[i] = row[6];
    }
    for (size_t i = 0; i < count; ++i) {
        // Between the footprint's short and long axis: neither shimmering nor washed out.
        const float slant = std::sqrt(std::max(kLeastCosine, hits.cosine[first + i]));
        places.footprint[i] = hits.distance[first + i] / (focal_px * places.footprint[i] * slant);
    }
}

}  // namespace

void shade(const TextureAtlas& atlas, const TriangleTexels& texels, const RayHits& hits,
           float focal_px, float* color) {
    const float coarsest = static_cast<float>(1 << (atlas.levels - 1)) - kBelowCoarsest;
    Places places;
    for (size_t first = 0; first < hits.count; first += kBlock) {
        const size_t count = std::min(kBlock, hits.count - first);
        find(texels, hits, first, count, focal_px, places);
        for (size_t i = 0; i < count; ++i, color += 3) {
            if (!std::isfinite(hits.distance[first + i])) {
                color[0] = color[1] = color[2] = 0.0f;
                continue;
            }
            const float fineness = std::log2(std::min(coarsest, std::max(1.0f, places.footprint[i])));
            const int level = static_cast<int>(fineness);
            const float share = fineness - static_cast<float>(level);
            const Rgb fine = bilinear(quad(atlas, level, places.x[i], places.y[i]));
            const Rgb coarse = bilinear(quad(atlas, level + 1, places.x[i], places.y[i]));
            store(fine, coarse, share, color);
        }
    }
}

}  // namespace meslam
