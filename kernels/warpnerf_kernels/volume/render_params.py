"""Parameters of a rendering launch: the scene, and rays through it."""

from functools import cache

import warp as wp

from ..base.parts import Encoding, Head, Losses, Sampler
from ..base.types import Box, Density, FreeSpace, Ray, Rays, real, vec3
from ..sampling.traversal import traversal
from .variant import Variant

wp.set_module_options({"enable_backward": False})


@cache
def loss_type(losses: Losses) -> type:
    """The numbers that losses depend on, besides what is rendered."""
    OfColour, OfRay, OfSamples = (loss.Params for loss in losses)

    @wp.struct
    class Loss:
        photometric: OfColour
        on_ray: OfRay
        on_samples: OfSamples

    return Loss


@cache
def render_params_type(sampler: Sampler, encoding: Encoding, head: Head, losses: Losses) -> type:
    """The parameters of a rendering launch: the scene that rays are marched through."""
    Steps, Field, Weights = sampler.Params, encoding.Params, head.Params
    Loss = loss_type(losses)

    @wp.struct
    class RenderParams:
        box: Box
        free: FreeSpace
        march: Steps
        field: Field
        density: Density
        head: Weights
        loss: Loss

    return RenderParams


@wp.func
def ray_value(values: wp.array(dtype=vec3), ray: int) -> vec3:
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


@wp.func
def ray_value(values: wp.array(dtype=real), ray: int) -> real:  # noqa: F811 (an overload)
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


@cache
def ray_getter(variant: Variant) -> wp.Function:
    """The function ray_of(scene, rays, i) -> Ray."""
    parts = variant.parts
    RenderParams = render_params_type(parts.sampler, parts.encoding, parts.head, parts.losses)
    prepare_ray = traversal(parts.sampler, variant.space).prepare_ray

    @wp.func
    def ray_of(scene: RenderParams, rays: Rays, i: int) -> Ray:
        """A ray of a launch, prepared for the scene."""
        return prepare_ray(
            scene.box,
            scene.march,
            i,
            rays.origins[i],
            rays.directions[i],
            ray_value(rays.offsets, i),
        )

    return ray_of
