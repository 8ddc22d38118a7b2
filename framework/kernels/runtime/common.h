// Shared by all kernels: the exported C interface, and vectors.
//
// The code uses the compiler's vectors of LANES floats (GCC and Clang on any processor). The library is built once for
// each instruction set, and framework/kernels/native.py loads the right one.
#pragma once

#include "runtime/parallel.h"
#include "runtime/status.h"

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef float Floats __attribute__((vector_size(LANES * 4)));
typedef int32_t Ints __attribute__((vector_size(LANES * 4)));

static inline Floats splat(float value) { return Floats{} + value; }

static inline Floats load(const float* from) {
    Floats out;
    std::memcpy(&out, from, sizeof out);
    return out;
}

static inline void store(float* to, Floats value) { std::memcpy(to, &value, sizeof value); }

// a > b ? a : b, so b if one is NaN, and a < b ? a : b: one instruction, where compilers generate two.
static inline Floats larger(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_max_ps((__m512)a, (__m512)b);
#elif defined(__AVX__)
    return (Floats)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return a > b ? a : b;
#endif
}

static inline Floats smaller(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_min_ps((__m512)a, (__m512)b);
#elif defined(__AVX__)
    return (Floats)_mm256_min_ps((__m256)a, (__m256)b);
#else
    return a < b ? a : b;
#endif
}

static inline Floats magnitude(Floats x) {
    Ints bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits &= 0x7fffffff;
    std::memcpy(&x, &bits, sizeof x);
    return x;
}

// exp(x) as power * (1 + rest): 2^n from the exponent's bits, and Cephes' polynomial (expf), small for small x.
static inline void split_exponential(Floats x, Floats& power, Floats& rest) {
    const Floats clipped = smaller(larger(x, splat(-87.3f)), splat(88.3f));
    const Ints n = __builtin_convertvector(clipped * 1.44269504f + (clipped < 0 ? splat(-0.5f) : splat(0.5f)), Ints);
    const Floats whole = __builtin_convertvector(n, Floats);
    const Floats r = (clipped - whole * 0.693359375f) + whole * 2.12194440e-4f;
    Floats p = splat(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    rest = p * r * r + r;
    const Ints exponent = (n + 127) << 23;
    std::memcpy(&power, &exponent, sizeof power);
}

// exp to 2 units in the last place.
static inline Floats exponential(Floats x) {
    Floats power, rest;
    split_exponential(x, power, rest);
    const Floats value = (rest + 1.0f) * power;
    return x == x ? value : x;  // NaN stays NaN
}

// 1 - exp(-x); a subtraction would lose all of x below 6e-8.
static inline Floats opacity_of(Floats x) {
    Floats power, rest;
    split_exponential(-x, power, rest);
    const Floats value = (1.0f - power) - rest * power;
    return x == x ? value : x;
}

constexpr float MAX_OPTICAL_DEPTH = 1e3f, MAX_FLOAT = 3.402823466e38f;

// Optical depth of an interval; see compositing/density.py.
static inline float optical_depth(float sigma, float delta) {
    const float density = sigma > MAX_FLOAT ? MAX_FLOAT : sigma;  // infinity * 0 would be NaN
    const float length = delta > MAX_FLOAT ? MAX_FLOAT : delta;
    const float tau = density * length;
    return tau > MAX_OPTICAL_DEPTH ? MAX_OPTICAL_DEPTH : tau;
}

// Its derivative by sigma: 0 if it is clamped, and for an infinite interval.
static inline float depth_slope(float sigma, float delta) {
    return sigma * delta > MAX_OPTICAL_DEPTH || delta > MAX_FLOAT ? 0 : delta;
}
