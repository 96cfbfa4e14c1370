"""The folder of a training: its files, checkpoints, pictures, and its photographs, read again."""
