// The message of the last failure of each thread (see status.h), and the fingerprint of the library's sources.
#include "runtime/common.h"

#include <string>

static thread_local char words[256];

int remember(Status status, const char* what) noexcept {
    std::strncpy(words, what, sizeof words - 1);
    return status;
}

void bad_index(int64_t index, int64_t count, const char* what) {
    throw std::out_of_range(std::string(what) + ": index " + std::to_string(index) + " is out of range; there are " +
                            std::to_string(count) + ", from 0");
}

EXPORT const char* last_error() { return words; }

// The fingerprint of ../sources.py, so that an outdated library is not called with other arguments.
EXPORT int64_t built_from() { return NERFLOOM_SOURCES; }
