// Linux gives a process the processor's tiles (AMX), 8 KiB of registers a thread, when it asks for them.
#include "runtime/common.h"

#if defined(__AMX_TILE__)

#include <sys/syscall.h>
#include <unistd.h>

// What is in the way, as where the system is too old, or some thread's stack for signals has no room; null if nothing is.
EXPORT const char* ask_for_tiles() {
    constexpr int REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    if (syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0) return nullptr;
    return "the system does not let this process use the processor's tiles (AMX)";
}

#endif
