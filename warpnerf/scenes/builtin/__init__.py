"""The built-in scene, made by an exact ray tracer."""
