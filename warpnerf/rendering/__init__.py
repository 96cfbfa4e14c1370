"""Rays through a model, forward and back."""
