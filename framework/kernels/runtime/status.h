// Error reporting of exported functions: no exception crosses the C interface.
//
// Each returns a Status; last_error() returns the message. ../native.py converts them to Python exceptions.
#pragma once

#include <cstdint>
#include <exception>
#include <new>
#include <stdexcept>

enum Status { DONE = 0, NO_MEMORY = 1, BAD_INDEX = 2, BAD_VALUE = 3, FAILED = 4 };

int remember(Status status, const char* what) noexcept;

// Runs body(), the body of an exported function.
template <typename Body>
int guarded(const Body& body) noexcept {
    try {
        body();
        return DONE;
    } catch (const std::bad_alloc&) {
        return remember(NO_MEMORY, "there is not enough memory");
    } catch (const std::length_error&) {  // more than any std::vector can hold
        return remember(NO_MEMORY, "there is not enough memory");
    } catch (const std::out_of_range& error) {
        return remember(BAD_INDEX, error.what());
    } catch (const std::invalid_argument& error) {
        return remember(BAD_VALUE, error.what());
    } catch (const std::exception& error) {
        return remember(FAILED, error.what());
    } catch (...) {
        return remember(FAILED, "an unknown error");
    }
}

[[noreturn]] void bad_index(int64_t index, int64_t count, const char* what);

// Raises BAD_INDEX unless ray r's samples, [offsets[r], offsets[r + 1]), are among `count`.
inline void check_offsets(const int64_t* offsets, int64_t r, int64_t count) {
    if (offsets[r] < 0 || offsets[r + 1] < offsets[r] || offsets[r + 1] > count) bad_index(offsets[r + 1], count, "offsets");
}

// Raises BAD_INDEX unless 0 <= index < count.
inline void check_index(int64_t index, int64_t count, const char* what) {
    if (index < 0 || index >= count) bad_index(index, count, what);
}
