"""Emission and absorption of one sample, and what lies behind it: the sums along a ray.

Here are the scalar forms, a sample at a time; pack.py has the vector forms, sixteen at a time. The
walks along a ray that use them are walk.py and walk_packs.py.
"""

import warp as wp

from ..base.activation import softplus, softplus_slope
from ..base.types import Density, real

wp.set_module_options({"enable_backward": False})


@wp.struct
class Matter:
    """What a sample's density makes of its step."""

    sigma: real  # 1 / scene unit
    sigma_slope: real  # d sigma / d raw density
    attenuation: real  # exp(-sigma dt)


@wp.func
def matter_of(density: Density, raw_density: real, dt: real) -> Matter:
    """Activate a raw density, and let light through a step of it."""
    shifted = raw_density + density.shift
    matter = Matter()
    matter.sigma = density.scale * softplus(shifted)
    matter.sigma_slope = density.scale * softplus_slope(shifted)
    matter.attenuation = wp.exp(-matter.sigma * dt)
    return matter


@wp.func
def shed(behind: real, weight: real, adj_weight: real, limit: real, transmittance: real) -> real:
    """What lies behind a sample, from what lay behind the one before.

    It is a sum over weights that add up to the light that gets there. Shed by subtraction it keeps
    a rest of rounding, which behind an opaque surface would be all there is; the bound removes it.
    """
    return wp.clamp(behind - weight * adj_weight, -limit * transmittance, limit * transmittance)
