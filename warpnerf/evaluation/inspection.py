"""What was understood of a scene before anything is trained, what it will take, and what is odd."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.checks import InputError, require_at_least, require_positive
from warpnerf.config import TRAINING_BYTES, Contraction, SceneKind, TrainConfig
from warpnerf.evaluation.oddities import common_focus, oddities
from warpnerf.model.interface import Model
from warpnerf.model.models import to_json
from warpnerf.presets import EVERYDAY, PRESETS
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.fisheye import angle_of
from warpnerf.scenes.focus import up_direction
from warpnerf.scenes.frustum import HELD, contraction_of
from warpnerf.scenes.load import load_scene
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.survey import survey
from warpnerf.scenes.undistort import COEFFICIENTS

SECONDS_PER_RAY, SECONDS_PER_SAMPLE, SECONDS_PER_NODE = 1.2e-6, 22e-9, 16e-9
"""Of one core, in a step for what is visited and in an update for each node in use: measured on an
AMD EPYC."""

SAMPLES_AND_OCCUPIED: dict[SceneKind, tuple[int, float]] = {
    "object": (12, 0.3),
    "bounded": (50, 0.8),
    "unbounded": (140, 0.6),
}
SAMPLES_IN_NDC = (60, 0.6)
"""Samples per ray, and the share of nodes in use: means of lego, builtin:room-sparse, fox and, in
normalised device coordinates, fern, late in training with the preset fast."""


PROCESS_BYTES = 250_000_000
"""What a training takes besides grid and photographs: Python, Warp, compiled kernels, pictures."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a training takes on the CPU."""

    model: Model
    """That is trained."""
    memory: int
    """Bytes, of grid, optimiser, gradients, photographs and the process itself."""
    seconds: float
    """Within a factor of two or three: machines and scenes differ."""
    threads: int
    """For so many threads."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Inspection:
    """What was understood of a scene, and what is odd about it."""

    scene: Scene
    """As it was loaded."""
    format: str
    """Of its files."""
    content_distance: float
    """In use: the scene's estimate, or the one that was given; scene units."""
    up: np.ndarray
    """[3] unit vector, estimated from the cameras."""
    focus: np.ndarray | None
    """[3] the point that the training cameras look at, scene units; None where there is none."""
    contraction: Contraction
    """How the first of the trainings that were asked about treats space outside the box, or ndc."""
    oddities: tuple[str, ...]
    """What may be a mistake, a sentence each."""
    costs: dict[str, Cost]
    """By preset, or what else the configuration is called."""

    def facts(self) -> dict[str, Any]:
        """All of it in plain numbers and texts, for JSON."""
        scene = self.scene
        lenses = scene.cameras
        return {
            "name": scene.name,
            "format": self.format,
            "views": len(scene.views),
            "splits": {split: len(indices) for split, indices in sorted(scene.splits.items())},
            "sizes": [[*size, count] for size, count in _sizes(lenses)],
            "focal_length": _range([f for c in lenses for f in (c.fx, c.fy)]),
            "field_of_view": [_degrees(lenses, "width", "fx"), _degrees(lenses, "height", "fy")],
            "principal_point": [
                _range([c.cx / c.width for c in lenses]),
                _range([c.cy / c.height for c in lenses]),
            ],
            "fisheye": sum(c.fisheye for c in lenses),
            "distortion": {
                name: _range([getattr(c, name) for c in lenses])
                for name in COEFFICIENTS
                if any(getattr(c, name) for c in lenses)
            },
            "up": [round(float(x), 4) + 0.0 for x in self.up],  # no -0
            "focus": None if self.focus is None else self.focus.tolist(),
            "box_min": scene.box_min.tolist(),
            "box_max": scene.box_max.tolist(),
            "unbounded": scene.unbounded,
            "content_distance": self.content_distance,
            "content_distances": None
            if scene.content_distances is None
            else _range(list(scene.content_distances[list(scene.splits["train"])])),
            "near_content": scene.near_content,
            "how": list(scene.notes),
            "costs": {
                name: {
                    "model": to_json(cost.model),
                    "memory": cost.memory,
                    "seconds": cost.seconds,
                    "threads": cost.threads,
                }
                for name, cost in self.costs.items()
            },
            "odd": list(self.oddities),
        }

    def to_json(self) -> str:
        """The facts."""
        return json.dumps(self.facts(), indent=2) + "\n"

    def __str__(self) -> str:
        """The facts in lines to read."""
        facts, scene = self.facts(), self.scene
        splits = ", ".join(f"{n} {split}" for split, n in facts["splits"].items())
        sizes = [
            f"{w} x {h}" + (f" ({n})" if n < len(scene.views) else "") for w, h, n in facts["sizes"]
        ]
        across, along = facts["field_of_view"]
        x, y = facts["principal_point"]
        box = " x ".join(f"{edge:.4g}" for edge in scene.box_max - scene.box_min)
        bent = [f"{name} {_span(values, 3)}" for name, values in facts["distortion"].items()]
        if facts["fisheye"]:
            some = "" if facts["fisheye"] == len(scene.views) else f" ({facts['fisheye']})"
            bent = [f"fisheye{some}", *bent]
        rows = [
            ("format", self.format),
            ("views", f"{len(scene.views)}: {splits}"),
            ("pixels", ", ".join(sizes[:4]) + (", ..." if len(sizes) > 4 else "")),
            ("focal length", f"{_span(facts['focal_length'])} pixels"),
            ("field of view", f"{_span(across, 3)} x {_span(along, 3)} degrees"),
            ("principal point", f"{_span(x, 3)} of the width, {_span(y, 3)} of the height"),
            ("distortion", ", ".join(bent) or "none"),
            ("up", "  ".join(f"{value:.3g}" for value in facts["up"])),
            (
                "box",
                f"{box} scene units, {HELD[self.contraction]}",
            ),
            ("content distance", f"{self.content_distance:.4g} scene units"),
        ]
        if scene.near_content is not None:
            rows.append(
                (
                    "points",
                    f"seen from {_span(facts['content_distances'])} scene units by a training "
                    f"camera, 1 in 100 from less than {scene.near_content:.4g}",
                )
            )
        rows += [("how", note) for note in scene.notes]
        for name, cost in self.costs.items():
            rows.append(
                (
                    f"training, {name}",
                    f"model {cost.model.name}: about {cost.memory / 2**30:.2g} GiB of memory; "
                    f"very roughly {_duration(cost.seconds)} on {cost.threads} CPU threads",
                )
            )
        rows += [("odd", oddity) for oddity in self.oddities] or [("odd", "nothing")]
        return "\n".join([scene.name, *(f"  {name:17} {text}" for name, text in rows)])


def inspect(
    path: str | Path,
    *,
    downscale: int = 1,
    masks: str | Path | None = None,
    content_distance: float | None = None,
    near: float = 0.0,
    configs: Mapping[str, TrainConfig] | None = None,
    threads: int = 2,
) -> Inspection:
    """Look a scene over: what was understood, what is odd, and what training would take.

    Args:
        path: As for ``load_scene``.
        downscale: As for ``load_scene``.
        masks: As for ``load_scene``.
        content_distance: The one that training will be given, scene units; None: the estimate.
        near: The near plane that training will be given, scene units.
        configs: Trainings whose costs to estimate, by name; by default fast and quality.
        threads: CPU threads that training would have.

    Returns:
        What was found; its text is what ``warpnerf inspect`` prints.

    Raises:
        InputError: The scene cannot be loaded; where frames are to blame, it says how many are.
    """
    require_at_least("near", near, 0.0)
    if content_distance is not None:
        require_positive("content_distance", content_distance)
    if not configs:
        configs = {name: PRESETS[name] for name in EVERYDAY}
    found = survey(path)
    try:
        scene = load_scene(path, downscale=downscale, masks=masks, images="files")
        distance = scene.content_distance if content_distance is None else content_distance
        odd = oddities(scene, found, distance, near, looked=False)
    except InputError as error:
        others = [place for place in found.refused if place not in str(error)]
        if not others:
            raise
        named = ", ".join(others[:5]) + (", ..." if len(others) > 5 else "")
        raise InputError(f"{error} Poses refused likewise: {len(others)} more ({named}).") from None
    return Inspection(
        scene=scene,
        format=found.format,
        content_distance=distance,
        up=up_direction(scene.training_cameras),
        focus=common_focus(scene.training_cameras),
        contraction=contraction_of(scene, next(iter(configs.values()))),
        oddities=(*scene.warnings, *odd),
        costs={name: _cost(scene, config, threads) for name, config in configs.items()},
    )


def _cost(scene: Scene, config: TrainConfig, threads: int) -> Cost:
    voxels = config.grid.voxels
    images = sum(v.camera.width * v.camera.height * v.channels for v in scene.views)
    memory = TRAINING_BYTES * config.model.n_floats * voxels + images + PROCESS_BYTES

    in_ndc = contraction_of(scene, config) == "ndc"
    samples, occupied = SAMPLES_IN_NDC if in_ndc else SAMPLES_AND_OCCUPIED[scene.kind]
    finer = (voxels / PRESETS["fast"].grid.voxels) ** (1.0 / 3.0) / config.march.step_voxels
    share = (np.arange(1000) + 0.5)[:, None] / 1000  # of the training, evenly
    nodes = voxels * 0.5 ** (share < config.grid.grows_at(scene.kind)).sum(axis=1)
    steps_an_update = 2.0 ** (share >= config.optim.accumulates_at(scene.kind)).sum(axis=1)
    step = config.rays_per_step * (SECONDS_PER_RAY + finer * samples * SECONDS_PER_SAMPLE)
    step += float((nodes / steps_an_update).mean()) * occupied * SECONDS_PER_NODE
    step *= config.model.relative_time
    seconds = min(config.steps * step / threads, config.time_limit or math.inf)
    return Cost(model=config.model, memory=memory, seconds=seconds, threads=threads)


def _sizes(cameras: Sequence[Camera]) -> list[tuple[tuple[int, int], int]]:
    return Counter((camera.width, camera.height) for camera in cameras).most_common()


def _range(values: Sequence[float]) -> list[float]:
    return [float(min(values)), float(max(values))]


def _degrees(cameras: Sequence[Camera], size: str, focal: str) -> list[float]:
    """The range of fields of view, without distortion; of fisheye lenses, with it."""
    halves = []
    for camera in cameras:
        half = 0.5 * getattr(camera, size) / getattr(camera, focal)
        wide = camera.fisheye
        halves.append(float(angle_of(camera.radial, np.array(half))) if wide else math.atan(half))
    return _range([math.degrees(2.0 * half) for half in halves])


def _span(values: Sequence[float], digits: int = 4) -> str:
    low, high = (f"{value:.{digits}g}" for value in values)
    return low if low == high else f"{low} to {high}"


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{10.0 * math.ceil(seconds / 10.0):.0f} s"
    minutes = math.ceil(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{seconds / 3600.0:.1f} h"
