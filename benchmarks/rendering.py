"""A frame of 800 x 800 pixels of a 160^3 grid that is mostly empty: rays and samples a second.

    python benchmarks/rendering.py
    python benchmarks/rendering.py --field runs/lego/field.safetensors

Without a field of your own it is a solid sphere in empty space, free cells marked as in training:
like a trained scene, most of the box is skipped and a surface stops a ray within a dozen samples.
warpnerf: everything that `Field.render` does, from the camera to arrays in numpy. Torch: the best
that eager torch can do, with the rays made beforehand. Both skip free cells, both end a ray where
less than a thousandth of the light would pass. They are checked against each other, then they
render in turns; ratios are formed frame by frame, figures are medians with 95 % intervals.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import warp as wp
from candidates.torch_eager import TorchScene
from measuring import (
    Stopwatch,
    default_threads,
    machine,
    median_interval,
    options,
    show,
    write_record,
)
from warpnerf_kernels.base.types import real, vec3
from workload import BOX, DENSITY_SHIFT, make_workload

import warpnerf as wn
from warpnerf.fields.dense import DenseGrid
from warpnerf.rendering.rays import camera_rays
from warpnerf.rendering.render import render_rays
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers

TRANSMITTANCE_MIN = 1e-3
TOLERANCE = 2 * TRANSMITTANCE_MIN
"""Of rgb in [0, 1]: each side leaves out what less light than that would show, at its own step."""


def sphere_field(grid: int, workers: Workers) -> wn.Field:
    """The solid sphere, marched a voxel at a time."""
    step = 2.0 / (grid - 1)
    work = make_workload("random", grid, 1, math.ceil(4.0 / step), scene="sphere")
    return wn.Field(
        model=work.warp_model(),
        storage=work.voxel_grid(workers),
        weights=work.weights(workers),
        free=work.free_cells(workers),
        steps=Steps(near=0.0, far=1e30, step=step, transmittance_min=TRANSMITTANCE_MIN),
        background=work.background,
        workers=workers,
    )


def camera_at(field: wn.Field, pixels: int) -> wn.Camera:
    """A square camera that has all occupied cells in view, from above and aside."""
    low, high = field.free.occupied_range() or (np.zeros(3), np.ones(3))
    extent = field.lattice.box_max - field.lattice.box_min
    centre = field.lattice.box_min + 0.5 * (low + high) * extent
    radius = 0.5 * float(np.linalg.norm((high - low) * extent))
    back = np.array([0.6, -0.6, 0.5])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(back, right), back], axis=1)
    return wn.Camera(
        width=pixels,
        height=pixels,
        fx=1.2 * pixels,
        fy=1.2 * pixels,
        cx=0.5 * pixels,
        cy=0.5 * pixels,
        c2w=np.concatenate([rotation, (centre + 2.2 * radius * back)[:, None]], axis=1),
    )


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What torch can do in more than one way."""

    threads: int
    split: int
    """Parts into which samples are cut, so that grid_sample runs in parallel."""
    rays: int
    """At a time."""
    steps: int
    """At a time: then rays that have ended are dropped."""


class TorchFrame:
    """The frame in eager torch: rays in batches, each from where it meets the occupied box, a few
    steps at a time for those that still continue."""

    def __init__(self, field: wn.Field, camera: wn.Camera, choices: Choices) -> None:
        """Load a field without contraction, and the camera's rays."""
        lattice, steps, grid = field.lattice, field.steps, field.storage
        assert isinstance(grid, DenseGrid)
        if lattice.contraction != "none":
            raise SystemExit("rendering: the field must not be contracted; train a bounded scene.")
        if field.model.name != "rgb":
            raise SystemExit("rendering: the field must be of the model rgb; train with it.")
        self.choices = choices
        low, high = lattice.box_min, lattice.box_max
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        values = grid.values.numpy().reshape(*lattice.size, 4).copy()
        values[..., 0] += grid.density_shift - DENSITY_SHIFT
        free = field.free.distance.numpy().reshape(field.free.size)
        self._scene = TorchScene(values, free, choices.split, "cpu")
        low, high = field.free.occupied_range() or (np.zeros(3), np.ones(3))
        self._low, self._high = (
            torch.from_numpy((2.0 * share - BOX).astype(np.float32)) for share in (low, high)
        )
        origins, directions = (array.numpy() for array in camera_rays(camera, field.workers))
        # In coordinates where the box is [-1, 1]^3, and t what it was.
        self._origins = torch.from_numpy(((origins - centre) / half).astype(np.float32))
        self._directions = torch.from_numpy((directions / half).astype(np.float32))
        self._steps = steps
        self._optical_step = steps.step * grid.density_scale
        self._background = torch.tensor(field.background)
        self.n_samples = 0
        """Samples of the last frame."""

    def render(self, every: int = 1) -> np.ndarray:
        """The frame, or every so many of its rays, [n_rays, 3]."""
        torch.set_num_threads(self.choices.threads)
        self.n_samples = 0
        with torch.inference_mode():
            batches = zip(
                self._origins[::every].split(self.choices.rays),
                self._directions[::every].split(self.choices.rays),
                strict=True,
            )
            return torch.cat([self._see(o, d) for o, d in batches]).numpy()

    def _see(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        near, dt, n_steps = self._steps.near, self._steps.step, self.choices.steps
        at_faces = torch.stack([self._low - origins, self._high - origins]) / directions
        enter = at_faces.amin(0).amax(1).clamp(min=near)
        leave = at_faces.amax(0).amin(1).clamp(max=self._steps.far)
        first = ((enter - near) / dt - 0.5).ceil()
        last = ((leave - near) / dt - 0.5).floor()
        rgb, light = torch.zeros_like(origins), torch.ones_like(enter)
        going = (first <= last).nonzero().view(-1)
        while going.shape[0] > 0:
            k = first[going][:, None] + torch.arange(n_steps)
            index = (k <= last[going][:, None]).view(-1).nonzero().view(-1)
            ray = going[index // n_steps]
            t = near + (k.view(-1)[index] + 0.5) * dt
            q = torch.addcmul(origins[ray], t[:, None], directions[ray])
            needed = self._scene.needed(q)
            if needed is not None:
                index, q = index[needed], q[needed]
            self.n_samples += index.shape[0]
            sigma, c = self._scene.shade(q)
            n = going.shape[0]
            tau = torch.zeros(n * n_steps).index_copy_(0, index, sigma * self._optical_step)
            c = torch.zeros(n * n_steps, 3).index_copy_(0, index, c)
            tau = tau.view(n, n_steps)
            depth = tau.cumsum(1)
            weight = light[going][:, None] * torch.exp(tau - depth) * -torch.expm1(-tau)
            rgb[going] += torch.bmm(weight[:, None], c.view(n, n_steps, 3))[:, 0]
            light[going] *= torch.exp(-depth[:, -1])
            first[going] += n_steps
            going = going[(light[going] >= TRANSMITTANCE_MIN) & (first[going] <= last[going])]
        return rgb + light[:, None] * self._background


def fastest(field: wn.Field, camera: wn.Camera, threads: int) -> TorchFrame:
    """The choices that take least time on a sixteenth of the frame, on up to that many threads."""
    stopwatch = Stopwatch("cpu")
    frames = [
        TorchFrame(field, camera, Choices(threads=count, split=split, rays=rays, steps=steps))
        for count in sorted({1, threads})
        for split, rays, steps in itertools.product(
            sorted({1, count}), (4096, 16384, 65536), (16, 32, 64)
        )
    ]
    return min(frames, key=lambda frame: stopwatch.better_of_two(lambda: frame.render(16)))


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--field", type=Path, help="a trained field of a bounded scene, model rgb")
    parser.add_argument("--grid", type=int, default=160, help="nodes per axis, without --field")
    parser.add_argument("--pixels", type=int, default=800, help="along each edge")
    parser.add_argument("--threads", type=int, nargs="+", default=default_threads())
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("--device: this one compares CPUs")
    stopwatch = Stopwatch("cpu")
    n_rays = args.pixels**2
    print(f"{args.pixels} x {args.pixels} pixels, {args.rounds} rounds; median [95 % interval]\n")
    rows = []
    for threads in args.threads:
        workers = Workers("cpu", threads)
        if args.field:
            field = wn.load_field(args.field, threads=threads)
            steps = replace(field.steps, transmittance_min=TRANSMITTANCE_MIN)
            field = replace(field, steps=steps)
        else:
            field = sphere_field(args.grid, workers)
        camera = camera_at(field, args.pixels)
        theirs = fastest(field, camera, threads)
        difference = float(np.abs(field.render(camera).rgb.reshape(-1, 3) - theirs.render()).max())
        if not difference < TOLERANCE:
            raise SystemExit(
                f"rendering: the two sides differ by {difference:.1e} (allowed: {TOLERANCE}); "
                "there is nothing to time."
            )
        n_samples = count_samples(field, camera)
        seconds = []
        for turn in range(args.rounds):
            sides = [("warpnerf", lambda f=field, c=camera: f.render(c)), ("torch", theirs.render)]
            if turn % 2:
                sides.reverse()
            seconds.append({name: stopwatch.seconds(side) for name, side in sides})
        row = {
            "threads": threads,
            "grid": field.lattice.size,
            "free": 1.0 - field.free.share(),
            "difference": difference,
            "torch_choices": asdict(theirs.choices),
            "torch_over_warpnerf": median_interval(s["torch"] / s["warpnerf"] for s in seconds),
        }
        for name, samples in (("warpnerf", n_samples), ("torch", theirs.n_samples)):
            row[name] = {
                "ms": median_interval(1e3 * s[name] for s in seconds),
                "rays_per_second": median_interval(n_rays / s[name] for s in seconds),
                "samples_per_second": median_interval(samples / s[name] for s in seconds),
                "n_samples": samples,
            }
        rows.append(row)
        print_row(row)
    record = {
        "benchmark": "rendering",
        "machine": machine(args.device, max(args.threads)),
        "pixels": args.pixels,
        "field": str(args.field) if args.field else "sphere",
        "rounds": args.rounds,
        "rows": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'rendering', args.device)}")


def count_samples(field: wn.Field, camera: wn.Camera) -> int:
    """What warpnerf samples in a frame."""
    origins, directions = camera_rays(camera, field.workers)
    rays = render_rays(
        field.model,
        field.storage,
        field.weights,
        field.free,
        field.steps,
        origins,
        directions,
        wp.full(1, 0.5, dtype=real),
        wp.full(1, vec3(*field.background), dtype=vec3),
        field.workers,
    )
    return int(rays.n_samples.numpy().sum())


def print_row(row: dict) -> None:
    """One number of threads."""
    size = " x ".join(str(n) for n in row["grid"])
    print(f"{row['threads']} threads, {size} nodes, {row['free']:.0%} of the cells free")
    for name in ("warpnerf", "torch"):
        figures = row[name]
        rays = {key: value / 1e6 for key, value in figures["rays_per_second"].items()}
        samples = {key: value / 1e6 for key, value in figures["samples_per_second"].items()}
        print(
            f"  {name:10s}{show(figures['ms'], 1):24s} ms   {show(rays, 2):20s} M rays/s   "
            f"{show(samples, 1):22s} M samples/s"
        )
    print(f"  torch / warpnerf  {show(row['torch_over_warpnerf'], 1)}")


if __name__ == "__main__":
    main()
