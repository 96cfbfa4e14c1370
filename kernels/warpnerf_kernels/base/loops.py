"""Loops that compilers leave as loops."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
asm("" : "+r"(n));
#endif
return n;
"""
)
def runtime(n: int) -> int:
    """n, of which compilers do not know that it is a constant.

    Warp writes out loops to a constant of at most 16, and CUDA's compiler does so with loops in
    them. A layer of an MLP, written out, takes it many times as long to compile, and is slower.
    """
    ...
