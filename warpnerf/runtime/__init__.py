"""The machine: devices, threads, memory, signals, compiled kernels."""
