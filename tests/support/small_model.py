"""What tests train where it does not matter: compiled once for all of them, and quickly."""

from warpnerf.config import LossConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, model_of

SMALL = Deferred(specular=4, width=32)
SQUARED = LossConfig()
"""The squared error alone."""


def small(name: str) -> Model:
    """The model of a name, of deferred the small one."""
    return SMALL if name == SMALL.name else model_of(name)
