"""Cameras: their poses and lenses, what they look at, and what they see."""
