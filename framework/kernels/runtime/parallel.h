// Sharing work out over threads: chunks that whichever thread is free takes.
//
// A region's result never depends on who takes which chunk, so the same bits come out on any number of threads, on
// threads that come late, and on none at all but the caller's: it takes chunks like the others, and waits only for
// chunks that others have begun. So a thread that the system does not run, because another program has its core, holds
// up a region by one chunk at most, not by its share of the whole. Threads that wait do so briefly, then they sleep.
#pragma once

#include <algorithm>
#include <cstdint>

typedef void (*ChunkFunction)(const void* body, int64_t chunk, int slot);

// Calls function(body, chunk, slot) for each of `chunks` chunks on up to `threads` threads. `slot` is that of the
// thread, below `threads`: no two threads have the same at a time. Rethrows the first exception of a chunk.
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

// body(begin, end) for parts of [0, count) of `grain` items each, the last one smaller.
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
