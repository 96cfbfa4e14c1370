"""The command: reads the line, calls the package, prints."""

from __future__ import annotations

import dataclasses
import io
import logging
import re
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from warpnerf import __version__
from warpnerf.checks import InputError
from warpnerf.config import PRESETS, Scaling, TrainConfig

if TYPE_CHECKING:
    from warpnerf.scene import Scene
    from warpnerf.training import Progress

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

OUT_OF_MEMORY = re.compile("failed to allocate|can't start new thread", re.IGNORECASE)
"""What Warp and the standard library say in a RuntimeError where a MemoryError is meant."""


def train_command(
    scene: tyro.conf.Positional[str],
    /,
    output: Path,
    preset: Literal["fast", "quality"] = "fast",
    steps: int | None = None,
    time_limit: float | None = None,
    scaling: Scaling | None = None,
    content_distance: float | Literal["auto"] | None = None,
    voxels: int | None = None,
    near: float | None = None,
    downscale: int = 1,
    device: str | None = None,
    threads: int | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> int:
    """Train a voxel grid on a scene, and look at its test views.

    Args:
        scene: Folder with transforms.json or transforms_train.json, or builtin:room.
        output: Folder for the configuration, the field, the log, the figures and the pictures.
        preset: Starting point; the options below replace its values.
        steps: Optimiser steps.
        time_limit: Seconds of training; the schedule is squeezed to fit.
        scaling: How a sample's gradient depends on its distance from the camera.
        content_distance: Where gradients reach full strength, in the scene's units.
        voxels: Nodes of the final grid, in all; memory goes with their number.
        near: Nothing is sampled nearer to the camera than this, in the scene's units.
        downscale: Average blocks of so many pixels squared.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per core.
        seed: Same seed and threads: same result on the CPU.
        overwrite: Replace the run that the output folder holds.
    """
    config = PRESETS[preset]
    chosen: dict[str, Any] = {
        "steps": steps,
        "time_limit": time_limit,
        "scaling": scaling,
        "content_distance": content_distance,
        "device": device,
        "threads": threads,
        "seed": seed,
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    config = dataclasses.replace(config, **given)
    if voxels is not None:
        config = dataclasses.replace(config, grid=dataclasses.replace(config.grid, voxels=voxels))
    if near is not None:
        config = dataclasses.replace(config, march=dataclasses.replace(config.march, near=near))
    return _train(scene, output, downscale, config, overwrite)


def eval_command(
    folder: tyro.conf.Positional[Path],
    /,
    scene: str | None = None,
    split: Literal["test", "train", "val", "all"] = "test",
    json: Path | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Measure a trained run on a split of its scene, or of other photographs of the same place.

    Args:
        folder: Output folder of a training run.
        scene: Other photographs in the same coordinates, reduced as those of the training were.
        split: Which views.
        json: Also write the figures to this file.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per core.
    """
    from warpnerf.checkpoint import write_atomically
    from warpnerf.data import load_scene
    from warpnerf.evaluation import evaluate, require_measurable
    from warpnerf.run import Run

    if json is not None and not json.parent.is_dir():
        raise InputError(f"--json {json}: its folder does not exist; make it first.")
    run = Run(folder)
    config = run.read_config()
    field = run.load_field(device, threads)
    views = load_scene(scene or config["scene"], downscale=config["downscale"])
    require_measurable(views, split)
    result = evaluate(field, views, split)
    print(result)
    if json is not None:
        try:
            write_atomically(json, result.to_json().encode())
        except OSError as error:
            raise InputError(f"--json {json} cannot be written: {error.strerror}.") from error
    return 0


def _train(source: str, output: Path, downscale: int, config: TrainConfig, overwrite: bool) -> int:
    from warpnerf.data import load_scene
    from warpnerf.data.files import exists
    from warpnerf.evaluation import require_measurable

    if exists(output):
        from warpnerf.run import Run

        Run.require_free(output, overwrite)
    print(f"reading {source}", flush=True)
    scene = load_scene(source, downscale=downscale)
    require_measurable(scene, "test")

    # Not before: these load Warp, and bad input is refused at once.
    from warpnerf.run import Run
    from warpnerf.training import Trainer

    trainer = Trainer(scene, config)
    _describe(scene, trainer.content_distance, config)
    run = Run(output)
    run.create(scene, _absolute(source), downscale, trainer.content_distance, config)
    print("compiling kernels (once; later runs start at once)", flush=True)
    with _StopRequest() as stop:
        try:
            with _reporter(config) as report:
                while trainer.fraction < 1.0 and not stop.asked:
                    trainer.step()
                    if trainer.report_due:
                        progress = trainer.report()
                        run.log(progress)
                        report(progress)
        except FloatingPointError as error:
            print(f"warpnerf: error: {error}", file=sys.stderr)
            return FAILED
        field = trainer.field()
        run.save_field(field)
    if stop.asked:
        where = output / "field.safetensors"
        print(
            f"stopped after step {trainer.steps_done}; the field so far is in {where}", flush=True
        )
        return INTERRUPTED
    print("rendering the test views", flush=True)
    try:
        far = 2.0 * trainer.content_distance
        print(run.evaluate(field, scene, "test", far))
    except KeyboardInterrupt:
        print(f"stopped; the trained field is in {output}, for warpnerf eval", file=sys.stderr)
        return INTERRUPTED
    print(
        f"wrote {output}: field.safetensors, metrics.json, log.jsonl, config.json, and test/*.png "
        f"(truth, rendering, depth from 0 red to {far:.3g} violet)"
    )
    return 0


class _StopRequest:
    """Ctrl-C and SIGTERM noted while training, so that a run stops between two steps."""

    def __enter__(self) -> _StopRequest:
        self.asked = False
        self._before = {s: signal.signal(s, self._note) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: object) -> None:
        self.asked = True


def _describe(scene: Scene, content_distance: float, config: TrainConfig) -> None:
    """What was understood of a scene."""
    train, test = len(scene.splits["train"]), len(scene.splits["test"])
    sizes = sorted({(c.width, c.height) for c in scene.cameras})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
    extent = scene.box_max - scene.box_min
    print(f"{scene.name}: {train} training and {test} test views, {shown} pixels")
    for warning in scene.warnings:
        print(f"  warning: {warning}")
    for note in scene.notes:
        print(f"  note: {note}")
    print(f"  content distance {content_distance:.4g} scene units, scaling {config.scaling}")
    print(
        f"  box {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g} scene units, "
        + ("space outside folded in" if scene.unbounded else "nothing outside"),
        flush=True,
    )


def _absolute(source: str) -> str:
    return source if source.startswith("builtin:") else str(Path(source).resolve())


class _reporter:
    """Progress as a bar on a terminal, as plain lines elsewhere."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._lines_at = 0.0

    def __enter__(self) -> Callable[[Progress], None]:
        from rich.console import Console

        console = Console()
        self._bar = None
        if not console.is_terminal:
            return self._line
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._bar = Progress(
            TextColumn("{task.percentage:3.0f}%"),
            BarColumn(),
            TextColumn("{task.description}"),
            TimeRemainingColumn(),
            console=console,
        )
        self._bar.start()
        self._task = self._bar.add_task("first step", total=1.0)
        return self._draw

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _draw(self, progress: Progress) -> None:
        assert self._bar is not None
        self._bar.update(self._task, completed=progress.fraction, description=_text(progress))

    def _line(self, progress: Progress) -> None:
        if progress.seconds >= self._lines_at or progress.fraction >= 1.0:
            left = progress.seconds * (1.0 / max(progress.fraction, 1e-6) - 1.0)
            print(f"{progress.fraction:4.0%}  {_text(progress)}  {left:.0f} s left", flush=True)
            self._lines_at = progress.seconds + 5.0


def _text(progress: Progress) -> str:
    speed = progress.step / max(progress.seconds, 1e-6)
    size = " x ".join(str(n) for n in progress.size)
    return (
        f"step {progress.step}  loss {progress.loss:.5f}  PSNR {progress.psnr:.2f}  "
        f"grid {size}  {speed:.1f} steps/s"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command.

    Returns:
        0; 2 for bad input; 1 where training failed; 130 where it was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"warpnerf {__version__}")
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    warnings.filterwarnings("ignore", module="PIL")  # what matters in an image is refused
    logging.getLogger("PIL").setLevel(logging.CRITICAL)
    warnings.formatwarning = lambda message, *_: f"warpnerf: warning: {message}.\n"
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may hold anything
    try:
        return tyro.extras.subcommand_cli_from_dict(
            {"train": train_command, "eval": eval_command},
            prog="warpnerf",
            description="Voxel-grid radiance fields from posed photographs, without floaters.",
            args=arguments,
        )
    except InputError as error:
        print(f"warpnerf: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not OUT_OF_MEMORY.search(str(error)):
            raise
        why = f" ({error})" if str(error) else ""
        print(
            f"warpnerf: error: out of memory{why}; use fewer --voxels, or a larger --downscale.",
            file=sys.stderr,
        )
        return BAD_INPUT
    except OSError as error:
        print(f"warpnerf: error: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED
