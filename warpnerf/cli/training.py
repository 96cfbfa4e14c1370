"""A training by the command line: what it tells, from its description to its test views."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

from warpnerf.cli import processes
from warpnerf.cli.machine import FAILED
from warpnerf.runtime.progress import ProgressBar
from warpnerf.runtime.signals import Stopped, StopRequest
from warpnerf.training.peers import PeerLostError

if TYPE_CHECKING:
    from warpnerf.cli.train_options import TrainOptions
    from warpnerf.runs.run import Run
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.plan import TrainingPlan
    from warpnerf.training.state import Progress
    from warpnerf.training.trainer import Trainer
    from warpnerf.viewer.session import Session


def split_to_look_at(scene: Scene) -> str:
    """The test views, or the training views where there are none."""
    return "test" if scene.splits.get("test") else "train"


def _some_views(scene: Scene, split: str, count: Literal["all"] | int) -> Scene:
    """The scene with so many of a split's views, spread."""
    indices = scene.splits[split]
    if count == "all" or count >= len(indices):
        return scene
    chosen = tuple(indices[len(indices) * k // count] for k in range(count))
    return dataclasses.replace(scene, splits={**scene.splits, split: chosen})


def train_to_the_end(
    run: Run,
    scene: Scene,
    trainer: Trainer,
    session: Session | None,
    options: TrainOptions,
) -> int:
    """Train to the end, or until asked to stop; look at the test views."""
    from warpnerf.reports import misfits
    from warpnerf.reports.limits import voxel_pixels, what_limits
    from warpnerf.training.exposure import in_use
    from warpnerf.training.held_out import HeldOut

    keep = run.read_config().keep
    held_out = None if options.eval_every is None else HeldOut(trainer, options.eval_every)
    log = None if options.log is None else run.open_log(options.log)
    reports: list[Progress] = []
    if trainer.fraction < 1.0:
        run.discard_figures()

    def between() -> None:
        if session is not None:
            session.after_update()
        if held_out is not None:
            held_out.after_update()

    with StopRequest(processes.patience(trainer.peers)) as stop:
        try:
            with ProgressBar("first step") as bar:

                def on_progress(progress: Progress) -> None:
                    shown = progress
                    if held_out is not None:
                        progress = held_out.added_to(progress)
                        shown = dataclasses.replace(progress, test_psnr=held_out.psnr)
                    run.log(progress)
                    if log is not None:
                        run.write_to(log, progress)
                    reports.append(progress)
                    bar.report(progress.fraction, str(shown))

                trainer.run(
                    on_progress,
                    run.save_checkpoint,
                    lambda: stop.asked,
                    between,
                    checkpoint_when_done=keep == "checkpoint",
                )
        except FloatingPointError as error:
            kept = "Nothing was saved before."
            if run.last_step is not None:
                kept = f"Step {run.last_step} is saved: warpnerf eval {run.folder} looks at it."
            print(f"warpnerf: error: {error} {kept}", file=sys.stderr)
            return FAILED
        except PeerLostError as error:
            return processes.saved_alone(run, trainer, error)
        except Stopped as stopped:  # asked a second time
            print(f"stopped; {run.way_on()}", flush=True)
            return stopped.exit_code
        if trainer.fraction >= 1.0:
            run.save_field(trainer.field(), keep == "checkpoint")
            run.draw_curves(scene.name)
            if (exposures := in_use(trainer.exposures)) is not None:
                print(exposures.in_words(scene.training_names))
            of_photographs = trainer.photograph_errors.psnr(scene.training_names)
            if (sentence := misfits.in_words(of_photographs)) is not None:
                print(f"warning: {sentence}")
        exit_code = processes.exit_code_of(stop, trainer)
    if session is not None:
        session.notify("The training has ended", f"warpnerf view {run.folder} shows what it left.")
    if log is not None and (exit_code is not None or options.eval_views == "none"):
        log.close({})
    if exit_code is not None:
        step = trainer.steps_done
        saved = f"stopped and saved after step {step}; continue with: {run.resume_command}"
        print(saved if run.last_step == step else f"stopped; {run.way_on()}", flush=True)
        return exit_code
    if options.eval_views == "none":
        print(f"wrote {run.folder}: field.safetensors, log.jsonl and config.json")
        return 0
    device, threads, pixels = trainer.config.device, trainer.config.threads, voxel_pixels(trainer)
    exposed = in_use(trainer.exposures) is not None
    del trainer  # its grid, and what its optimiser keeps

    def at_end(metrics: Mapping[str, float], split: str) -> None:
        limit = what_limits(reports, pixels, metrics if split == "test" else None, exposed)
        if limit is not None:
            print(limit)
        if log is not None:
            log.close(metrics)

    return evaluate_run(run, scene, options, device, threads, at_end)


def evaluate_run(
    run: Run,
    scene: Scene,
    options: TrainOptions,
    device: str,
    threads: int | None,
    at_end: Callable[[Mapping[str, float], str], None] = lambda metrics, split: None,
) -> int:
    """Look at the test views of a finished run, by the field that it keeps.

    Args:
        run: Whose field is saved.
        scene: Its photographs.
        options: How many of them.
        device: Where to render.
        threads: CPU threads.
        at_end: Called with the mean metrics, and the split that they are of.
    """
    split = split_to_look_at(scene)
    assert options.eval_views != "none"
    scene = _some_views(scene, split, options.eval_views)
    print(f"rendering the {'test' if split == 'test' else 'training'} views", flush=True)
    try:
        with ProgressBar("first view") as bar:
            field, _ = run.load_field(device, threads)
            result = run.evaluate(field, scene, split, bar.report)
        print(result)
        at_end(result.mean, split)
    except Stopped as stopped:
        print(f"stopped; the field is saved. Continue with: {run.resume_command}", flush=True)
        return stopped.exit_code
    print(
        f"wrote {run.folder}: field.safetensors, metrics.json, log.jsonl, config.json, and test/ "
        f"with truth, rendering and depth of {len(result.images)} views\nlook at {run.sheet}",
    )
    return 0


def _scaling(plan: TrainingPlan) -> str:
    """How gradients are scaled, and up to where if that is not the content distance."""
    scaling, distances = f"scaling {plan.config.scaling}", plan.content_distances
    least, most = f"{min(distances):.3g}", f"{max(distances):.3g}"
    if plan.config.scaling == "none" or set(distances) == {plan.content_distance}:
        return scaling
    return f"{scaling} below {least}" + (f" to {most}, by camera" if least != most else "")


def describe(scene: Scene, trainer: Trainer) -> None:
    """What was understood of a scene."""
    from warpnerf.scenes.extent.sharpness import in_words

    train, test = len(scene.splits["train"]), len(scene.splits["test"])
    sizes = sorted({(c.width, c.height) for c in scene.cameras})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
    print(f"{scene.name}: {train} training and {test} test views, {shown} pixels")
    for warning in scene.warnings:
        print(f"  warning: {warning}")
    for note in scene.notes:
        print(f"  note: {note}")
    plan = trainer.plan
    print(f"  content distance {plan.content_distance:.4g} scene units, {_scaling(plan)}")
    print(f"  the field is {plan.config.field.name}, rays are {plan.sampler.past}")
    space = trainer.lattice.space  # of an object that is resumed, tighter than the plan's
    print(f"  box {in_words(space, space.kind.words)}")
    if trainer.steps_done == 0 and plan.config.field.as_fine_as_nodes:
        print(f"  voxels {plan.voxel_pixels}")
    sys.stdout.flush()
