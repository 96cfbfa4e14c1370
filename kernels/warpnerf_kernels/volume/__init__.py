"""Along a ray: compositing, the distance scaling of its gradient, and losses."""
