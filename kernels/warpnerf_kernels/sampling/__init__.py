"""Where rays are sampled: the placing of steps, free space."""
