"""Losses on the samples of a ray, a file each."""
