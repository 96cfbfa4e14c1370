"""The command `warpnerf`."""
