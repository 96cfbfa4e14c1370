"""Subcommands of the command `warpnerf`, a module each: they parse, call and print."""
