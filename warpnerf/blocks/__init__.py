"""Scenes larger than a machine: cut into blocks, trained as jobs, rendered as one."""
