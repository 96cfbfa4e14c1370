"""Digests of what short trainings end with: does a change of the code change what is computed?

    python benchmarks/digests.py FOLDER builtin:room > after.txt
    export PYTHONPATH=../before:../before/kernels
    python benchmarks/digests.py FOLDER builtin:room > before.txt
    diff before.txt after.txt

Each preset is trained on each scene for 300 steps, with its whole schedule in these, and on the
built-in room each model. A line has scene, configuration, threads, and the SHA-256 of each tensor
of the checkpoint: values, moments, weights, and cells' distances. Digests are those of one machine;
another may round otherwise. What is refused is a line as well.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import warp as wp
from safetensors.numpy import load_file

import warpnerf as wn
from warpnerf.checks import InputError

wp.config.log_level = wp.LOG_ERROR  # lines are all that is printed

PRESETS = ("fast", "quality", "dvgo", "dvgo-unbounded", "dvgo-llff")
MODELS = ("rgb", "sh", "per_sample")
"""Of the built-in room, with the preset fast."""


def digests(scene: wn.Scene, config: wn.TrainConfig) -> dict[str, str]:
    """Train, and the beginning of the SHA-256 of each tensor of the checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "training.safetensors"
        states: list[object] = []

        def keep(state: object) -> None:
            states[:] = [state]

        wn.train(scene, config, on_checkpoint=keep, progress=False)
        wn.save_checkpoint(path, states[0])
        tensors = load_file(path)
    return {
        name: hashlib.sha256(array.tobytes()).hexdigest()[:16]
        for name, array in sorted(tensors.items())
    }


def configurations(scene: str, only: list[str]) -> Iterator[tuple[str, wn.TrainConfig]]:
    """Names and configurations for a scene."""
    for preset in PRESETS:
        if preset in only:
            yield preset, wn.PRESETS[preset]
    if scene.startswith("builtin:"):
        for model in MODELS:
            if model in only:
                yield model, replace(wn.PRESETS["fast"], model=model)


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", help="builtin:room, folders")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--voxels", type=int, default=10**6, help="at most")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--only", nargs="+", default=[*PRESETS, *MODELS], help="of these")
    arguments = parser.parse_args()
    for name in arguments.scenes:
        scene = wn.load_scene(name)
        for called, undecided in configurations(name, arguments.only):
            config = undecided.for_kind(scene.kind)
            grid = replace(config.grid, voxels=min(config.grid.n_nodes, arguments.voxels))
            for threads in arguments.threads:
                short = replace(
                    config, steps=arguments.steps, time_limit=None, threads=threads, grid=grid
                )
                try:
                    found = " ".join(f"{k}={v}" for k, v in digests(scene, short).items())
                except InputError as error:
                    found = f"refused: {error}"
                print(Path(name).name, called, threads, found, flush=True)


if __name__ == "__main__":
    main()
