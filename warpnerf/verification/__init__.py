"""Gradients and whole trainings, checked on the machine where they are to run."""
