"""Kernel variants: the parts of a model, the space, and how gradients are scaled.

All of it is constant in each kernel, so the compiler drops what a variant does not use; and so is
the choice between the scalar walk and that in packs of sixteen, which is for the CPU.
"""

from typing import NamedTuple

from ..base.parts import Encoding, Head, Losses, Sampler, Space
from ..heads import rgb
from ..sampling.steps import STEPS
from .loss import PHOTOMETRIC_ONLY


class Parts(NamedTuple):
    """What a model is made of."""

    head: Head
    encoding: Encoding | None = None  # given by what the field is stored in
    sampler: Sampler = STEPS
    losses: Losses = PHOTOMETRIC_ONLY

    @property
    def have_packs(self) -> bool:
        """Whether all parts have a vector form; else the CPU runs the scalar one, on a thread."""
        if self.sampler.place_pack is None or self.encoding.vectors is None:
            return False
        if self.sampler.keep is not None and self.sampler.keep_pack is None:
            return False
        return self.head.vectors is not None

    @property
    def have_colours_of_samples(self) -> bool:
        """Whether channels are red, green and blue, and their sum the ray's colour."""
        return self.head.shade is rgb.shade


class Variant(NamedTuple):
    """What kernels are compiled for."""

    parts: Parts
    space: Space
    scaling: int  # as in gradscale.py
    jacobian: int  # likewise
    packed: bool  # sixteen samples at a time; float32 on the CPU only

    @property
    def batch(self) -> int:
        """Rays that a worker processes together."""
        return self.parts.head.vectors.batch if self.packed else 1
