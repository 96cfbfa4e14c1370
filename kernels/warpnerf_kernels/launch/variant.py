"""The parts of a model, the variants of its kernels, and the types that follow from both.

What selects a variant (``contraction``, ``scaling``, ``jacobian``) is a constant in each kernel, so
the compiler drops what a variant does not use. So are the parts, and the choice between the scalar
walk and that in packs of sixteen, which is for the CPU.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..base.parts import Encoding, Head, Losses, Sampler
from ..base.types import gradient_type, real, vec3, vector
from ..heads import rgb
from ..sampling.steps import STEPS
from ..volume import scene as scenes
from ..volume.loss import PLAIN
from ..volume.scene import ray_getter
from ..volume.walk_packs import walk_packs


class Parts(NamedTuple):
    """What a model is made of."""

    encoding: Encoding
    head: Head
    sampler: Sampler = STEPS
    losses: Losses = PLAIN

    @property
    def have_packs(self) -> bool:
        """Whether all parts have a vector form; else the CPU runs the scalar one, on a thread."""
        if self.sampler.place_pack is None or self.encoding.vectors is None:
            return False
        of_head = self.head.vectors
        if of_head is None:
            return False
        return not self.losses.on_samples or of_head.adj_decode_pack_with_colours is not None

    @property
    def have_colours_of_samples(self) -> bool:
        """Whether channels are red, green and blue, and their sum the ray's colour."""
        return self.head.shade is rgb.shade


class Variant(NamedTuple):
    """What kernels are compiled for; the constants live in contraction.py and gradscale.py."""

    parts: Parts
    contraction: int
    scaling: int
    jacobian: int
    packed: bool  # sixteen samples at a time; float32 on the CPU only

    @property
    def batch(self) -> int:
        """Rays that a worker has in hand together."""
        return self.parts.head.vectors.batch if self.packed else 1


def scene_type(parts: Parts) -> type:
    """What rays are marched through."""
    return scenes.scene_type(parts.sampler, parts.encoding, parts.head, parts.losses)


def ray_of_parts(parts: Parts) -> wp.Function:
    """The function that makes a ray for a model's parts."""
    return ray_getter(parts.sampler, parts.encoding, parts.head, parts.losses)


@cache
def seen_type(n_channels: int) -> type:
    """What rays see: written by forward kernels, read by backward ones."""

    @wp.struct
    class Seen:
        rgb: wp.array(dtype=vec3)  # [n_rays] with background
        transmittance: wp.array(dtype=real)  # [n_rays]
        depth: wp.array(dtype=real)  # [n_rays] scene units
        n_samples: wp.array(dtype=wp.int32)  # [n_rays]
        channels: wp.array(dtype=vector(n_channels))  # [n_rays] before the head's last part

    return Seen


@wp.struct
class Nowhere:
    """Scratch of the scalar walk, which keeps nothing."""

    unused: int


@cache
def scratch_type(variant: Variant) -> type:
    """What workers keep between the two passes."""
    if not variant.packed:
        return Nowhere
    parts = variant.parts
    walked = walk_packs(parts.sampler, parts.encoding, parts.head, parts.losses)

    @wp.struct
    class Scratch:
        capacity: int  # packs of each worker, n_packs of the head at least
        packs: wp.array(dtype=walked.Pack)  # [n_workers * capacity]
        rows: wp.array(dtype=walked.Row)  # [n_workers * batch]

    return Scratch


def sink_type(variant: Variant) -> type:
    """What kernels add to: the gradient, or that and records on their way to it."""
    parts = variant.parts
    if not variant.packed:
        return gradient_type(parts.encoding.n_floats)
    return walk_packs(parts.sampler, parts.encoding, parts.head, parts.losses).Sink
