"""Networks that heads shade with, and that encodings may decode with."""
