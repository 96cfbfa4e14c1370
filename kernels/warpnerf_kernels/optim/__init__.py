"""What changes parameters between launches: Adam, total variation."""
