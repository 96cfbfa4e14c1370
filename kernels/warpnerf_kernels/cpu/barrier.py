"""A spin barrier: how the workers of a launch on the CPU wait for each other within it.

They are threads that all run at the same time, and wait awake: to end a launch and begin another
takes 100 to 150 us, most of it to wake a thread, and a step of a training may last 4 ms. A worker
that gives up cancels the barrier, so that nobody waits for ever.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ARRIVED = 0
"""Where the barrier counts how often a worker has come, from 0 on in each launch."""
CANCELLED = 16
"""Where it is not 0 if some worker will not come; on another cache line."""
SIZE = 32


@wp.func_native(
    f"constexpr int ARRIVED = {ARRIVED}, CANCELLED = {CANCELLED};"
    """
#if defined(__CUDA_ARCH__)
return true;  // not for CUDA, which compiles it where it stands beside what is
#else
constexpr int AWAKE = 10000;  // looks, some 0.1 to 0.4 ms, before others may have the core
#if defined(__linux__)
int sched_yield(void) __asm__("sched_yield") __attribute__((weak));  // where it is to be had
#endif
auto read = [&](int at) -> int { return __atomic_load_n(barrier.data + at, __ATOMIC_ACQUIRE); };
if (read(CANCELLED)) return false;  // and is not counted again
const int before = __atomic_fetch_add(barrier.data + ARRIVED, 1, __ATOMIC_ACQ_REL);
const int all = (before / n_workers + 1) * n_workers;
int looks = 0;
while (read(ARRIVED) < all) {
    if (read(CANCELLED)) return false;
    if (looks < AWAKE) ++looks;
#if defined(__linux__)
    else if (sched_yield) sched_yield();
#endif
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("isb");
#endif
}
return true;
#endif
"""
)
def wait_for_all(barrier: wp.array(dtype=wp.int32), n_workers: int) -> bool:
    """Wait until all workers have come as often as this one; false if one of them gave up."""
    ...
