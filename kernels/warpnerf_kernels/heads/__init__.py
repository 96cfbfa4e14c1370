"""Heads: from features and the direction of view to colour, with adjoints."""
