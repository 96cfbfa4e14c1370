"""How good a model is, and whether the gradients are right."""
