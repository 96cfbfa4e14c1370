"""Exposures of photographs: an affine map of each channel, fitted to what rays see.

    pixel = gain c + offset

for each photograph and channel, c being the field's colour: least squares over its rays, the later
ones of more weight, by the moments of x = c - 1/2 and y = pixel - 1/2, and of ``prior`` more rays
whose colours are uniform and alike in both. Gains have the geometric mean 1 and offsets the mean 0
over photographs, as nothing else says how bright the field is.
"""

import warp as wp

from ..base.types import real, vec3

wp.set_module_options({"enable_backward": False})

MOMENTS = 5
"""Of a channel of a photograph: sums over rays of 1, x, y, x x, x y."""
CLIPPED = 0.5 / 255.0
"""Pixels so close to 0 or 1 are cut off there, and tell nothing."""
MOST_GAIN = 8.0
"""And 1 / MOST_GAIN the least, before the mean is taken out."""


@wp.kernel
def add_moments(
    # launch
    first: int,
    # rays
    views: wp.array(dtype=wp.int32),  # [n_rays] which photograph; -1: it does not count
    rgb: wp.array(dtype=vec3),  # [n_rays] what was rendered
    target_rgb: wp.array(dtype=vec3),  # [n_rays] the pixel in the field's colours
    gains: wp.array(dtype=vec3),  # [n_views] by which it was brought there
    offsets: wp.array(dtype=vec3),  # [n_views]
    # out
    out_moments: wp.array2d(dtype=real),  # [1, n_views * 3 * MOMENTS] added to
):
    """Add a batch's rays to the moments of their photographs; one worker on a CPU."""
    i = first + wp.tid()
    v = views[i]
    if v < 0:
        return
    half = real(0.5)
    for c in range(3):
        pixel = gains[v][c] * target_rgb[i][c] + offsets[v][c]
        if pixel > real(wp.static(CLIPPED)) and pixel < real(wp.static(1.0 - CLIPPED)):
            at = (3 * v + c) * wp.static(MOMENTS)
            x = rgb[i][c] - half
            y = pixel - half
            wp.atomic_add(out_moments, 0, at, real(1.0))
            wp.atomic_add(out_moments, 0, at + 1, x)
            wp.atomic_add(out_moments, 0, at + 2, y)
            wp.atomic_add(out_moments, 0, at + 3, x * x)
            wp.atomic_add(out_moments, 0, at + 4, x * y)


@wp.kernel
def fit_exposures(
    # launch
    first: int,
    # choices
    keep: real,  # weight of what was summed before
    prior: real,  # rays
    # out
    out_moments: wp.array2d(dtype=real),  # [1, n_views * 3 * MOMENTS] zeroed
    out_sums: wp.array(dtype=real),  # [n_views * 3 * MOMENTS]
    out_gains: wp.array(dtype=vec3),  # [n_views]
    out_offsets: wp.array(dtype=vec3),  # [n_views]
):
    """Take new moments in, and fit the photographs to their sums."""
    v = first + wp.tid()
    gain = vec3()
    offset = vec3()
    half = real(0.5)
    for c in range(3):
        at = (3 * v + c) * wp.static(MOMENTS)
        for k in range(wp.static(MOMENTS)):
            out_sums[at + k] = keep * out_sums[at + k] + out_moments[0, at + k]
            out_moments[0, at + k] = real(0.0)
        n = out_sums[at] + prior
        x = out_sums[at + 1]
        y = out_sums[at + 2]
        xx = out_sums[at + 3] + prior * real(1.0 / 12.0)
        xy = out_sums[at + 4] + prior * real(1.0 / 12.0)
        most = real(wp.static(MOST_GAIN))
        slope = wp.clamp((n * xy - x * y) / (n * xx - x * x), real(1.0) / most, most)
        gain[c] = slope
        offset[c] = half + (y - slope * x) / n - half * slope
    out_gains[v] = gain
    out_offsets[v] = offset


@wp.kernel
def centre_exposures(
    # launch
    first: int,
    # out
    out_gains: wp.array(dtype=vec3),  # [n_views]
    out_offsets: wp.array(dtype=vec3),  # [n_views]
):
    """Take their mean out of the exposures, as if the field had it: a thread for each channel."""
    c = first + wp.tid()
    n = out_gains.shape[0]
    total = real(0.0)
    for v in range(n):
        total += wp.log(out_gains[v][c])
    mean = wp.exp(total / real(n))
    sum_gains = real(0.0)
    sum_offsets = real(0.0)
    for v in range(n):
        sum_gains += out_gains[v][c] / mean
        sum_offsets += out_offsets[v][c]
    darker = sum_offsets / sum_gains
    for v in range(n):
        gain = out_gains[v]
        offset = out_offsets[v]
        gain[c] = gain[c] / mean
        offset[c] = offset[c] - gain[c] * darker
        out_gains[v] = gain
        out_offsets[v] = offset
