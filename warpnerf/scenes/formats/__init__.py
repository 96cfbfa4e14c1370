"""Files of captures, read to a scene: a module for each format."""
