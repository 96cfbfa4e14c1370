"""Device code of warpnerf: Warp functions and kernels, the same source on CPU and CUDA.

The package imports itself by relative names only, so that ``base.precision.load`` can import
the very same files a second time with ``real`` meaning float64. It never imports numpy, torch or
warpnerf.
"""
