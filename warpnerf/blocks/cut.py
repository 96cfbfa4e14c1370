"""Cutting a capture into blocks: disjoint cores, each with the photographs that see it.

Cores are the leaves of a k-d tree over the box of the scene. Each split halves what photographs
see, so blocks have about as many of them. A core at a face of the scene's box extends behind it
without end, so that cores fill space: what is around the scene belongs to the outermost blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from warpnerf.checks import InputError, require_whole
from warpnerf.scenes.cameras.overlap import content_at, in_picture
from warpnerf.scenes.scene import Scene, View

MARGIN = 0.1
"""Of a core, on each side, in its edges: what its block is trained for besides."""

SEEN = 0.05
"""Share of what a photograph sees that lies in a block's box, from which it trains the block."""

PIXELS = 256
"""Of a photograph with depth that are looked at, about."""

FARTHEST = 3.0
"""Points farther than so many content distances of a camera are likely to be hidden from it."""

FEW = 8
"""Points that tell what a camera sees; with fewer it is taken to look into its content distance."""

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the content distance: where on its rays such a camera may see something."""

LEAST = 0.1
"""Share of an edge that a split leaves at either side, at least."""

ROUNDING = 1e-9
"""Of sums of weights and of volumes."""

MOST = 4096
"""Blocks."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """A part of a scene that is trained alone."""

    core: np.ndarray
    """[2, 3] lower and upper corner, scene units, within the box of the scene."""
    cell: np.ndarray
    """[2, 3] where it is rendered: the core, infinite where that ends at the scene's box."""
    box: np.ndarray
    """[2, 3] what it is trained for: the core with its margin."""
    views: tuple[int, ...]
    """Indices of the photographs that see the box."""


def cut(scene: Scene, count: int) -> list[Block]:
    """Cut a scene into blocks.

    Args:
        scene: A capture; its photographs are not read, but their depths are, where they are known.
        count: Of blocks.

    Returns:
        Blocks whose cells are disjoint and fill space.

    Raises:
        InputError: There are fewer training photographs than that, or one sees no block.
    """
    require_whole("--count", count, 1)
    train = scene.splits["train"]
    if count > min(MOST, len(train)):
        raise InputError(
            f"--count {count} is more than {scene.name} can be cut into: it has {len(train)} "
            f"training photographs, and there are at most {MOST} blocks; use fewer."
        )
    seen = [seen_by(scene, index) for index in range(len(scene.views))]
    root = np.stack([scene.box_min, scene.box_max])
    places = np.concatenate([seen[index] for index in train])
    weights = np.concatenate([np.full(len(seen[i]), 1.0 / max(1, len(seen[i]))) for i in train])
    inside = ((root[0] <= places) & (places <= root[1])).all(axis=1)
    blocks = []
    for core in _leaves(root, places[inside], weights[inside], count):
        cell = np.where(core == root, [[-np.inf], [np.inf]], core)
        margin = MARGIN * (core[1] - core[0])
        wide = np.stack([cell[0] - margin, cell[1] + margin])
        views = [i for i, view in enumerate(scene.views) if _trains(view, seen[i], wide)]
        if not {*views} & {*train}:
            raise InputError(
                f"--count {count} makes a block that no training photograph of {scene.name} sees; "
                "use fewer."
            )
        box = np.stack([core[0] - margin, core[1] + margin])
        blocks.append(Block(core=core, cell=cell, box=box, views=tuple(views)))
    return blocks


def fills(cores: np.ndarray, box: np.ndarray) -> bool:
    """Whether boxes fill another one, each place once.

    Args:
        cores: [n, 2, 3] lower and upper corners, scene units.
        box: [2, 3] those of the other one.
    """
    with np.errstate(all="ignore"):  # of values that are too large, which fill nothing
        low, high = np.moveaxis((cores - box[0]) / (box[1] - box[0]), 1, 0)  # within [0, 1]
        within = (low >= 0.0).all() and (low < high).all() and (high <= 1.0).all()
        volume = (high - low).prod(axis=1).sum()
    return bool(
        (box[0] < box[1]).all()
        and within
        and abs(volume - 1.0) < ROUNDING
        and not any(
            ((low[:n] < high[n]) & (low[n] < high[:n])).all(axis=1).any() for n in range(len(low))
        )
    )


def seen_by(scene: Scene, index: int) -> np.ndarray:
    """Places that a photograph sees, as far as is known: by its depth, by points, or by guess.

    Args:
        scene: That it belongs to.
        index: Of its view.

    Returns:
        [n, 3] scene units; at least one.
    """
    view, distances = scene.views[index], scene.content_distances
    camera = view.camera
    distance = scene.content_distance if distances is None else float(distances[index])
    depth = view.depth
    if depth is not None:
        block = camera.block_for(PIXELS)
        rows, columns = (np.arange(block // 2, size, block) for size in depth.shape)
        row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
        places = content_at(camera, column + 0.5, row + 0.5, depth[row, column])
        places = places[np.isfinite(places).all(axis=1)]
        if len(places) >= FEW:
            return places
    if scene.points is not None:
        points = scene.points[in_picture(camera, scene.points)]
        away = np.linalg.norm(points - camera.position, axis=1)
        if (away < FARTHEST * distance).sum() >= FEW:
            return np.asarray(points[away < FARTHEST * distance])
    block = camera.block_for(PIXELS // len(SHARES))
    v, u = (
        axis.ravel() + 0.5
        for axis in np.meshgrid(
            np.arange(block // 2, camera.height, block),
            np.arange(block // 2, camera.width, block),
            indexing="ij",
        )
    )
    return np.concatenate(
        [content_at(camera, u, v, np.full(len(u), share * distance)) for share in SHARES]
    )


def _trains(view: View, seen: np.ndarray, box: np.ndarray) -> bool:
    """Whether a photograph is of use to a block: it sees its box, or was taken there."""
    position = view.camera.position
    share = float(((box[0] <= seen) & (seen <= box[1])).all(axis=1).mean())
    return share >= SEEN or bool(((box[0] <= position) & (position <= box[1])).all())


def _leaves(
    box: np.ndarray, places: np.ndarray, weights: np.ndarray, count: int
) -> Iterator[np.ndarray]:
    """The leaves of a k-d tree, [2, 3] each: split across the longest edge, by weight."""
    if count == 1:
        yield box
        return
    first = count // 2
    axis = int(np.argmax(box[1] - box[0]))
    at = _quantile(places[:, axis], weights, first / count, box[:, axis])
    below = places[:, axis] < at
    for part, share, end in ((below, first, 1), (~below, count - first, 0)):
        half = box.copy()
        half[end, axis] = at
        yield from _leaves(half, places[part], weights[part], share)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float, ends: np.ndarray) -> float:
    """Below which a share of the weight lies, or of the edge if there is no weight; well between
    the ends."""
    low, high = float(ends[0]), float(ends[1])
    at = low + share * (high - low)
    if weights.sum() > 0.0:
        order = np.argsort(values, kind="stable")
        total = np.cumsum(weights[order])
        last = int(np.searchsorted(total, share * total[-1] * (1.0 - ROUNDING)))
        pair = values[order[last : last + 2]]
        at = float(pair.mean())  # in the middle of a gap
    edge = LEAST * (high - low)
    return float(np.clip(at, low + edge, high - edge))
