"""The types that follow from a variant: what kernels read, keep and write."""

from functools import cache

import warp as wp

from ..base.types import real, vec3, vector
from ..volume import render_params
from ..volume.variant import Parts, Variant
from ..volume.walk_packs import walk_packs


def render_params_type(parts: Parts) -> type:
    """The parameters of a rendering launch: the scene that rays are marched through."""
    return render_params.render_params_type(parts.sampler, parts.encoding, parts.head, parts.losses)


@cache
def render_outputs_type(n_channels: int) -> type:
    """Outputs of rendering: written by forward kernels, read by backward ones."""

    @wp.struct
    class RenderOutputs:
        rgb: wp.array(dtype=vec3)  # [n_rays] with background
        transmittance: wp.array(dtype=real)  # [n_rays]
        depth: wp.array(dtype=real)  # [n_rays] scene units
        n_samples: wp.array(dtype=wp.int32)  # [n_rays]
        channels: wp.array(dtype=vector(n_channels))  # [n_rays] before the head's last part

    return RenderOutputs


@wp.struct
class TrainOutputs:
    """What a training launch tells of rays."""

    rgb: wp.array(dtype=vec3)  # [n_rays] with background
    error: wp.array(dtype=real)  # [n_rays] squared error
    loss: wp.array(dtype=real)  # [n_rays]
    n_samples: wp.array(dtype=wp.int32)  # [n_rays]


@wp.struct
class NoScratch:
    """Scratch of the scalar walk, which keeps nothing."""

    unused: int


@cache
def scratch_type(variant: Variant) -> type:
    """What workers keep between the two passes."""
    if not variant.packed:
        return NoScratch
    walked = walk_packs(variant)

    @wp.struct
    class Scratch:
        capacity: int  # packs of each worker, n_packs of the head at least
        packs: wp.array(dtype=walked.Pack)  # [n_workers * capacity]
        rows: wp.array(dtype=walked.RayState)  # [n_workers * batch]

    return Scratch


def sink_type(variant: Variant) -> type:
    """What kernels add to: the gradient, or that and records on their way to it."""
    if not variant.packed:
        return variant.parts.encoding.Gradient
    return walk_packs(variant).Sink
