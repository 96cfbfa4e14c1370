"""Camera rays: from pixels to rays, and from photographs to batches of rays with colours.

``c2w`` has OpenGL axes (x right, y up, looking along -z); pixel (u, v) has its centre at
(u + 0.5, v + 0.5), row 0 at the top.
"""

import warp as wp

from ..base.tiles import prefetch
from ..base.types import Rays, mat33, real, vec2, vec3

wp.set_module_options({"enable_backward": False})

RANDOM_BACKGROUND = 1

AHEAD = 8
"""Rays from the one that a CPU draws to the one whose pixel it prefetches."""

SPREAD = 0x9E3779B97F4A7C15
"""2^64 over the golden ratio. Multiplied by it, low bits reach all higher ones."""

ROUNDS = 3
"""Of multiplication and shift in which the bits of a place become those of a pixel."""


@wp.struct
class CameraParams:
    """A photograph: its camera, its pixels, and their place among those of all photographs."""

    rotation: mat33  # camera to world
    position: vec3  # scene units
    focal: vec2  # fx, fy, pixels
    principal: vec2  # cx, cy, pixels
    radial: vec3  # k1, k2, k3
    tangential: vec2  # p1, p2
    divisor: vec3  # k4, k5, k6 of a rational lens
    rational: int  # 1: what moves a point in the plane z = 1 is divided by 1 + k4 r^2 + ...
    fisheye: int  # 1: radial and k4 distort the angle to the axis; 0: the point in the plane z = 1
    k4: real  # of a fisheye lens
    angle_max: real  # of a fisheye lens: up to where the distorted angle rises, radians
    width: int  # pixels
    height: int  # pixels
    first_pixel: wp.int64  # how many pixels count in the views before
    channels: int  # bytes of a pixel: 3, or 4 with straight alpha
    pixels: wp.array(dtype=wp.uint8)  # [H * W * channels]; empty where only rays are requested
    runs: wp.array(dtype=wp.vec2i)  # of pixels that count: how many before, the first; none: all


@wp.struct
class PixelSource:
    """What pixels are drawn from: photographs, and which blocks of them are covered."""

    views: wp.array(dtype=CameraParams)  # [n_views], by first_pixel
    n_pixels: wp.int64  # that count in all of them
    content_distances: wp.array(dtype=real)  # [n_views] scene units
    gains: wp.array(dtype=vec3)  # [n_views] of their exposures; empty: pixels are as they are
    offsets: wp.array(dtype=vec3)  # [n_views] likewise
    average: real  # edge of the square that the mean is taken over, pixels; up to 1: none is
    block: int  # edge of a block of pixels
    first_blocks: wp.array(dtype=int)  # [n_views] how many the views before have
    covered: wp.array(dtype=wp.uint8)  # [n_blocks] 0: nothing is drawn there; empty: draw anywhere


@wp.struct
class Draw:
    """How a batch of pixels is drawn."""

    seed: int  # of the training
    rays_before: wp.int64  # in the training, before ray 0 of this batch
    background: vec3  # rgb in [0, 1]
    background_mode: int  # RANDOM_BACKGROUND: a colour of its own for each ray
    jitter: int  # 1: a random offset for each ray, 0: the middle of the step


@wp.func
def radial_factor(view: CameraParams, r2: real):
    """What radial distortion multiplies a point by, r2 from the axis, and its derivative by r2."""
    two = real(2.0)
    three = real(3.0)
    factor = real(1.0) + r2 * (view.radial[0] + r2 * (view.radial[1] + r2 * view.radial[2]))
    slope = view.radial[0] + r2 * (two * view.radial[1] + r2 * three * view.radial[2])
    if view.rational == 1:
        k = view.divisor
        inverse = real(1.0) / (real(1.0) + r2 * (k[0] + r2 * (k[1] + r2 * k[2])))
        factor = factor * inverse
        slope = inverse * (slope - factor * (k[0] + r2 * (two * k[1] + r2 * three * k[2])))
    return factor, slope


@wp.func
def distort(view: CameraParams, p: vec2) -> vec2:
    """OpenCV's radial and tangential distortion of a point in the plane z = 1."""
    x = p[0]
    y = p[1]
    r2 = x * x + y * y
    radial, _slope = radial_factor(view, r2)
    p1 = view.tangential[0]
    p2 = view.tangential[1]
    two = real(2.0)
    return vec2(
        x * radial + two * p1 * x * y + p2 * (r2 + two * x * x),
        y * radial + p1 * (r2 + two * y * y) + two * p2 * x * y,
    )


@wp.func
def strain(view: CameraParams, r2: real) -> real:
    """A bound on how far distort's Jacobian is from the identity, up to r2 from the axis.

    Not of rational lenses.
    """
    radial = view.radial
    tangential = wp.abs(view.tangential[0]) + wp.abs(view.tangential[1])
    third = real(5.0) * wp.abs(radial[1]) + r2 * real(7.0) * wp.abs(radial[2])
    return r2 * (real(3.0) * wp.abs(radial[0]) + r2 * third) + real(8.0) * tangential * wp.sqrt(r2)


@wp.func
def undistort(view: CameraParams, distorted: vec2) -> vec2:
    """Inverse of distort, by Newton's method on the two equations.

    Where a lens changes little, p starts at the target. Else the target moves out from the
    principal point in eight strides of one step each, for which p is first moved straight on as
    far. Steps follow until p is close to where it ends, and four more. Where a lens folds over, and
    nothing is found, it ends wherever 40 steps lead. A rational lens has 32 strides, and p stays
    where it is before each: what is divided by may be close to 0 straight on.
    """
    stride = real(0.125)
    most = int(40)  # steps
    if view.rational == 1:
        stride = real(0.03125)
        most = 72
    p = vec2()
    two = real(2.0)
    share = real(0.0)  # of its way that the target has come
    if view.rational == 0 and strain(view, real(1.6) * wp.length_sq(distorted)) < real(0.5):
        p = distorted
        share = real(1.0)
    left = int(4)  # steps to take once p is close: each doubles the digits
    for _ in range(most):
        if share < real(1.0):
            further = share + stride
            if share > real(0.0) and view.rational == 0:
                p = p * (further / share)
            share = further
        elif wp.length_sq(distort(view, p) - distorted) < real(1.0e-6):
            left -= 1
        x = p[0]
        y = p[1]
        r2 = x * x + y * y
        radial, slope = radial_factor(view, r2)
        p1 = view.tangential[0]
        p2 = view.tangential[1]
        # The Jacobian of distort, which is symmetric.
        a = radial + two * x * x * slope + two * p1 * y + real(6.0) * p2 * x
        b = two * x * y * slope + two * p1 * x + two * p2 * y
        d = radial + two * y * y * slope + real(6.0) * p1 * y + two * p2 * x
        residual = distort(view, p) - share * distorted
        det = a * d - b * b
        p = p - vec2(d * residual[0] - b * residual[1], a * residual[1] - b * residual[0]) / det
        if left == 0:
            break
    return p


@wp.func
def fisheye_angle(view: CameraParams, distorted: real) -> real:
    """The angle to the axis whose distorted one is given, radians; at most view.angle_max.

    distorted = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), by Newton's method
    between bounds, in whose middle it continues where it would leave them.
    """
    low = real(0.0)
    high = view.angle_max
    theta = wp.min(distorted, high)
    left = int(3)  # steps to take once theta is close: each doubles the digits
    for _ in range(40):
        t2 = theta * theta
        rise = t2 * (view.radial[1] + t2 * (view.radial[2] + t2 * view.k4))
        residual = theta * (real(1.0) + t2 * (view.radial[0] + rise)) - distorted
        steep = real(7.0) * view.radial[2] + t2 * real(9.0) * view.k4
        steep = t2 * (real(5.0) * view.radial[1] + t2 * steep)
        slope = real(1.0) + t2 * (real(3.0) * view.radial[0] + steep)
        if residual > real(0.0):
            high = theta
        else:
            low = theta
        step = residual / slope
        if wp.abs(step) < real(1.0e-3) * slope:
            left -= 1
        theta = theta - step
        if not (theta >= low and theta <= high):
            theta = real(0.5) * (low + high)
        if left == 0:
            break
    return theta


@wp.func
def fisheye_direction(view: CameraParams, p: vec2) -> vec3:
    """Unit direction in camera axes of a distorted point, in focal lengths from the principal one.

    Points beyond what the lens can see get the direction of the last that it sees on their side.
    """
    distorted = wp.length(p)
    theta = fisheye_angle(view, distorted)
    across = real(1.0)
    if distorted > real(0.0):
        across = wp.sin(theta) / distorted
    return vec3(across * p[0], -across * p[1], -wp.cos(theta))


@wp.func
def pixel_direction(view: CameraParams, u: real, v: real) -> vec3:
    """Unit direction in world space of the ray through image position (u, v), in pixels."""
    p = vec2((u - view.principal[0]) / view.focal[0], (v - view.principal[1]) / view.focal[1])
    if view.fisheye == 1:
        return wp.normalize(view.rotation * fisheye_direction(view, p))
    bent = wp.length_sq(view.radial) + wp.length_sq(view.tangential)
    if bent > real(0.0) or view.rational == 1:
        p = undistort(view, p)
    return wp.normalize(view.rotation * vec3(p[0], -p[1], real(-1.0)))


@wp.kernel
def camera_rays(
    # launch
    first: int,
    # scene
    view: CameraParams,
    # out
    out_origins: wp.array(dtype=vec3),  # [H * W] scene units
    out_directions: wp.array(dtype=vec3),  # [H * W] unit vectors
):
    """The rays through all pixel centres of one camera, row by row."""
    i = first + wp.tid()
    out_origins[i] = view.position
    out_directions[i] = pixel_direction(
        view, real(i % view.width) + real(0.5), real(i // view.width) + real(0.5)
    )


@wp.func
def view_of_pixel(views: wp.array(dtype=CameraParams), pixel: wp.int64) -> int:
    """The last view whose first pixel is not after `pixel`."""
    low = int(0)
    high = int(views.shape[0])
    while high - low > 1:
        middle = (low + high) // 2
        before = views[middle].first_pixel <= pixel
        low = wp.where(before, middle, low)  # a processor cannot foresee which: no branch
        high = wp.where(before, high, middle)
    return low


@wp.func
def counting_pixel(view: CameraParams, number: int) -> int:
    """The pixel of a view that has so many before it that count."""
    if view.runs.shape[0] == 0:
        return number
    low = int(0)
    high = int(view.runs.shape[0])
    while high - low > 1:
        middle = (low + high) // 2
        before = view.runs[middle][0] <= number
        low = wp.where(before, middle, low)
        high = wp.where(before, high, middle)
    run = view.runs[low]
    return run[1] + number - run[0]


@wp.func
def shuffled(place: wp.uint64, n: wp.uint64, seed: int, epoch: int) -> wp.uint64:
    """The number from 0 to n - 1 at a place from 0 to n - 1 of a random order of all of these.

    A bijection of all numbers of as many bits as n - 1 has, applied until it ends below n: less
    than twice on average.
    """
    mask = n - wp.uint64(1)
    bits = wp.uint64(1)
    while mask >> bits != wp.uint64(0):
        bits += wp.uint64(1)
    mask = (wp.uint64(1) << bits) - wp.uint64(1)
    half = (bits + wp.uint64(1)) / wp.uint64(2)
    number = place
    found = int(0)
    while found == 0:
        state = wp.rand_init(seed, -1 - epoch)  # rays have the numbers from 0 on
        for _ in range(wp.static(ROUNDS)):
            number = (number + wp.uint64(wp.randu(state))) * wp.uint64(wp.static(SPREAD)) & mask
            number = number ^ (number >> half)
        found = wp.where(number < n, 1, 0)
    return number


@wp.kernel
def pick_pixels(
    # launch
    first: int,  # it picks for rays first, first + 1, ...
    # scene
    source: PixelSource,
    # choices
    draw: Draw,
    # out
    out_views: wp.array(dtype=wp.int32),  # [n_rays] the pixel's photograph v; -1 - v: not covered
    out_pixels: wp.array(dtype=wp.int32),  # [n_rays] the pixel there
):
    """The pixels of a batch: all that count in a random order, and then again in another one."""
    i = first + wp.tid()
    ray = draw.rays_before + wp.int64(i)
    epoch = ray // source.n_pixels
    place = wp.uint64(ray - epoch * source.n_pixels)
    pixel = wp.int64(shuffled(place, wp.uint64(source.n_pixels), draw.seed, int(epoch)))
    v = view_of_pixel(source.views, pixel)
    local = counting_pixel(source.views[v], int(pixel - source.views[v].first_pixel))
    out_views[i] = v
    out_pixels[i] = local
    if source.covered.shape[0] > 0:
        width = source.views[v].width
        block = source.block
        across = (width + block - 1) // block
        at = source.first_blocks[v] + local // width // block * across + local % width // block
        if source.covered[at] == wp.uint8(0):
            out_views[i] = -1 - v


@wp.func
def averaged(view: CameraParams, column: int, row: int, edge: real):
    """The mean of a photograph over a square around the middle of a pixel: alpha * rgb, and alpha;
    and whether it tells of an exposure: no mean does of which a part is cut off at 0 or 255.

    Pixels count by how much of them lies in the square. Beyond the photograph's edges there are
    copies of the pixels along these. Where there is a mask, a pixel stands for itself: none takes
    in what is masked.
    """
    edge = wp.where(view.runs.shape[0] > 0, real(1.0), wp.max(edge, real(1.0)))
    reach = reach_of(edge)
    width = view.width
    unit = real(1.0) / real(255.0)
    rgb = vec3(real(0.0), real(0.0), real(0.0))
    sum_alpha = real(0.0)
    tells = bool(True)
    for down in range(-reach, reach + 1):
        y = wp.clamp(row + down, 0, view.height - 1)
        for right in range(-reach, reach + 1):
            x = wp.clamp(column + right, 0, width - 1)
            share = overlap(down, edge) * overlap(right, edge)
            at = (y * width + x) * view.channels
            alpha = share
            if view.channels == 4:
                alpha = share * (real(view.pixels[at + 3]) * unit)
            sum_alpha += alpha
            r, g, b = view.pixels[at], view.pixels[at + 1], view.pixels[at + 2]
            rgb += alpha * (unit * vec3(real(r), real(g), real(b)))
            darkest = wp.min(wp.min(r, g), b)
            brightest = wp.max(wp.max(r, g), b)
            if reach > 0 and (darkest == wp.uint8(0) or brightest == wp.uint8(255)):
                tells = bool(False)
    whole = real(1.0) / (edge * edge)
    return whole * rgb, whole * sum_alpha, tells


@wp.func
def reach_of(edge: real) -> int:
    """How many pixels a square of that edge around the middle of one reaches beyond it."""
    return int(wp.ceil((wp.max(edge, real(1.0)) - real(1.0)) * real(0.5)))


@wp.func
def overlap(away: int, edge: real) -> real:
    """How much of a pixel lies in an interval of that length around the middle of another one."""
    within = real(0.5) * (edge + real(1.0)) - real(wp.abs(away))
    return wp.clamp(within, real(0.0), real(1.0))


@wp.kernel
def sample_pixels(
    # launch
    first: int,  # it makes rays first, first + 1, ...
    # scene
    source: PixelSource,
    picked_views: wp.array(dtype=wp.int32),  # [n_picked] by pick_pixels
    picked_pixels: wp.array(dtype=wp.int32),  # [n_picked] likewise
    picks: wp.array(dtype=wp.int32),  # [n_rays, and room] which of these rays are made of
    # choices
    draw: Draw,
    # out
    out_rays: Rays,
    out_target_rgb: wp.array(dtype=vec3),  # [n_rays] the pixel, or mean, over its background
    out_views: wp.array(dtype=wp.int32),  # [n_rays] its photograph; -1: tells of no exposure
):
    """A batch of rays through the pixels that were picked."""
    i = first + wp.tid()
    later = picks[wp.min(i + wp.static(AHEAD), picks.shape[0] - 1)]
    later_view = source.views[wp.max(picked_views[later], -1 - picked_views[later])]
    reach = reach_of(source.average)
    for down in range(-reach, reach + 1):
        beside = picked_pixels[later] + down * later_view.width
        prefetch(later_view.pixels, beside * later_view.channels)
    pick = picks[i]
    v = wp.max(picked_views[pick], -1 - picked_views[pick])
    local = picked_pixels[pick]
    state = wp.rand_init(draw.seed, int(draw.rays_before + wp.int64(pick)))
    view = source.views[v]
    out_rays.origins[i] = view.position
    out_rays.directions[i] = pixel_direction(
        view, real(local % view.width) + real(0.5), real(local // view.width) + real(0.5)
    )
    behind = draw.background
    if draw.background_mode == RANDOM_BACKGROUND:
        behind = vec3(real(wp.randf(state)), real(wp.randf(state)), real(wp.randf(state)))
    offset = real(0.5)
    if draw.jitter == 1:
        offset = real(wp.randf(state))
    rgb, alpha, tells = averaged(view, local % view.width, local // view.width, source.average)
    if source.gains.shape[0] > 0:
        rgb = wp.cw_div(rgb - alpha * source.offsets[v], source.gains[v])
    out_rays.offsets[i] = offset
    out_rays.background[i] = behind
    out_rays.content_distance[i] = source.content_distances[v]
    out_target_rgb[i] = rgb + (real(1.0) - alpha) * behind
    out_views[i] = wp.where(tells and alpha > real(0.999), v, -1)
