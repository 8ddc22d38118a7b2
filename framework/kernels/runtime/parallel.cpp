// The threads of parallel.h. They start when first needed and stay. They are never joined: the system ends them with
// the process.
#include "runtime/parallel.h"

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#if defined(_WIN32)
#include <system_error>
#include <thread>
#else
#include <pthread.h>
#include <signal.h>
#endif

namespace {

typedef std::chrono::steady_clock Clock;
using std::chrono::microseconds;

// Time that a thread polls for work, or for the end of a region, before it sleeps. If a thread has a core to
// itself, this is longer than most gaps between the regions of a step, because a wake-up takes tens of microseconds. If
// another program needs the core, polling uses up time that the system would otherwise give us later.
constexpr microseconds PATIENCE(2000), CROWDED_PATIENCE(10);

// Reading the clock takes longer than this only if the thread was not running meanwhile.
constexpr microseconds INTERRUPTION(100);
constexpr auto CROWDED_FOR = std::chrono::milliseconds(100);  // after an interruption

std::atomic<Clock::rep> crowded_until{0};

inline void relax() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

// Whether `ready` came true while polling.
template <typename Ready>
bool soon(const Ready& ready) {
    const auto start = Clock::now();
    const bool crowded = start.time_since_epoch().count() < crowded_until.load(std::memory_order_relaxed);
    const auto give_up = start + (crowded ? CROWDED_PATIENCE : PATIENCE);
    for (auto before = start;;) {
        for (int i = 0; i < 16; i++) {
            if (ready()) return true;
            relax();
        }
        const auto now = Clock::now();
        if (now - before > INTERRUPTION)
            crowded_until.store((now + CROWDED_FOR).time_since_epoch().count(), std::memory_order_relaxed);
        if (now >= give_up) return ready();
        before = now;
    }
}

// Sleeps until an event; the thread that causes the event calls `wake`.
class Bed {
    std::mutex mutex;
    std::condition_variable changed;
    std::atomic<bool> asleep{false};

public:
    template <typename Ready>
    void wait(const Ready& ready) {
        if (soon(ready)) return;
        std::unique_lock<std::mutex> lock(mutex);
        asleep.store(true);  // before `ready` is called: it sees the change, or `wake` sees a sleeping thread
        changed.wait(lock, ready);
        asleep.store(false);
    }
    void wake() {
        if (!asleep.load()) return;
        { std::lock_guard<std::mutex> lock(mutex); }
        changed.notify_one();
    }
};

// Starts a thread that is never joined; false if the system allows no more.
#if defined(_WIN32)
// Its stack is as large as the program states, which is 2 MB for Python.
bool start_thread(std::function<void()> work) {
    try {
        std::thread(std::move(work)).detach();
        return true;
    } catch (const std::system_error&) {
        return false;
    }
}
#else
// Minimum size of a stack, bytes: a chunk of a network takes 540 KB of it. By default, macOS gives threads 512 KiB and
// musl 128 KiB.
constexpr size_t STACK = size_t(4) << 20;

extern "C" void* run_thread(void* work) {
    const std::unique_ptr<std::function<void()>> own(static_cast<std::function<void()>*>(work));
    (*own)();
    return nullptr;
}

bool start_thread(std::function<void()> work) {
    pthread_attr_t attributes;
    if (pthread_attr_init(&attributes) != 0) return false;
    size_t usual = 0;
    pthread_attr_getstacksize(&attributes, &usual);
    if (usual < STACK) pthread_attr_setstacksize(&attributes, STACK);
    pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
    auto handed_over = std::make_unique<std::function<void()>>(std::move(work));
    pthread_t thread;
    const bool started = pthread_create(&thread, &attributes, run_thread, handed_over.get()) == 0;
    if (started) handed_over.release();
    pthread_attr_destroy(&attributes);
    return started;
}
#endif

class Pool {
    // Remaining work: threads that may take part in the upper half, unstarted chunks in the lower half. A thread that
    // decrements it owns a chunk of the current region, which cannot end before that chunk is done. Until then the
    // fields below belong to that region.
    std::atomic<uint64_t> left{0};
    std::atomic<int64_t> done{0};
    int64_t chunks = 0;
    ChunkFunction function = nullptr;
    const void* body = nullptr;
    std::atomic<bool> failed{false};
    std::exception_ptr error;
    std::mutex error_mutex;
    Bed caller;
    std::vector<std::unique_ptr<Bed>> beds;  // one per thread except the caller
    std::mutex region;

    bool may_take(int slot) const {
        const uint64_t state = left.load();
        return uint32_t(state) > 0 && int(state >> 32) > slot;
    }

    // Takes chunks until none are left.
    void work(int slot) {
        for (uint64_t state = left.load(); uint32_t(state) > 0 && int(state >> 32) > slot;) {
            if (!left.compare_exchange_weak(state, state - 1)) continue;
            const int64_t all = chunks;
            if (!failed.load()) {
                try {
                    function(body, all - uint32_t(state), slot);
                } catch (...) {
                    const std::lock_guard<std::mutex> lock(error_mutex);
                    if (!failed.exchange(true)) error = std::current_exception();
                }
            }
            if (done.fetch_add(1) + 1 == all) caller.wake();
            state = left.load();
        }
    }

    void stay(int slot) {
        Bed& bed = *beds[size_t(slot) - 1];
        for (;;) {
            bed.wait([&] { return may_take(slot); });
            work(slot);
        }
    }

    // Starts up to `threads` threads, including the caller's.
    void start(int threads) {
        while (int(beds.size()) + 1 < threads) {
            beds.emplace_back(new Bed);
            const int slot = int(beds.size());
            if (!start_thread([this, slot] { stay(slot); })) {  // fewer threads suffice
                beds.pop_back();
                return;
            }
        }
    }

public:
    Pool() { beds.reserve(MOST); }  // threads keep references to their own beds

    static constexpr int MOST = 4096;

    // False if another thread of the process is in a region.
    bool run(int threads, int64_t count, ChunkFunction what, const void* on) {
        const std::unique_lock<std::mutex> lock(region, std::try_to_lock);
        if (!lock.owns_lock()) return false;
        threads = int(std::min<int64_t>(std::min(threads, MOST), count));
        start_quietly(threads);
        chunks = count, function = what, body = on;
        failed.store(false);
        done.store(0);
        left.store(uint64_t(threads) << 32 | uint64_t(count));
        for (int slot = 1; slot < threads && slot <= int(beds.size()); slot++) beds[size_t(slot) - 1]->wake();
        work(0);
        caller.wait([&] { return done.load() == count; });
        if (failed.load()) {
            const std::exception_ptr first = error;
            error = nullptr;
            std::rethrow_exception(first);
        }
        return true;
    }

private:
    // Signals are handled by the program's threads, not by these.
    void start_quietly(int threads) {
        if (int(beds.size()) + 1 >= threads) return;
#if !defined(_WIN32)
        sigset_t all, before;
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);
        start(threads);
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
#else
        start(threads);
#endif
    }
};

std::atomic<Pool*> pool{nullptr};

// In a forked process, which has none of its parent's threads: start anew.
void forget_pool() { pool.store(nullptr); }

Pool& the_pool() {
    static const bool registered = [] {
#if !defined(_WIN32)
        pthread_atfork(nullptr, nullptr, forget_pool);
#endif
        return true;
    }();
    (void)registered;
    Pool* present = pool.load();
    if (present) return *present;
    Pool* fresh = new Pool;
    if (pool.compare_exchange_strong(present, fresh)) return *fresh;
    delete fresh;  // another thread was first
    return *present;
}

}  // namespace

void run_chunks(int threads, int64_t chunks, ChunkFunction function, const void* body) {
    constexpr int64_t MOST_CHUNKS = 0x7fffffff;
    if (chunks <= MOST_CHUNKS && the_pool().run(threads, chunks, function, body)) return;
    for (int64_t chunk = 0; chunk < chunks; chunk++) function(body, chunk, 0);
}
