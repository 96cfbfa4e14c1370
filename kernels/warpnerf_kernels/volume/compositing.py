"""Volume rendering of one sample (emission, absorption), and the suffix sum of what lies behind.

Here are the scalar forms, a sample at a time; pack.py has the vector forms, sixteen at a time. The
walks along a ray that use them are walk.py and walk_packs.py.
"""

import warp as wp

from ..base.activation import softplus, softplus_slope
from ..base.types import Density, real

wp.set_module_options({"enable_backward": False})


@wp.struct
class DensitySample:
    """The activated density of a sample, and the transmittance of its step."""

    sigma: real  # 1 / scene unit
    sigma_slope: real  # d sigma / d raw density
    attenuation: real  # exp(-sigma dt)


@wp.func
def activate_density(density: Density, raw_density: real, dt: real) -> DensitySample:
    """Density activation (shifted softplus), and the attenuation of a step of that density."""
    shifted = raw_density + density.shift
    activated = DensitySample()
    activated.sigma = density.scale * softplus(shifted)
    activated.sigma_slope = density.scale * softplus_slope(shifted)
    activated.attenuation = wp.exp(-activated.sigma * dt)
    return activated


@wp.func
def advance_suffix(
    suffix_sum: real, weight: real, adj_weight: real, limit: real, transmittance: real
) -> real:
    """The suffix sum behind a sample, from that behind the one before.

    It is a sum over weights that add up to the light that gets there. Advanced by subtraction it
    keeps a rest of rounding, which behind an opaque surface would be all there is; the bound
    removes it.
    """
    return wp.clamp(suffix_sum - weight * adj_weight, -limit * transmittance, limit * transmittance)
