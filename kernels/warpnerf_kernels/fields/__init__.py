"""Encodings: what is stored over space, how it is read, and the transpose of reading."""
