"""Scenes: photographs, cameras, and the formats they come in."""
