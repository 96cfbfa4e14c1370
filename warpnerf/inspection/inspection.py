"""Inspection of a scene before training: what was understood, its cost, and diagnostics."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_at_least, require_positive
from warpnerf.config import TrainConfig
from warpnerf.inspection.diagnostics import common_focus, diagnostics
from warpnerf.model.registry import to_json
from warpnerf.optim_config import SceneKind
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.renamed import warn_renamed
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import angle_of
from warpnerf.scenes.cameras.focus import up_direction
from warpnerf.scenes.cameras.undistort import COEFFICIENTS
from warpnerf.scenes.extent.sharpness import in_words
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.survey import survey
from warpnerf.scenes.scene import Scene
from warpnerf.training.plan import TrainingPlan, resolve
from warpnerf.training.plan_json import plan_to_json

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Cost:
    """What a training takes on the CPU."""

    plan: TrainingPlan
    """What is trained, and the memory that it takes."""
    seconds: float
    """Within a factor of two or three: machines and scenes differ."""
    threads: int
    """For so many threads."""

    @property
    def time(self) -> str:
        """The seconds in words, or that they are not known of the device to be trained on."""
        device = self.plan.config.device
        if device != "cpu":
            return f"time on {device} is not estimated"
        of = f"{self.threads} CPU thread{'s' if self.threads > 1 else ''}"
        return f"very roughly {duration(self.seconds)} on {of}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Inspection:
    """A scene's summary and diagnostics: cameras, extent, training memory and time, what may be
    wrong."""

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
    diagnostics: tuple[str, ...]
    """What may be a mistake, a sentence each."""
    costs: dict[str, Cost]
    """By preset, or what else the configuration is called."""

    @property
    def space(self) -> Space:
        """The bounding box and contraction that the first training's voxel grid fills."""
        return next(iter(self.costs.values())).plan.space

    @property
    def widths(self) -> np.ndarray:
        """Voxel width in pixels at each of ``scene.observations``, [n]."""
        assert self.scene.observations is not None
        voxels = next(iter(self.costs.values())).plan.config.grid.n_nodes
        return self.space.voxel_widths(self.scene.observations, voxels)

    @property
    def oddities(self) -> tuple[str, ...]:
        """The deprecated name of ``diagnostics``."""
        warn_renamed("Inspection.oddities", "diagnostics")
        return self.diagnostics

    def facts(self) -> dict[str, Any]:
        """A dictionary of plain numbers and texts, for JSON."""
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
                    "model": to_json(cost.plan.config.model),
                    "memory": cost.plan.memory,
                    "seconds": cost.seconds if cost.plan.config.device == "cpu" else None,
                    "threads": cost.threads,
                    "contraction": cost.plan.space.contraction,
                    "box_min": cost.plan.space.box_min.tolist(),
                    "box_max": cost.plan.space.box_max.tolist(),
                    "border": cost.plan.space.border,
                    "voxel_pixels": [
                        cost.plan.voxel_pixels.low,
                        cost.plan.voxel_pixels.median,
                        cost.plan.voxel_pixels.high,
                    ],
                }
                for name, cost in self.costs.items()
            },
            "plans": {name: plan_to_json(cost.plan) for name, cost in self.costs.items()},
            "diagnostics": list(self.diagnostics),
            "odd": list(self.diagnostics),  # the former name, for one version more
        }

    def to_json(self) -> str:
        """The facts as JSON."""
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
            ("box", in_words(self.space, self.space.kind.words)),
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
                    f"model {cost.plan.config.model.name}, rays {cost.plan.sampler.past}: about "
                    f"{cost.plan.memory / 2**30:.2g} GiB of memory; {cost.time}",
                )
            )
            if cost.plan.config.field.as_fine_as_nodes:
                rows.append((f"voxels, {name}", str(cost.plan.voxel_pixels)))
        rows += [("warning", finding) for finding in self.diagnostics] or [("warnings", "none")]
        return "\n".join([scene.name, *(f"  {name:17} {text}" for name, text in rows)])


@checked_arguments
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
    """Summarise a scene: what was understood, diagnostics, and what training would take.

    Args:
        path: As for ``load_scene``.
        downscale: As for ``load_scene``.
        masks: As for ``load_scene``.
        content_distance: The one that training will be given, scene units; None: the estimate.
        near: The near plane that training will be given, scene units.
        configs: Trainings to plan, and whose costs to estimate, by name; by default fast and
            quality. Content distance and near plane, where given above, replace theirs.
        threads: CPU threads that training would have.

    Returns:
        What was found; its text is what ``warpnerf inspect`` prints.

    Raises:
        InputError: The scene cannot be loaded, or not be trained on as configured; where frames
            are to blame, it says how many are.
    """
    require_at_least("near", near, 0.0)
    if content_distance is not None:
        require_positive("content_distance", content_distance)
    if not configs:
        configs = {name: PRESETS[name] for name in DEFAULT_PRESETS}
    found = survey(path)
    try:
        scene = load_scene(path, downscale=downscale, masks=masks, images="files")
        distance = scene.content_distance if content_distance is None else content_distance
        odd = diagnostics(scene, found, distance, near, looked=False)
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
        diagnostics=(*scene.warnings, *odd),
        costs={
            name: cost_of(scene, _with(config, content_distance, near), threads)
            for name, config in configs.items()
        },
    )


def _with(config: TrainConfig, content_distance: float | None, near: float) -> TrainConfig:
    """A configuration with the content distance and the near plane that are given."""
    if content_distance is not None:
        config = replace(config, content_distance=content_distance)
    return replace(config, march=replace(config.march, near=near)) if near else config


def cost_of(scene: Scene, config: TrainConfig, threads: int) -> Cost:
    """What a training would take.

    Args:
        scene: What is trained on.
        config: How.
        threads: CPU threads that it would have.

    Raises:
        InputError: The configuration cannot be resolved for the scene.
    """
    plan = resolve(scene, config)
    voxels = plan.config.grid.n_nodes
    in_ndc = plan.space.frustum is not None
    samples, occupied = SAMPLES_IN_NDC if in_ndc else SAMPLES_AND_OCCUPIED[plan.kind]
    finer = (voxels / PRESETS["fast"].grid.n_nodes) ** (1.0 / 3.0) / config.march.step_voxels
    share = (np.arange(1000) + 0.5)[:, None] / 1000  # of the training, evenly
    nodes = voxels * 0.5 ** (share < plan.schedule.grow_at).sum(axis=1)
    steps_an_update = 2.0 ** (share >= plan.schedule.accumulate_at).sum(axis=1)
    step = config.rays_per_step * (
        SECONDS_PER_RAY + plan.sampler.samples_of(finer * samples) * SECONDS_PER_SAMPLE
    )
    step += float((nodes / steps_an_update).mean()) * occupied * SECONDS_PER_NODE
    step *= config.model.relative_time * plan.config.field.relative_time
    seconds = min(config.steps * step / threads, config.time_limit or math.inf)
    return Cost(plan=plan, seconds=seconds, threads=threads)


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


def duration(seconds: float) -> str:
    """Seconds in words, rounded up: 40 s, 12 min, 1.7 h."""
    if seconds < 90.0:
        return f"{10.0 * math.ceil(seconds / 10.0):.0f} s"
    minutes = math.ceil(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{seconds / 3600.0:.1f} h"
