"""Where things are: cameras, and unbounded space contracted into a box."""
