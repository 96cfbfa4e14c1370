"""Scene diagnostics: photographs, cameras and lenses that are unlike others, maybe by mistake."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.evaluation.evaluate import require_measurable
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import far_off, find_focus, share_aimed_at, upside_down
from warpnerf.scenes.formats.survey import Survey
from warpnerf.scenes.scene import Scene, View

MANY_TIMES = 20.0
"""A content distance so many times the estimate, or as small a part of it, is likely a mistake."""

MOST_APART = 0.6
"""Share of cameras, at most, that may be in another place."""
ENOUGH_PLACES, MOST_PLACES = 6, 2000
"""Of cameras, for that to be looked at."""
FROM_ZERO = 3000.0
"""How many times their spread degrees are from 0, at least: a kilometre is a hundredth of one."""
HIGHER, HIGHEST = 50.0, 1e6
"""How many times their spread heights in metres spread, at least and at most: what is 10 m wide is
1e-4 degrees wide."""
ASKEW = 0.02
"""Spread along one of longitude and latitude in that along the other, at least: of a straight track
there is next to none."""
FAR_FROM_ZERO = 5.0
"""Degrees of longitude or of latitude, at least, but in the Gulf of Guinea."""
UNITS = np.array([100.0, 1000.0])
"""How many of them make another."""
LIKELY = 1.5
"""One spread in another times such a number, or less, for these to be of other units."""
ALONG = 5.0
"""The same of distances from where most are: they need not lie around the origin."""

DARK = 16
"""Of 255, which a photograph's brightest pixel does not exceed that fills 12 of 16 bits."""

SATURATED = 250
"""Of 255, from which on a pixel is white."""
STILL = 3.0
"""Of 255, by which a pixel that is the same in all photographs varies, as a standard deviation:
bars of a video in JPEG have less, a place that two views see rarely."""
STILL_OF_SAME_WAY = 1.0
"""Such a deviation where cameras look the same way: there plain walls vary as little as that."""
SAME_WAY = 0.966
"""Length of the mean of the optical axes from which on that is so: 15 degrees from their middle."""
MANY_STILL = 0.01
"""Share of such pixels from which on they are something: real captures have up to 0.005."""
BACKGROUND = 0.2
"""Share of the pixels from which still ones of one colour may be a background."""
ENOUGH_STILL = 10
"""Photographs of one size, at least, by which that can be told."""
MOST_STILL = 200
"""Of them, at most, that are compared."""

OFF_CENTRE = 0.3
"""Of the image's width or height, from the middle to the principal point: no lens is so far off."""
ASIDE = 0.05
"""Of that, from where on it may be that of another picture."""
NOTABLE = 0.15
"""Of that, from where on it is, if it is as far off along both sides."""
ALIKE = 0.02
"""Of that, by which such shares may differ."""
LEAST = 0.05
"""Share of a picture's sides: a principal point that is nearer to the corner is in other units."""
SHORT = 0.15
"""Focal length as a share of the image's width: 147 degrees, which no lens but a fisheye sees."""
SQUARE = 1.2
"""One focal length in the other: pixels are square, of hardly any camera they are not."""

ESTIMATES_FIRST = (
    "training of 500 steps or more looks for better ones first, but with DVGO's presets"
)
"""What may become of guesses where it has not."""


def diagnostics(
    scene: Scene,
    found: Survey,
    content_distance: float,
    near: float,
    *,
    looked: bool,
    threads: int | None = None,
) -> list[str]:
    """Diagnostics of a scene: what may be a mistake, besides what it warns of.

    Args:
        scene: As it was loaded.
        found: In its files.
        content_distance: That training will use, scene units.
        near: The near plane that training will use, scene units.
        looked: Whether training has looked for content distance and box: what it has not found
            it will not find.
        threads: That look at photographs; None: one per usable core.

    Returns:
        A sentence each.

    Raises:
        InputError: An image is damaged.
    """
    odd = list(found.diagnostics) + _odd_images(scene, threads)
    times = content_distance / scene.content_distance
    if not 1.0 / MANY_TIMES <= times <= MANY_TIMES:
        odd.append(
            f"the content distance {content_distance:.4g} is {times:.4g} times what the cameras "
            f"suggest, {scene.content_distance:.4g} scene units: the scaling will "
            + ("have no effect" if times < 1.0 else "hold back everything that is seen")
        )
    cameras = scene.training_cameras
    if not found.built_in:  # they look everywhere, and know their true distances
        odd += _odd_directions(cameras, scene, content_distance, looked)
    odd += _odd_places(scene) + _odd_lenses(scene)
    nearest = max(near, _distance_to_box(scene))
    if nearest >= content_distance:
        why = "the near plane" if nearest == near else "the box"
        odd.append(
            f"the scaling has nothing to do: {why} begins {nearest:.4g} scene units "
            "from the cameras, but gradients are only scaled nearer than the content distance "
            f"{content_distance:.4g}"
        )
    return odd


def _odd_images(scene: Scene, threads: int | None) -> list[str]:
    """Photographs that show nothing, the same, or too little; each is looked at once."""
    odd = []
    with ThreadPoolExecutor(threads or usable_cores()) as pool:
        looks = dict(zip(scene.views, pool.map(_look, scene.views), strict=True))
    empty = [view.name for view, look in looks.items() if look.is_of_one_colour]
    if empty:
        odd.append(
            f"of one colour throughout: {len(empty)} of {len(scene.views)} images (first: "
            f"{empty[0]}), which show nothing that could be trained on"
        )
    shown = {view: look for view, look in looks.items() if not look.is_of_one_colour}
    gray = [view.name for view, look in shown.items() if look.is_gray]
    if 0 < len(gray) < len(shown):
        odd.append(
            f"gray among coloured ones: {len(gray)} of {len(scene.views)} images (first: "
            f"{gray[0]}), as of a thermal camera, or black-and-white; leave the gray ones out"
        )
    dark = [view.name for view, look in shown.items() if look.brightest <= DARK]
    if len(dark) > 0.5 * len(scene.views):
        odd.append(
            f"nearly black: {len(dark)} of {len(scene.views)} images (first: {dark[0]}), whose "
            f"brightest pixel is at most {DARK} of 255; numbers of 12 bits in files of 16 bits are "
            "to be multiplied by 16"
        )
    frozen = _frozen({view: look.sample.tobytes() for view, look in shown.items()})
    if frozen:
        odd.append(
            f"the same photograph at different poses: {len(frozen)} of {len(scene.views)} images "
            f"(first: {frozen[0][1]} is {frozen[0][0]} again), of which one at most can be right; "
            "leave out the others"
        )
    still, n = _share_still({v: look for v, look in shown.items() if look.brightest > DARK})
    if still > MANY_STILL:
        odd.append(
            f"the same in all photographs, wherever these were taken from: {still:.1%} of the "
            f"pixels of {n} of {len(scene.views)} images, as of borders, black bars, a logo, or a "
            "backdrop that does not turn with what stands before it; ignore them by masks, or cut "
            "out an object by alpha"
        )
    if scene.splits.get("test"):
        try:
            require_measurable(scene, "test")
        except InputError as error:
            odd.append(str(error).removesuffix("."))
    return odd


@dataclass(frozen=True, kw_only=True)
class _Look:
    """What a photograph is like."""

    is_of_one_colour: bool
    is_gray: bool
    brightest: int
    """The largest value of a channel of colour."""
    size: tuple[int, ...]
    """H, W."""
    sample: np.ndarray
    """Some of its pixels, [h, w, 3 or 4] uint8."""
    counts: np.ndarray
    """[h, w] bool, which of these are neither masked nor transparent."""


def _look(view: View) -> _Look:
    image, mask = view.image, view.mask
    every = (
        slice(None, None, max(1, len(image) // 32)),
        slice(None, None, max(1, image.shape[1] // 32)),
    )
    sample = image[every]
    counts = np.ones(sample.shape[:2], bool) if mask is None else mask[every].copy()
    if image.shape[2] == 4:
        counts &= sample[..., 3] > 0
    return _Look(
        is_of_one_colour=bool((sample == image[0, 0]).all() and (image == image[0, 0]).all()),
        is_gray=bool((sample[..., :3] == sample[..., :1]).all())
        and bool((image[..., :3] == image[..., :1]).all()),
        brightest=int(image[..., :3].max()),
        size=image.shape[:2],
        sample=sample.copy(),
        counts=counts,
    )


def _share_still(looks: Mapping[View, _Look]) -> tuple[float, int]:
    """The share of pixels that are the same in all photographs of the commonest size, and how many
    are compared, each once.

    White ones count only if all corners are still: else they may be a sky. Many of one colour, and
    no bars, are a background, which has no place.
    """
    sizes = Counter(look.size for look in looks.values())
    most = max(sizes, key=lambda size: sizes[size], default=())
    of_size = [look for look in looks.values() if look.size == most]
    alike = list({look.sample.tobytes(): look for look in of_size}.values())
    alike = alike[:: max(1, -(-len(alike) // MOST_STILL))]
    if len(alike) < ENOUGH_STILL:
        return 0.0, len(alike)
    samples = np.stack([look.sample[..., :3] for look in alike])
    seen = np.all([look.counts for look in alike], axis=0)
    axes = np.mean([view.camera.c2w[:, 2] for view in looks], axis=0)
    most_apart = STILL if np.linalg.norm(axes) < SAME_WAY else STILL_OF_SAME_WAY
    still = (samples.std(axis=0, dtype=np.float32) <= most_apart).all(axis=-1) & seen
    if not still[[0, 0, -1, -1], [0, -1, 0, -1]].all():
        still &= samples.min(axis=(0, -1)) < SATURATED
    bars = still.all(axis=1)[:, None] | still.all(axis=0)
    colours = samples.mean(axis=0)[still]
    if (
        still.mean() > BACKGROUND
        and not bars[still].all()
        and np.ptp(colours, axis=0).max() <= STILL
    ):
        return 0.0, len(alike)
    return float(still.mean()), len(alike)


def _frozen(samples: Mapping[View, bytes]) -> list[tuple[str, str]]:
    """Names of photographs of the same pixels at different poses, each with the first of these."""
    pairs = []
    first: dict[bytes, View] = {}
    for view, sample in samples.items():
        other = first.setdefault(sample, view)
        moved = not np.array_equal(other.camera.c2w, view.camera.c2w)
        if moved and np.array_equal(other.image, view.image):
            pairs.append((other.name, view.name))
    return pairs


def common_focus(cameras: Sequence[Camera]) -> np.ndarray | None:
    """The point that most cameras have in the middle of their image."""
    focus = find_focus(cameras)
    return None if focus.guessed else focus.point


def _odd_directions(
    cameras: Sequence[Camera], scene: Scene, content_distance: float, looked: bool
) -> list[str]:
    """Cameras that have nothing in common to look at, unless points tell what they see."""
    odd = []
    given = content_distance != scene.content_distance
    guesses = "the box is a guess" if given else "content distance and box are guesses"
    way_out = "poses with points, as COLMAP writes them"
    way_out = f"give {way_out}" if given else f"give a distance, or {way_out}"
    aimed = share_aimed_at(cameras, find_focus(cameras).point)
    turned = [_turned(camera) for camera in cameras]
    if common_focus(cameras) is None and common_focus(turned) is not None:
        odd.append(
            "all cameras look away from the point that they surround: if they should look at it, "
            "the poses are in OpenCV axes (looking along +z); negate their y and z columns"
        )
    elif common_focus(cameras) is None and scene.content_distances is None:
        odd.append(
            f"no common focus: {aimed:.0%} of the training cameras have one point in the middle of "
            f"their image, so {guesses}: {way_out if looked else ESTIMATES_FIRST}"
        )
    return odd


def _turned(camera: Camera) -> Camera:
    """The same camera, had its pose been in OpenCV axes."""
    return replace(camera, c2w=camera.c2w * np.array([1.0, -1.0, -1.0, 1.0]))


def _odd_places(scene: Scene) -> list[str]:
    """Cameras that stand on their heads, far away from all others, or in other units."""
    odd = []
    pairs = zip(scene.views, upside_down(scene.cameras), strict=True)
    rolled = [view.name for view, turned in pairs if turned]
    if rolled:
        odd.append(
            f"upside down against the others: {len(rolled)} of {len(scene.views)} cameras (first: "
            f"{rolled[0]}), whose photographs were turned, or whose poses are in other axes"
        )
    places = np.array([camera.position for camera in scene.cameras])
    far = far_off(scene.cameras)
    lost = [view.name for view, is_far in zip(scene.views, far, strict=True) if is_far]
    if lost:
        odd.append(
            f"far away from all others: {len(lost)} of {len(scene.views)} cameras (first: "
            f"{lost[0]}), which may be wrongly posed, or in other units"
        )
    scaled, times = _in_other_units(places)
    others = [view.name for view, is_far in zip(scene.views, scaled & ~far, strict=True) if is_far]
    if others:
        odd.append(
            f"cameras seem to be in other units: {len(others)} of {len(scene.views)} (first: "
            f"{others[0]}) are about {times:.2g} times as far from each other as the others are; "
            "bring all positions into the same units"
        )
    if _are_degrees(places if scene.offset is None else places + scene.offset):
        odd.append(
            "cameras seem to stand at degrees of longitude and latitude, with heights in metres; "
            "export their positions in metres, in a projected or local coordinate system"
        )
    return odd


def _in_other_units(places: np.ndarray) -> tuple[np.ndarray, float]:
    """Which of the places [n, 3], up to MOST_APART of them, where a median tells nothing, may be in
    other units than the others, [n] bool, and how many of these make one of theirs.

    They are MANY_TIMES as far from where most are as all of these, and about as many times as far
    from each other, which places somewhere else are not.
    """
    nowhere = np.zeros(len(places), bool), 1.0
    if not ENOUGH_PLACES <= len(places) <= MOST_PLACES:
        return nowhere
    between = np.linalg.norm(places[:, None] - places, axis=2)
    away = between[np.quantile(between, 1.0 - MOST_APART, axis=1).argmin()]
    order = np.sort(away)
    first = int((1.0 - MOST_APART) * len(order))
    gaps = order[first + 1 :] > MANY_TIMES * np.maximum(order[first:-1], 1e-300)
    if not gaps.any():
        return nowhere
    far = away > order[first + int(gaps.argmax())]
    times = _spread(places[far]) / max(_spread(places[~far]), 1e-300)
    from_middle = np.linalg.norm(places - places[~far].mean(axis=0), axis=1)
    further = np.median(from_middle[far]) / max(float(np.median(from_middle[~far])), 1e-300)
    is_unit = np.abs(np.log(UNITS / max(times, 1e-300))).min() <= np.log(LIKELY)
    return (far, times) if is_unit and times / ALONG <= further <= ALONG * times else nowhere


def _spread(places: np.ndarray) -> float:
    """Root mean square distance of places [n, 3] from their middle."""
    return float(np.sqrt(places.var(axis=0).sum()))


def _are_degrees(places: np.ndarray) -> bool:
    """Whether places [n, 3] are longitude and latitude, in either order, and height."""
    level = np.abs(places[:, :2]).max(axis=0)
    if len(places) < ENOUGH_PLACES or level.max() > 180.0 or level.min() > 90.0:
        return False
    across, up = np.ptp(places[:, :2], axis=0), float(np.ptp(places[:, 2]))
    away = np.abs(np.median(places[:, :2], axis=0)).max()
    far = away > max(FAR_FROM_ZERO, FROM_ZERO * across.max())
    both = across.min() > ASKEW * across.max()
    return bool(far and both and HIGHER * across.max() < up < HIGHEST * across.max())


def _odd_lenses(scene: Scene) -> list[str]:
    """Lenses as hardly any photograph has them: numbers in other units, perhaps."""
    odd = []
    aside, turned, other_size, wide, oblong = [], [], [], [], []
    for view in scene.views:
        camera = view.camera
        size = np.array([camera.width, camera.height])
        shares = np.array([camera.cx, camera.cy]) / size
        off = np.abs(shares - 0.5).max()
        is_in_pixels = shares.min() > LEAST and min(camera.cx, camera.cy) > 1.0  # else shares
        if off > ASIDE and np.abs(shares - 0.5 * size[::-1] / size).max() < ALIKE:
            turned.append(view.name)
        elif off > NOTABLE and np.ptp(shares) < ALIKE and is_in_pixels:
            other_size.append((view.name, 2.0 * float(shares.mean())))
        elif off > OFF_CENTRE:
            aside.append(view.name)
        if not camera.fisheye and min(camera.fx, camera.fy) < SHORT * camera.width:
            wide.append(view.name)
        if max(camera.fx, camera.fy) > SQUARE * min(camera.fx, camera.fy):
            oblong.append((view.name, camera))
    if turned:
        odd.append(
            f"the principal point is that of a picture turned by 90 degrees: {len(turned)} of "
            f"{len(scene.views)} cameras (first: {turned[0]}), whose cx is half the height and cy "
            "half the width; swap them, and fx and fy, if the pictures stand upright"
        )
    if other_size:
        name, times = other_size[0]
        odd.append(
            f"the principal point is at the same share of width and height, far from the middle: "
            f"{len(other_size)} of {len(scene.views)} cameras (first: {name}); cx, cy, and perhaps "
            f"fx, fy, are pixels of a picture {times:.3g} times as wide"
        )
    if aside:
        odd.append(
            f"principal point far from the middle of the image: {len(aside)} of "
            f"{len(scene.views)} cameras (first: {aside[0]}); cx and cy are pixels from its left "
            "and top edge"
        )
    if wide:
        odd.append(
            f"focal length below {SHORT:g} of the image's width: {len(wide)} of {len(scene.views)} "
            f"cameras (first: {wide[0]}); it is given in pixels"
        )
    if oblong:
        name, camera = oblong[0]
        odd.append(
            f"focal lengths along width and height differ much: {len(oblong)} of "
            f"{len(scene.views)} cameras (first: {name}, {camera.fx:.4g} and {camera.fy:.4g} "
            "pixels), as if pixels were not square; width and height may be exchanged"
        )
    return odd


def _distance_to_box(scene: Scene) -> float:
    """From the nearest training camera to what is sampled, scene units."""
    if scene.unbounded:
        return 0.0
    places = np.array([camera.position for camera in scene.training_cameras])
    outside = np.maximum(0.0, np.maximum(scene.box_min - places, places - scene.box_max))
    return float(np.linalg.norm(outside, axis=1).min())
