"""Additions to nodes and entries that many samples share.

On CUDA they are atomic. From compute capability 9.0 on, four numbers are added by one instruction
(PTX ISA 8.1, red.global.add.v4.f32): fewer transactions, and a quarter of the code. Arrays begin at
multiples of 16 bytes, as allocators give them. On the CPU only one thread may call this for an
array at a time.
"""

from typing import Any

import warp as wp

from .types import real

wp.set_module_options({"enable_backward": False})

BY_FOUR = r"""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
constexpr int N_FOURS = sizeof(value) / 16;
if constexpr (sizeof(value) % 16 == 0) {
    const float* numbers = (const float*)&value;  // a vector is its numbers, one after the other
    #pragma unroll
    for (int n = 0; n < N_FOURS; ++n) {
        asm volatile(
            "{ .reg .u64 at; cvta.to.global.u64 at, %0;"
            " red.global.add.v4.f32 [at], {%1, %2, %3, %4}; }"
            ::"l"((const float*)&wp::index(to, i) + 4 * n), "f"(numbers[4 * n]),
            "f"(numbers[4 * n + 1]), "f"(numbers[4 * n + 2]), "f"(numbers[4 * n + 3])
            : "memory");
    }
    return;
}
#endif
"""


@wp.func_native((BY_FOUR if real is wp.float32 else "") + "wp::atomic_add(to, i, value);")
def add_to(to: wp.array(dtype=Any), i: int, value: Any):
    """to[i] += value, for each number of it."""
    ...
