"""What a launch renders: the scene, and rays through it."""

from functools import cache

import warp as wp

from ..base.parts import Encoding, Head, Losses, Sampler
from ..base.types import Box, Density, FreeSpace, Ray, real, vec3
from ..sampling.traversal import traversal

wp.set_module_options({"enable_backward": False})


@cache
def loss_type(losses: Losses) -> type:
    """The numbers that losses depend on, besides what is rendered."""
    OfColour, OfRay = losses.photometric.Params, losses.on_ray.Params

    @wp.struct
    class Loss:
        photometric: OfColour
        on_ray: OfRay
        on_samples: real  # factor

    return Loss


@cache
def scene_type(sampler: Sampler, encoding: Encoding, head: Head, losses: Losses) -> type:
    """What rays are marched through."""
    Steps, Field, Weights = sampler.Params, encoding.Params, head.Params
    Loss = loss_type(losses)

    @wp.struct
    class Scene:
        box: Box
        free: FreeSpace
        march: Steps
        field: Field
        density: Density
        head: Weights
        loss: Loss

    return Scene


@wp.struct
class Rays:
    """Rays of a launch."""

    origins: wp.array(dtype=vec3)  # [n_rays] scene units
    directions: wp.array(dtype=vec3)  # [n_rays] unit vectors
    offsets: wp.array(dtype=real)  # [n_rays] or [1], in [0, 1)
    background: wp.array(dtype=vec3)  # [n_rays] or [1], rgb in [0, 1]
    content_distance: wp.array(dtype=real)  # [n_rays] or [1], scene units; for gradients


@wp.func
def ray_value(values: wp.array(dtype=vec3), ray: int) -> vec3:
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


@wp.func
def ray_value(values: wp.array(dtype=real), ray: int) -> real:  # noqa: F811 (an overload)
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


@cache
def ray_getter(sampler: Sampler, encoding: Encoding, head: Head, losses: Losses) -> wp.Function:
    """The function ray_of(scene, rays, i, contraction) -> Ray."""
    Scene = scene_type(sampler, encoding, head, losses)
    prepare_ray = traversal(sampler).prepare_ray

    @wp.func
    def ray_of(scene: Scene, rays: Rays, i: int, contraction: int) -> Ray:
        """A ray of a launch, prepared for the scene."""
        return prepare_ray(
            scene.box,
            scene.march,
            i,
            rays.origins[i],
            rays.directions[i],
            ray_value(rays.offsets, i),
            contraction,
        )

    return ray_of
