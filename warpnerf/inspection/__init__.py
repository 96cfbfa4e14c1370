"""What a scene is before anybody trains on it."""
