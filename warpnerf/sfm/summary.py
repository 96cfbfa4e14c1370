"""Summary of pose estimation, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpnerf.scenes.cameras.undistort import COEFFICIENTS
from warpnerf.scenes.files import printable
from warpnerf.scenes.formats.contents import NEEDED
from warpnerf.sfm.photographs import UnposedPhotograph

WELL_COVERED = 10
"""Photographs from which on a scene and its lens are well known."""

FEW_FEATURES = 200
"""Below which a photograph is blurred, dark or of something plain."""

SHOWN = 12
"""Photographs that a summary names."""


@dataclass(frozen=True, kw_only=True)
class Posing:
    """The result of camera pose estimation."""

    folder: Path
    """The scene's."""
    registered: int
    """Photographs whose poses are known."""
    photographs: int
    """All of them."""
    points: int
    """That they share."""
    error: float
    """Mean distance of the points to where photographs show them, pixels."""
    lenses: tuple[str, ...]
    """A line each."""
    missing: dict[str, str]
    """Photographs whose poses are not known, and why."""
    notes: tuple[str, ...] = ()
    """What is unusual, a sentence each."""

    def __str__(self) -> str:
        """A few lines for a terminal."""
        lines = [
            f"registered {self.registered} of {self.photographs} photographs; {self.points} points,"
            f" reprojection error {self.error:.2f} pixels",
            *(f"  {lens}" for lens in self.lenses),
        ]
        shown = list(self.missing.items())[:SHOWN]
        lines += [f"  not registered: {printable(name)}: {why}" for name, why in shown]
        if len(self.missing) > len(shown):
            lines.append(f"  and {len(self.missing) - len(shown)} more, which pose.json names")
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def summary(
    folder: Path, photographs: Sequence[UnposedPhotograph], found: Mapping[str, Any]
) -> Posing:
    """Put what ``sfm.mapping`` found into words.

    Args:
        folder: Of the scene.
        photographs: All that were to be placed.
        found: The result of ``mapping.run``, with at least one pose.
    """
    registered = found["registered"]
    missing = [p.path.name for p in photographs if p.path.name not in registered]
    notes = []
    if len(photographs) < WELL_COVERED:
        notes.append(
            f"only {len(photographs)} photographs: space that one or two of them see stays vague; "
            "30 and more are better"
        )
    others = _other_groups(found)
    if others:
        sizes = ", ".join(str(len(group)) for group in (registered, *others))
        notes.append(
            f"the photographs fall into {len(others) + 1} groups that share too little ({sizes}), "
            "and the largest is used; take some that join them"
        )
    elif 2 * len(registered) < len(photographs):
        notes.append(
            "more than half of the photographs could not be placed; neighbours should share at "
            "least half of what they show"
        )
    return Posing(
        folder=folder,
        registered=len(registered),
        photographs=len(photographs),
        points=found["points"],
        error=found["error"],
        lenses=tuple(_lenses(found["cameras"])),
        missing={name: _why(name, found) for name in missing},
        notes=tuple(notes),
    )


def nothing_placed(source: Path, found: Mapping[str, Any], n: int) -> str:
    """Why no photograph of a source could be placed, and the way out: a sentence."""
    # COLMAP's order is that in which its threads were done.
    poor = sorted(name for name, n_found in found["features"].items() if n_found < FEW_FEATURES)
    if 2 * len(poor) > n:
        return (
            f"{source}: none of {n} photographs could be placed: {len(poor)} of them show too "
            f"little (first: {poor[0]}, {found['features'][poor[0]]} features); take sharp, "
            "well lit ones of something with texture."
        )
    if not found["links"]:
        return (
            f"{source}: none of {n} photographs could be placed: no two of them show the same; "
            "neighbours should share at least half of what they show."
        )
    shared, other = max(found["links"].values())
    return (
        f"{source}: none of {n} photographs could be placed, though some match (at most {shared} "
        f"points, with {other}); move the camera sideways between photographs instead of turning "
        "it, and let neighbours share at least half of what they show."
    )


def _why(name: str, found: Mapping[str, Any]) -> str:
    """Why a photograph could not be placed."""
    features = found["features"][name]
    if features < FEW_FEATURES:
        return f"only {features} features: blurred, dark, or of something plain"
    for group in _other_groups(found):
        if name in group:
            return f"in a group of {len(group)} that shares too little with the others"
    if name not in found["links"]:
        return "shares nothing with any other photograph"
    shared, other = found["links"][name]
    return f"shares {shared} points with {other}, too few or too uncertain to place it"


def _other_groups(found: Mapping[str, Any]) -> list[set[str]]:
    """Photographs that were placed, but not with the others: models may have some in common."""
    left = [set(group) - found["registered"].keys() for group in found["groups"]]
    return [group for group in left if len(group) >= NEEDED]


def _lenses(cameras: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A line for each lens: model, focal length, distortion."""
    lenses = list({tuple(camera.items()): camera for camera in cameras.values()}.values())
    for lens in lenses[:SHOWN]:
        focal = sorted({f"{lens[key]:.1f}" for key in ("fl_x", "fl_y")})
        distortion = [f"{k} {lens[k]:.4f}" for k in COEFFICIENTS if lens.get(k)]
        yield (
            f"lens {lens['model']} for {lens['w']} x {lens['h']}: focal length "
            f"{', '.join(focal)} pixels" + "".join(f", {text}" for text in distortion)
        )
    if len(lenses) > SHOWN:
        yield f"and {len(lenses) - SHOWN} lenses more"
