"""Kernels: the only place that assembles parts."""
