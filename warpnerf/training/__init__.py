"""Training: schedule, optimiser, checkpoints, the folder of a run."""
