"""Poses of photographs and videos: structure from motion by COLMAP, in a process of its own."""
