// Requests the processor's tiles (AMX) from Linux: 8 KiB of registers per thread.
#include "runtime/common.h"

#if defined(__AMX_TILE__)

#include <sys/syscall.h>
#include <unistd.h>

// The obstacle, such as an old system or a signal stack that is too small on some thread; null if there is none.
EXPORT const char* ask_for_tiles() {
    constexpr int REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    if (syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0) return nullptr;
    return "the system does not let this process use the processor's tiles (AMX)";
}

#endif
