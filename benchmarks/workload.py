"""What the benchmarks render and how they time it: rays, a random grid, the machine, medians.

Nothing here is measured; see gradient_scaling.py and throughput.py.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp
from warpnerf_kernels.types import real, vec3, vec4

from warpnerf.grid import VoxelGrid
from warpnerf.parallel import Workers
from warpnerf.rays import RayBatch
from warpnerf.render import Steps

BOX = np.ones(3)
"""The box is [-1, 1]^3."""
DENSITY_SHIFT = -1.0
"""Of a grid of standard normal raw values: half of the light crosses the box."""
INSIDE_LENGTH = 1.5
"""What of a ray is sampled, all of it in the box, scene units."""
CAMERA_DISTANCE = 1.6
"""Of the cameras of crossing rays from the centre, scene units."""

Rays = Literal["inside", "crossing"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Workload:
    """Rays through a grid and what they should see, as arrays that both sides load."""

    values: np.ndarray
    """[X, Y, Z, 4] float32 raw density, raw rgb."""
    origins: np.ndarray
    """[n_rays, 3] float32, scene units."""
    directions: np.ndarray
    """[n_rays, 3] float32, unit."""
    target_rgb: np.ndarray
    """[n_rays, 3] float32 in [0, 1]."""
    n_steps: int
    """Steps along each ray, from near = 0 on."""
    step: float
    """Their length, scene units."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """rgb in [0, 1]."""
    content_distance: float = 1.0
    """Scene units; most rays have samples on both sides of it."""

    def voxel_grid(self, workers: Workers) -> VoxelGrid:
        """The grid as warpnerf takes it."""
        size = self.values.shape[:3]
        return VoxelGrid(
            values=wp.array(self.values.reshape(-1, 4), dtype=vec4, device=workers.device),
            size=(size[0], size[1], size[2]),
            box_min=-BOX,
            box_max=BOX,
            density_shift=DENSITY_SHIFT,
        )

    def steps(self) -> Steps:
        """The steps as warpnerf takes them."""
        return Steps(near=0.0, far=self.n_steps * self.step, step=self.step)

    def batch(self, workers: Workers) -> RayBatch:
        """The rays as warpnerf takes them."""
        return RayBatch(
            origins=wp.array(self.origins, dtype=vec3, device=workers.device),
            directions=wp.array(self.directions, dtype=vec3, device=workers.device),
            offsets=wp.array([0.5], dtype=real, device=workers.device),
            background=wp.array([self.background], dtype=vec3, device=workers.device),
            content_distance=wp.array([self.content_distance], dtype=real, device=workers.device),
            target_rgb=wp.array(self.target_rgb, dtype=vec3, device=workers.device),
        )


def make_workload(rays: Rays, grid: int, n_rays: int, n_steps: int, seed: int = 0) -> Workload:
    """Random rays through a grid^3 of standard normal raw values.

    Args:
        rays: inside: cameras in the box, all n_steps samples of a ray too. crossing: cameras on a
            sphere around the box look into it, and the steps reach to its far corner.
        grid: Nodes along each axis.
        n_rays: Number of rays.
        n_steps: Steps along each.
        seed: Of all that is random.
    """
    rng = np.random.default_rng(seed)
    reach = INSIDE_LENGTH if rays == "inside" else CAMERA_DISTANCE + math.sqrt(3.0)
    step = reach / n_steps
    many = 2 * n_rays + 64
    if rays == "inside":
        directions = _unit(rng.normal(size=(many, 3)))
        # Uniform among the places from which the whole length fits into the box.
        room = 2.0 - 1e-3 - np.abs(directions) * reach
        first = np.where(directions < 0, 1.0 - 5e-4 - room, -1.0 + 5e-4)
        origins = first + rng.uniform(size=(many, 3)) * room
    else:
        origins = CAMERA_DISTANCE * _unit(rng.normal(size=(many, 3)))
        directions = _unit(rng.uniform(-0.6, 0.6, size=(many, 3)) - origins)
    # Which side of the box's face a sample lies on must not hang on rounding: the two sides round
    # differently, and a sample more or less is no error of either.
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    t = (np.arange(n_steps) + 0.5) * step
    q = origins[:, None].astype(float) + t[:, None] * directions[:, None]
    clear = (np.abs(np.abs(q) - 1.0) > 1e-5).all(axis=(1, 2))
    return Workload(
        values=rng.normal(size=(grid, grid, grid, 4)).astype(np.float32),
        origins=origins[clear][:n_rays],
        directions=directions[clear][:n_rays],
        target_rgb=rng.uniform(size=(n_rays, 3)).astype(np.float32),
        n_steps=n_steps,
        step=step,
    )


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


class Stopwatch:
    """Times calls on a device; on CUDA many in a row, so that launching hides behind working."""

    def __init__(self, device: str) -> None:
        """For a device as Warp names it."""
        self._cuda = device.startswith("cuda")
        self._calls = 20 if self._cuda else 1

    def seconds(self, call: Callable[[], object]) -> float:
        """Of one call."""
        self._synchronize()
        begin = time.perf_counter()
        for _ in range(self._calls):
            call()
        self._synchronize()
        return (time.perf_counter() - begin) / self._calls

    def _synchronize(self) -> None:
        if self._cuda:
            wp.synchronize()  # the whole device: torch's stream too


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """Lower quartile, median, upper quartile."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def median_interval(values: list[float]) -> tuple[float, float, float]:
    """Median and its 95 % interval, from order statistics: no assumption on the distribution.

    Returns:
        Lower end, median, upper end. With fewer than 6 values the ends are the least and greatest,
        which cover less than 95 %.
    """
    ordered = sorted(values)
    n = len(ordered)
    low = max(0, math.floor((n - 1.96 * math.sqrt(n)) / 2.0) - 1)
    return ordered[low], float(np.median(ordered)), ordered[n - 1 - low]


def machine(device: str, threads: int) -> dict[str, Any]:
    """What a record says about where it was made."""
    import torch

    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": device,
        "gpu": wp.get_device(device).name if device.startswith("cuda") else None,
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "warp": wp.config.version,
        "torch": torch.__version__,
        "system": platform.platform(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": " ".join(["python", *sys.argv]),
    }


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def write_record(record: dict[str, Any], output: Path | None, name: str, device: str) -> Path:
    """Write a record to `output`, or else to results/<name>_<device>.json beside this file."""
    if output is None:
        output = Path(__file__).parent / "results" / f"{name}_{device.replace(':', '')}.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(record, indent=2) + "\n")
    return output
