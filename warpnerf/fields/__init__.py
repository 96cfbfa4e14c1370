"""Fields on their device: what they store over which nodes, and what of space is free."""
