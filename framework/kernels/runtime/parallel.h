// Distribution of work over threads: each chunk is taken by whichever thread is free.
//
// A region's result never depends on the distribution of chunks to threads, so it has the same bits for any number of
// threads, for late threads, and for the caller's thread alone. The caller takes chunks like the others, and waits only
// for chunks that others have started. So a thread that does not run, because another program has its core, delays a
// region by one chunk at most, not by its share of the whole. Waiting threads poll briefly and then sleep.
#pragma once

#include <algorithm>
#include <cstdint>

typedef void (*ChunkFunction)(const void* body, int64_t chunk, int slot);

// Calls function(body, chunk, slot) for each of `chunks` chunks on up to `threads` threads. `slot`, below `threads`, is
// the thread's: no two threads have the same slot at a time. Rethrows the first exception of a chunk.
void run_chunks(int threads, int64_t chunks, ChunkFunction function, const void* body);

// body(chunk, slot) for each chunk, in any order.
template <typename Body>
inline void for_chunks(int threads, int64_t chunks, const Body& body) {
    if (threads <= 1 || chunks <= 1) {
        for (int64_t chunk = 0; chunk < chunks; chunk++) body(chunk, 0);
        return;
    }
    run_chunks(
        threads, chunks,
        [](const void* of, int64_t chunk, int slot) { (*static_cast<const Body*>(of))(chunk, slot); }, &body);
}

// body(begin, end) for parts of [0, count) with `grain` items each; the last part may be smaller.
template <typename Body>
inline void for_ranges(int threads, int64_t count, int64_t grain, const Body& body) {
    for_chunks(threads, (count + grain - 1) / grain, [&](int64_t chunk, int) {
        body(chunk * grain, std::min(count, (chunk + 1) * grain));
    });
}

// body(item) for each of [0, count).
template <typename Body>
inline void for_each(int threads, int64_t count, int64_t grain, const Body& body) {
    for_ranges(threads, count, grain, [&](int64_t begin, int64_t end) {
        for (int64_t item = begin; item < end; item++) body(item);
    });
}
