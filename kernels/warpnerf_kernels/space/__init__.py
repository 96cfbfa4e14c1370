"""Where things are: cameras, and unbounded space folded into a box."""
