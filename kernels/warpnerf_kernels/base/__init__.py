"""Number types, precision, tiles of nodes, and the vector words of the CPU forms."""
