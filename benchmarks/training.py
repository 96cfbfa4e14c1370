"""Where the time of a training goes: rays and their gradient, and everything else.

    python benchmarks/training.py builtin:room path/to/scene --time-limit 36

Scenes are built-in ones, folders, or folders in the one that WARPNERF_DATA names. Prints a table of
shares of the training's time and writes benchmarks/results/training_<device>.json. What a part
calls of another's counts for that other one: growing the grid looks for free space, for example.
"""

from __future__ import annotations

import functools
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import warp as wp
from measuring import add_model, machine, options, plain_training, write_record

import warpnerf as wn
from warpnerf.fields.total_variation import TotalVariation
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers
from warpnerf.training import trainer as training
from warpnerf.training.trainer import Trainer

PARTS: dict[str, list[tuple[Any, str]]] = {
    "rays": [(TrainingPass, "run")],
    "drawing": [(PixelSampler, "draw")],
    "Adam": [(training, "adam_step")],
    "smoothing": [(TotalVariation, "__call__")],
    "free space": [(Trainer, "_look_for_free_space")],
    "growing": [(Trainer, "_grow")],
    "reports": [(Trainer, "report")],
}
"""Which functions make up a part."""


class Clock:
    """Sums what calls take, without what they call of each other."""

    def __init__(self, on_cuda: bool) -> None:
        """Nothing yet; on CUDA a call ends when its launches do."""
        self.seconds: Counter[str] = Counter()
        self._on_cuda = on_cuda
        self._inner = [0.0]  # of each call under way, what was spent in others

    def timing(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The same call, timed."""

        @functools.wraps(call)
        def timed(*arguments: Any, **named: Any) -> Any:
            begin = self._now()
            self._inner.append(0.0)
            try:
                return call(*arguments, **named)
            finally:
                spent = self._now() - begin
                self.seconds[part] += spent - self._inner.pop()
                self._inner[-1] += spent

        return timed

    def _now(self) -> float:
        if self._on_cuda:
            wp.synchronize()
        return time.perf_counter()


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--time-limit", type=float, default=36.0, help="seconds each")
    parser.add_argument("--steps", type=int, default=100_000, help="at most so many steps")
    parser.add_argument("--downscale", type=int, default=1)
    add_model(parser)
    arguments = parser.parse_args()
    config = plain_training(
        model=arguments.model,
        steps=arguments.steps,
        time_limit=arguments.time_limit,
        device=arguments.device,
    )
    names = ["rest", *PARTS]
    print(f"{'scene':14}  steps  samples/ray  {'  '.join(f'{name:>10}' for name in names)}")
    rows: dict[str, dict[str, float]] = {}
    for name in arguments.scenes:
        rows[name] = row = profile(name, arguments.downscale, config)
        shares = "  ".join(f"{100 * row[part]:8.1f} %" for part in names)
        print(
            f"{name:14} {row['steps']:6.0f}  {row['samples_per_ray']:11.1f}  {shares}", flush=True
        )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device).count),
        "model": arguments.model,
        "time_limit": arguments.time_limit,
        "steps": arguments.steps,
        "downscale": arguments.downscale,
        "scenes": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'training', arguments.device)}")


def path_of(name: str) -> str:
    """A scene's folder, here or in the one that WARPNERF_DATA names; or a built-in one."""
    if ":" in name or Path(name).exists():
        return name
    return str(Path(os.environ.get("WARPNERF_DATA", "")) / name)


def profile(name: str, downscale: int, config: wn.TrainConfig) -> dict[str, float]:
    """Train on a scene.

    Returns:
        Each part's share of the time, "rest" for what is in none, steps, and samples per ray of the
        last update.
    """
    trainer = Trainer(wn.load_scene(path_of(name), downscale=downscale), config)
    trainer.update()  # compiles
    clock = Clock(trainer.workers.device.is_cuda)
    patches = [
        mock.patch.object(owner, function, clock.timing(part, getattr(owner, function)))
        for part, functions in PARTS.items()
        for owner, function in functions
    ]
    begin = time.perf_counter()
    for patch in patches:
        patch.start()
    try:
        progress = trainer.run()
    finally:
        for patch in patches:
            patch.stop()
    seconds = time.perf_counter() - begin
    row = {part: clock.seconds[part] / seconds for part in PARTS}
    row["rest"] = 1.0 - sum(row.values())
    row["steps"] = progress.step
    row["samples_per_ray"] = progress.samples_per_ray
    return row


if __name__ == "__main__":
    main()
