"""Device code of warpnerf: Warp functions and kernels, the same source on CPU and CUDA.

The package imports itself by relative names only, so that ``precision.load("float64")`` can import
the very same files a second time with ``real`` meaning float64. It never imports numpy, torch or
warpnerf.
"""
