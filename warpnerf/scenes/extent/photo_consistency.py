"""Photo-consistency: whether photographs show the same where their poses say that they do.

A plane sweep, as in multi-view stereo: patches of a photograph are looked for in those of its
neighbours at many depths, and compared by normalised cross-correlation. Poses that are right find
each patch again at one depth, wrong ones by chance. Photographs are small, gray, and without
distortion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import COEFFICIENTS
from warpnerf.scenes.extent.patches import (
    LEAST_SIDE,
    PATCH,
    RIM,
    Picture,
    bilinear,
    correlation,
    project,
    reduced,
    spread_middles,
)
from warpnerf.scenes.scene import View

VIEWS = 64
"""That are looked at, at most, spread evenly."""
REFERENCES = 12
"""Of these whose patches are looked for, at most."""
NEIGHBOURS = 3
"""In which they are looked for."""
FEWEST = NEIGHBOURS + 2
"""Views, at least: a reference, its neighbours, and one that is none."""

DEPTHS = 24
"""From NEAREST baselines to infinity, evenly spaced in 1 / depth."""
NEAREST = 1.5
FINE_DEPTHS = 2 * DEPTHS
"""Where it is depths that are looked for."""

ANGLE = np.radians(30.0)
"""Of rotation, which sets a neighbour as far off as a spread of all cameras does."""
APART = 0.15
"""A neighbour is at least so far off, where there are such: nearer ones see the same whatever the
pose is."""
FAR_APART = 0.5
"""The same, where points are looked for: their depths must show."""

TEXTURE = 3.0
"""Standard deviation of a patch's gray values, of 255, from which on it can be recognised."""

CELL = 4
"""Pixels of the edges of cells, of whose points only the nearest is looked at: it hides others."""
MOST_POINTS = 60
"""Of a reference."""
FEWEST_POINTS = 4
"""That tell something of a reference."""

SURE = 0.6
"""Correlation of a patch at its best depth, from which on it is sure to be found."""
ALONE = 0.15
"""What a correlation with a single neighbour counts less: occlusion and repetition deceive one."""
AHEAD = 0.1
"""By how much that is more than at any depth that is not next to it."""

TELLING = 0.1
"""Mean gain of photographs that fit their poses, at least; captures have 0.15 to 0.4."""
MOST = 0.7
"""Share of references that must be found better than by chance by NOTABLY."""
NOTABLY = 0.05
CLEARLY = 0.02
"""By how much an agreement must be better than another, in mean gain and found."""
ALMOST_ALL = 0.8
"""Share of references for which it must be."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """How well patches are found again: for each reference, the mean of their correlations."""

    found: np.ndarray
    """[n] in [0, 1]; what no neighbour sees counts as 0."""
    by_chance: np.ndarray
    """[n], the same in photographs of other places, under the same geometry."""
    of: np.ndarray
    """[n] indices of the references."""

    @property
    def gain(self) -> np.ndarray:
        """[n], by how much they are found better than by chance."""
        return self.found - self.by_chance

    @property
    def fits(self) -> bool:
        """Whether photographs fit their poses."""
        gain = self.gain
        if len(gain) < 2:
            return False
        return bool(gain.mean() >= TELLING and np.mean(gain > NOTABLY) >= MOST)

    def is_better(self, given: Agreement) -> bool:
        """Whether photographs fit, and that beyond doubt better than as given."""
        if not self.fits:
            return False
        found = self.found - given.found
        gain = self.gain - given.gain
        better = min(found.mean(), gain.mean()) >= CLEARLY
        return bool(better and np.mean(found > 0.0) >= ALMOST_ALL)


Given = Callable[[View, np.ndarray, float], np.ndarray]
"""From a view, the middles of its patches [m, 2] in [0, 1] of width and height, and the largest
1 / distance of the sweep to those that are tried: [k, m] 1 / distance, NaN where not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotoConsistency:
    """Photographs of a scene, checked against poses and against points.

    Each is read when it is first looked at, and once for all poses that are tried.
    """

    views: Sequence[View]
    """Whose photographs these are."""
    poses: np.ndarray
    """[n, 3, 4] of these, camera to world in OpenGL axes, scene units."""
    zoom: float = 1.0
    """How many times their focal length the lenses have."""
    flip: tuple[bool, bool] = (False, False)
    """Whether photographs are mirrored left to right, and upside down."""
    undistorted: bool = False
    """Whether photographs are taken to have no distortion, whatever their lenses are."""
    among: tuple[int, ...] | None = None
    """Indices of the views whose patches may be looked for; None: all."""
    _pictures: dict[int, Picture] = field(default_factory=dict)

    @classmethod
    def of(cls, views: Sequence[View]) -> PhotoConsistency:
        """Some of these views, as they are posed."""
        chosen = views[:: max(1, -(-len(views) // VIEWS))]
        return cls(views=chosen, poses=np.array([view.camera.c2w for view in chosen]))

    @property
    def references(self) -> Sequence[int]:
        """Indices of the views whose patches are looked for."""
        among = range(len(self.views)) if self.among is None else self.among
        return among[:: max(1, -(-len(among) // REFERENCES))]

    @property
    def cameras(self) -> list[Camera]:
        """Of the views, as they are posed here."""
        pairs = zip(self.views, self.poses, strict=True)
        return [replace(view.camera, c2w=pose) for view, pose in pairs]

    @property
    def can_tell(self) -> bool:
        """Whether there are photographs enough, and large enough."""
        sides = [min(view.camera.width, view.camera.height) for view in self.views]
        return len(sides) >= FEWEST and min(sides) >= LEAST_SIDE

    def posed(self, poses: np.ndarray) -> PhotoConsistency:
        """The same photographs, had the cameras other poses [n, 3, 4]."""
        return replace(self, poses=poses)

    def zoomed(self, factor: float) -> PhotoConsistency:
        """The same photographs, had their lenses so many times the focal length."""
        return replace(self, zoom=factor)

    def mirrored(self, *, across: bool) -> PhotoConsistency:
        """The same photographs, mirrored left to right (``across``) or upside down."""
        return replace(self, flip=(across, not across))

    def straight(self) -> PhotoConsistency:
        """The same photographs, had their lenses no distortion."""
        return replace(self, undistorted=True)

    def of_views(self, among: Sequence[int]) -> PhotoConsistency:
        """The same photographs, of which patches of some are looked for in all."""
        return replace(self, among=tuple(among))

    def beside(self, views: Sequence[View]) -> PhotoConsistency:
        """Some of other views, whose patches are looked for in all of these and of those."""
        some = views[:: max(1, -(-len(views) // REFERENCES))]
        n, poses = len(self.views), np.array([view.camera.c2w for view in some])
        return replace(
            self,
            views=[*self.views, *some],
            poses=np.concatenate([self.poses, poses]),
            among=tuple(range(n, n + len(some))),
        )

    def apart(self) -> float:
        """How far off the neighbours of a reference are, by the median; see ``neighbours``."""
        poses = self.poses
        return float(
            np.median([_apart(poses, i)[neighbours(poses, i)].mean() for i in self.references])
        )

    @cached_property
    def agreement(self) -> Agreement:
        """How well patches of all references that have texture are found again."""
        found: list[float] = []
        by_chance: list[float] = []
        of: list[int] = []
        for i in self.references:
            middles = self._textured(i, spread_middles(self._picture(i).gray.shape))
            if not len(middles):
                continue
            near = neighbours(self.poses, i)
            inverse = np.tile(_inverse_depths(self.poses, i, near)[:, None], len(middles))
            shown = near, self._strangers(i, near)
            matches = _mean(self._matches(i, near, shown, middles, inverse))
            for match, means in zip(matches, (found, by_chance), strict=True):
                means.append(float(np.maximum(match.max(axis=0), 0.0).mean()))
            of.append(i)
        return Agreement(found=np.array(found), by_chance=np.array(by_chance), of=np.array(of, int))

    def farthest(self, i: int) -> float:
        """How far off the farthest neighbour of a reference is; see ``neighbours``."""
        return float(_apart(self.poses, i)[neighbours(self.poses, i)].max())

    @property
    def distorted(self) -> bool:
        """Whether a lens has distortion."""
        cameras = [view.camera for view in self.views]
        return any(c.fisheye or any(getattr(c, name) for name in COEFFICIENTS) for c in cameras)

    @property
    def tell_depths(self) -> bool:
        """Whether there are photographs enough that fit their poses."""
        return self.can_tell and self.agreement.fits

    def support_of(self, given: Given) -> float | None:
        """How well patches are found again at given depths, against the best depths of the sweep.

        Args:
            given: Tells the depths.

        Returns:
            As ``support``.
        """
        own, best = [], []
        for i in self.references:
            height, width = self._picture(i).gray.shape
            middles = self._textured(i, spread_middles((height, width)))
            near = neighbours(self.poses, i, FAR_APART)
            inverse = _inverse_depths(self.poses, i, near)
            tried = given(self.views[i], middles / [width, height], float(inverse[-1]))
            known = np.isfinite(tried).all(axis=0)
            if known.sum() < FEWEST_POINTS:
                continue
            sweep = np.tile(inverse[:, None], int(known.sum()))
            both = np.concatenate([sweep, tried[:, known]])
            (match,) = _mean(self._matches(i, near, [near], middles[known], both))
            found = np.maximum(match, 0.0)
            own.append(float(found[DEPTHS:].max(axis=0).mean()))
            best.append(float(found[:DEPTHS].max(axis=0).mean()))
        if len(own) < max(2, len(self.references) // 3) or np.mean(best) <= 0.0:
            return None
        return float(np.mean(own) / np.mean(best))

    def support(self, points: np.ndarray, every: int = 1) -> float | None:
        """How well patches around points are found again at these, against their best depths.

        Args:
            points: [m, 3] scene units.
            every: Every which reference is looked at.

        Returns:
            Their correlation as a share of that at the best depths of the sweep: about 1 for points
            on surfaces, about 0 for points anywhere. None where too few can be recognised.
        """
        own, best = [], []
        chosen = self.references[::every]
        for i in chosen:
            middles, away = self._foremost(i, points)
            near = neighbours(self.poses, i, FAR_APART)
            sweep = np.tile(_inverse_depths(self.poses, i, near)[:, None], len(middles))
            inverse = np.concatenate([sweep, 1.0 / away[None]])
            (match,) = _mean(self._matches(i, near, [near], middles, inverse))
            seen = match[-1] > -1.0
            if seen.sum() >= FEWEST_POINTS:
                own.append(float(match[-1, seen].mean()))
                best.append(float(match[:-1, seen].max(axis=0).mean()))
        if len(own) < max(2, len(chosen) // 3) or np.mean(best) <= 0.0:
            return None
        return max(0.0, float(np.mean(own) / np.mean(best)))

    def surfaces(self, i: int) -> np.ndarray:
        """Where patches of a reference are found beyond doubt, [n, 3] scene units.

        At one depth much better than at all others but those about it, and neither infinitely far
        nor at the near end of the sweep; pixels that a mask leaves out do not count.
        """
        picture, pose, mask = self._picture(i), self.poses[i], self.views[i].mask
        height, width = picture.gray.shape
        middles = self._textured(i, spread_middles((height, width)))
        if mask is not None:
            u, v = (middles * [mask.shape[1] / width, mask.shape[0] / height]).astype(np.int64).T
            middles = middles[mask[v.clip(max=len(mask) - 1), u.clip(max=mask.shape[1] - 1)]]
        if not len(middles):
            return np.empty((0, 3))
        near = neighbours(self.poses, i, FAR_APART)
        inverse = _inverse_depths(self.poses, i, near, FINE_DEPTHS)
        tried = np.tile(inverse[:, None], len(middles))
        matches = self._matches(i, near, [near], middles, tried)[:, 0]
        match = _mean(matches) - ALONE * (np.isfinite(matches).sum(axis=0) == 1)
        best, highest = match.argmax(axis=0), match.max(axis=0)
        about = np.abs(np.arange(FINE_DEPTHS)[:, None] - best) <= FINE_DEPTHS // DEPTHS
        others = np.where(about, -1.0, match).max(axis=0)
        sure = (highest >= SURE) & (highest >= others + AHEAD)
        sure &= (best > 0) & (best < FINE_DEPTHS - 1)
        middles, best, columns = middles[sure], best[sure], np.flatnonzero(sure)
        before, at, after = (match[best + step, columns] for step in (-1, 0, 1))
        # The highest point of the parabola through the best and those beside it.
        bend = np.maximum(2.0 * at - before - after, 1e-6)
        step = np.clip(0.5 * (after - before) / bend, -0.5, 0.5)
        rays = np.ones((len(middles), 3))
        rays[:, :2] = (middles - picture.centre) / picture.focal
        rays *= np.array([1.0, -1.0, -1.0]) / np.linalg.norm(rays, axis=1, keepdims=True)
        away = 1.0 / ((best + step) * inverse[1])
        return np.asarray(pose[:, 3] + away[:, None] * rays @ pose[:, :3].T)

    def _foremost(self, i: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a reference sees points with texture that others do not hide, and how far away."""
        picture, pose = self._picture(i), self.poses[i]
        local = (points - pose[:, 3]) @ pose[:, :3]
        pixels, front = project(picture, local)
        height, width = picture.gray.shape
        inside = (pixels > RIM) & (pixels < np.array([width, height]) - RIM)
        there = front & inside.all(axis=1)
        pixels, away = pixels[there], np.linalg.norm(local[there], axis=1)
        cell = (pixels // CELL).astype(np.int64) @ [1, width]
        order = np.lexsort((away, cell))
        first = order[np.unique(cell[order], return_index=True)[1]]
        first = first[:: max(1, -(-len(first) // MOST_POINTS))]
        kept = first[self._has_texture(i, pixels[first])]
        return pixels[kept], away[kept]

    def _matches(
        self,
        i: int,
        near: Sequence[int],
        shown: Sequence[Sequence[int]],
        middles: np.ndarray,
        inverse: np.ndarray,
    ) -> np.ndarray:
        """Correlations of patches of a reference with what its neighbours show at depths.

        Args:
            i: The reference.
            near: Its neighbours.
            shown: Whose photographs these show, one after the other: their own, or strangers'.
            middles: [m, 2] of its patches, pixels.
            inverse: [k, m] of 1 / distance from its centre.

        Returns:
            [len(near), len(shown), k, m], NaN where a neighbour does not see the patch there.
        """
        picture, poses = self._picture(i), self.poses
        pixels = middles[:, None] + PATCH
        patch = bilinear(picture.gray, pixels)
        rays = np.ones((*pixels.shape[:2], 3))
        rays[..., :2] = (pixels - picture.centre) / picture.focal
        rays *= np.array([1.0, -1.0, -1.0]) / np.linalg.norm(rays, axis=-1, keepdims=True)
        matches = np.zeros((len(near), len(shown), *inverse.shape))
        for number, (j, *others) in enumerate(zip(near, *shown, strict=True)):
            turn = poses[i][:, :3].T @ poses[j][:, :3]
            shift = (poses[i][:, 3] - poses[j][:, 3]) @ poses[j][:, :3]
            there, front = project(
                self._picture(j), rays @ turn + inverse[:, :, None, None] * shift
            )
            before = front.all(axis=-1)
            for n, other in enumerate(others):
                match = correlation(patch, bilinear(self._picture(other).gray, there))
                matches[number, n] = np.where(before, match, np.nan)
        return matches

    def _strangers(self, i: int, near: Sequence[int]) -> list[int]:
        """As many views as a reference has neighbours, spread evenly over those that are none."""
        rest = [k for k in range(len(self.views)) if k != i and k not in near]
        return [rest[(2 * k + 1) * len(rest) // (2 * len(near))] for k in range(len(near))]

    def _textured(self, i: int, middles: np.ndarray) -> np.ndarray:
        return middles[self._has_texture(i, middles)]

    def _has_texture(self, i: int, middles: np.ndarray) -> np.ndarray:
        patch = bilinear(self._picture(i).gray, middles[:, None] + PATCH)
        return np.asarray(patch.std(axis=1) > TEXTURE)  # not where it is NaN

    def _picture(self, i: int) -> Picture:
        if i not in self._pictures:
            self._pictures[i] = reduced(self.views[i])
        picture = self._pictures[i]
        if self.undistorted:
            picture = replace(picture, gray=picture.stored)
        if any(self.flip):
            picture = picture.mirrored(*self.flip)
        return picture if self.zoom == 1.0 else replace(picture, focal=self.zoom * picture.focal)


def _mean(matches: np.ndarray) -> np.ndarray:
    """Mean correlation over the neighbours, axis 0, that see a patch; -1 where none does."""
    known = np.isfinite(matches)
    seen, total = known.sum(axis=0), np.where(known, matches, 0.0).sum(axis=0)
    return np.where(seen > 0, total / np.maximum(seen, 1), -1.0)


def neighbours(poses: np.ndarray, i: int, least: float = APART) -> list[int]:
    """Neighbours of a camera: those that stand and look nearly as it does, but not quite.

    Args:
        poses: [n, 3, 4] camera to world, at least FEWEST.
        i: Index of the camera.
        least: How far off they are, at least, where there are such.

    Returns:
        NEIGHBOURS indices.
    """
    off = _apart(poses, i)
    order = [int(k) for k in np.argsort(off, kind="stable") if k != i]
    apart = [k for k in order if off[k] >= least]
    return (apart if len(apart) >= NEIGHBOURS else order[::-1])[:NEIGHBOURS]


def _apart(poses: np.ndarray, i: int) -> np.ndarray:
    """How far off a camera each is, [n]: in spreads of all, plus its rotation in ANGLE."""
    turned = np.einsum("nij,ij->n", poses[:, :, :3], poses[i][:, :3])
    angle = np.arccos(np.clip(0.5 * (turned - 1.0), -1.0, 1.0))
    centres = poses[:, :, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    return np.asarray(
        angle / ANGLE + np.linalg.norm(centres - centres[i], axis=1) / max(spread, 1e-12)
    )


def _inverse_depths(poses: np.ndarray, i: int, near: Sequence[int], n: int = DEPTHS) -> np.ndarray:
    """1 / distance from a reference, [n], from 0 to that of NEAREST baselines."""
    baselines = np.linalg.norm(poses[list(near), :, 3] - poses[i][:, 3], axis=1)
    return np.linspace(0.0, 1.0 / (NEAREST * max(float(np.median(baselines)), 1e-12)), n)
