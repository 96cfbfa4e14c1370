"""`warpnerf train`: begins a run, or goes on with one."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from warpnerf.checks import InputError
from warpnerf.cli.arguments import Settings
from warpnerf.cli.loss_options import chosen_losses
from warpnerf.cli.machine import FAILED
from warpnerf.cli.model_options import chosen_model
from warpnerf.cli.pose import with_poses
from warpnerf.cli.progress import ProgressBar
from warpnerf.cli.view import PageOptions, training_page
from warpnerf.config import Scaling, TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runtime.memory import require_threads
from warpnerf.runtime.signals import Stopped, StopRequest
from warpnerf.training import lock

if TYPE_CHECKING:
    from warpnerf.scenes.photographs import Place
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.run import Run
    from warpnerf.training.state import Progress
    from warpnerf.training.trainer import Trainer
    from warpnerf.viewer.session import Session

STEPS_OF_TIMED = 10**9
"""Steps of a training that its time limit ends."""


def train_command(
    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENE]")] = None,
    /,
    output: Path | None = None,
    resume: Path | None = None,
    preset: Literal["fast", "quality", "dvgo", "dvgo-unbounded", "dvgo-llff"] | None = None,
    model: str | None = None,
    model_options: Settings = (),
    loss: Settings = (),
    steps: int | None = None,
    time_limit: float | None = None,
    scaling: Scaling | None = None,
    content_distance: float | Literal["auto", "per-camera"] | None = None,
    voxels: int | None = None,
    contraction: Literal["auto", "none", "linf", "l2", "ndc"] | None = None,
    near: float | None = None,
    downscale: int | None = None,
    masks: Path | None = None,
    images: Literal["auto", "memory", "disk"] = "auto",
    device: str | None = None,
    threads: int | None = None,
    seed: int | None = None,
    checkpoint_every: float | None = None,
    overwrite: bool = False,
    view: bool = False,
    host: str | None = None,
    port: int | None = None,
) -> int:
    """Train a voxel grid on a scene, and look at its test views.

    Args:
        scene: Folder of a scene (transforms.json, Blender, COLMAP, LLFF), an .npz file,
            builtin:room or builtin:room-sparse; or photographs without poses or a video, whose
            poses are then estimated first, as by `warpnerf pose`.
        output: Folder for the configuration, the field, the log, the figures and the pictures.
        resume: Go on with the run in this folder, as it was begun; scene only if it has moved.
        preset: Starting point, by default fast, which takes a minute or three on two cores; quality
            takes a quarter of an hour; dvgo, dvgo-unbounded and dvgo-llff are the published
            hyperparameters of DirectVoxGO, and take hours. The options below replace its values.
        model: What the grid holds: deferred (features and a small MLP for each ray, by default),
            features (DVGO's: an MLP for each sample), sh (spherical harmonics), or rgb (colour
            that is the same from all sides).
        model_options: Of the model, such as specular=8 width=64 (deferred), features=12
            residual=false threshold=0.0001 (features), degree=2 (sh).
        loss: What is minimised besides, and how: photometric=huber huber_delta=0.1, and weights of
            distortion=0.01, entropy=0.001, opacity=0.001 (auto: not for objects with alpha),
            sample_colour=0.1 (not for deferred), near_clip=0.01 near_clip_distance=0.2.
        steps: Batches of rays to train on; by default as many as the preset says, or as the time
            limit allows.
        time_limit: Seconds of training; the schedule is fitted to them.
        scaling: How a sample's gradient depends on its distance from the camera.
        content_distance: Where gradients reach full strength, in the scene's units; per-camera: of
            each camera what it sees, as points or a short training tell; by default between that
            and the scene's, or less where many look around.
        voxels: Nodes of the final grid, in all; memory goes with their number.
        contraction: How space outside the box is held: none, folded in (linf, l2), or ndc, for
            cameras that look the same way; by default ndc for LLFF's captures that do, else folded
            in (linf) where photographs have no alpha.
        near: Nothing is sampled nearer to the camera than this, in the scene's units.
        downscale: Average blocks of so many pixels squared; by default 1, as they are.
        masks: Folder of images named after the photographs, white where pixels count and black
            where they are ignored; with --resume only if it has moved.
        images: Where the photographs' pixels are during the training: memory, disk (decoded once,
            into a file without a name in the output folder, gone at the end), or by what is free.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core, or as the resumed run had.
        seed: Same seed and threads: same result on the CPU.
        checkpoint_every: Seconds between two checkpoints to resume from; by default 300.
        overwrite: Replace the run that the output folder holds.
        view: Serve a page to look at the training in a browser.
        host: Where, by name or address of this machine; by default 127.0.0.1.
        port: Where; 0: any that is free. By default 8080, or the next that is free.
    """
    page = PageOptions.chosen(view, host, port)
    chosen: dict[str, Any] = {
        "steps": steps,
        "time_limit": time_limit,
        "scaling": scaling,
        "content_distance": content_distance,
        "device": device,
        "threads": threads,
        "seed": seed,
        "checkpoint_every": checkpoint_every,
    }
    given = {name: value for name, value in chosen.items() if value is not None}

    def changed(config: TrainConfig) -> TrainConfig:
        config = dataclasses.replace(config, **given)
        config = dataclasses.replace(config, model=chosen_model(config.model, model, model_options))
        config = dataclasses.replace(config, loss=chosen_losses(config.loss, loss))
        if voxels is not None:
            grid = dataclasses.replace(config.grid, voxels=voxels)
            config = dataclasses.replace(config, grid=grid)
        if contraction is not None:
            grid = dataclasses.replace(config.grid, contraction=contraction)
            config = dataclasses.replace(config, grid=grid)
        if near is not None:
            march = dataclasses.replace(config.march, near=near)
            config = dataclasses.replace(config, march=march)
        return config

    if resume is not None:
        fixed = {"output": output, "preset": preset, "downscale": downscale, "overwrite": overwrite}
        for name, value in fixed.items():
            if value is not None and value is not False:
                raise InputError(
                    f"--{name} does not go with --resume: the run in {resume} goes on as it was "
                    "begun; leave it out."
                )
        return _resume(resume, scene, masks, images, changed, page)
    config = changed(PRESETS[preset or "fast"])
    if scene is None or output is None:
        raise InputError(
            "train wants a SCENE and --output DIR for a new run, or --resume DIR to go on with one."
        )
    if time_limit is not None and steps is None:
        config = dataclasses.replace(config, steps=STEPS_OF_TIMED)
    if steps is not None and time_limit is None:
        config = dataclasses.replace(config, time_limit=None)
    if config.loss.sample_colour > 0.0:  # before photographs are posed or read; loads Warp
        from warpnerf.rendering.losses import parts_with

        parts_with(config.model, "float32", config.loss)
    factor = 1 if downscale is None else downscale
    return _begin(scene, output, factor, masks, images, config, overwrite, page)


def _begin(
    source: str,
    output: Path,
    downscale: int,
    masks: Path | None,
    images: Place,
    config: TrainConfig,
    overwrite: bool,
    page: PageOptions | None,
) -> int:
    """Train from the first step on."""
    _require_free(output, overwrite)
    with lock.only_writer(output):
        _require_free(output, overwrite)  # once more, now that nobody else begins there
        return _begin_alone(source, output, downscale, masks, images, config, page)


def _require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError unless a run may begin there; loads Warp only where something is."""
    from warpnerf.scenes.files import exists

    if exists(output) and not (
        output.is_dir() and all(path.name == lock.NAME for path in output.iterdir())
    ):
        from warpnerf.training.run import Run

        Run.require_free(output, overwrite)


def _begin_alone(
    source: str,
    output: Path,
    downscale: int,
    masks: Path | None,
    images: Place,
    config: TrainConfig,
    page: PageOptions | None,
) -> int:
    """Train from the first step on, as the only one that writes to the folder."""
    _require_machine(config)
    photographs = source
    source = with_poses(photographs, output, masks, config.threads)
    if source != photographs:
        masks = None  # the posed scene brings them
    scene = _read(source, downscale, masks, images, output)

    # Not before: these load Warp, and bad input is refused at once.
    from warpnerf.evaluation.oddities import oddities
    from warpnerf.scenes.survey import survey
    from warpnerf.training.coarse import begin, is_needed
    from warpnerf.training.run import Run

    looks = is_needed(scene, config)
    if looks:
        print("looking for how far the cameras see", flush=True)
        with ProgressBar("first step") as bar:
            trainer = begin(
                scene, config, on_progress=lambda found: bar.report(found.fraction, _text(found))
            )
    else:
        trainer = begin(scene, config)
    trained = trainer.scene  # in which box and distance may be other ones
    _describe(trained, trainer)
    distance, near = trainer.content_distance, config.march.near
    for oddity in oddities(trained, survey(source), distance, near, looked=looks):
        print(f"  odd: {oddity}", flush=True)
    run = Run(output)
    with training_page(page, trained, trainer) as session:
        folder = None if masks is None else str(masks.resolve())
        found = trainer.sight is not None
        run.create(trained, _absolute(source), downscale, distance, config, folder, found)
        return _train(run, trained, trainer, session)


def _resume(
    folder: Path,
    moved: str | None,
    masks: Path | None,
    images: Place,
    changed: Callable[[TrainConfig], TrainConfig],
    page: PageOptions | None,
) -> int:
    """Train from the last checkpoint on."""
    from warpnerf.training.run import Run

    Run(folder).read_config()
    with Run(folder).only_writer():
        return _go_on(Run(folder), moved, masks, images, changed, page)


def _go_on(
    run: Run,
    moved: str | None,
    masks: Path | None,
    images: Place,
    changed: Callable[[TrainConfig], TrainConfig],
    page: PageOptions | None,
) -> int:
    from warpnerf.training.run_scene import masks_of, path_of
    from warpnerf.training.trainer import Trainer

    begun = run.read_config()
    state, notes = run.load_state()
    config = changed(state.config)
    state.require_same_config(config)
    _require_machine(config)
    masks = masks or masks_of(begun, moved)
    scene = _read(path_of(begun, moved), begun.downscale, masks, images, run.folder)
    trainer = Trainer(scene, config, state)
    scene = begun.as_trained(scene)
    _describe(scene, trainer)
    for note in notes:
        print(f"  note: {note}")
    for name in ("device", "threads"):
        old, new = getattr(state.config, name), getattr(config, name)
        if new != old:
            print(f"  note: {name} {new} instead of {old}: sums are rounded in another order")
    print(f"  going on after step {trainer.steps_done}")
    with training_page(page, scene, trainer) as session:
        run.rewind_log(trainer.steps_done)
        del state  # the trainer has copies
        return _train(run, scene, trainer, session)


def _require_machine(config: TrainConfig) -> None:
    """Refuse a device or threads that this machine has not, before photographs are posed or read.

    Raises:
        InputError: It has not.
    """
    if config.threads is not None:
        require_threads(config.threads)
    if config.device != "cpu":  # else Warp need not be loaded yet
        from warpnerf.runtime.parallel import Workers

        Workers(config.device)


def _read(
    source: str, downscale: int, masks: Path | str | None, images: Place, output: Path
) -> Scene:
    """The scene, whose photographs are kept where the run will be if they are kept on disk."""
    from warpnerf.evaluation.evaluate import require_measurable
    from warpnerf.scenes.load import load_scene

    print(f"reading {source}", flush=True)
    there = next((folder for folder in (output, *output.parents) if folder.is_dir()), None)
    scene = load_scene(source, downscale=downscale, masks=masks, images=images, image_folder=there)
    require_measurable(scene, _split_to_look_at(scene))
    return scene


def _split_to_look_at(scene: Scene) -> str:
    return "test" if scene.splits.get("test") else "train"


def _train(run: Run, scene: Scene, trainer: Trainer, session: Session | None) -> int:
    """Train to the end, or until asked to stop; look at the test views."""
    between = None if session is None else session.after_update
    with StopRequest() as stop:
        try:
            with ProgressBar("first step") as bar:

                def on_progress(progress: Progress) -> None:
                    run.log(progress)
                    bar.report(progress.fraction, _text(progress))

                trainer.run(on_progress, run.save_checkpoint, lambda: stop.asked, between)
        except FloatingPointError as error:
            kept = "Nothing was saved before."
            if run.last_step is not None:
                kept = f"Step {run.last_step} is saved: warpnerf eval {run.folder} looks at it."
            print(f"warpnerf: error: {error} {kept}", file=sys.stderr)
            return FAILED
        except Stopped as stopped:  # asked a second time
            print(f"stopped; {run.way_on()}", flush=True)
            return stopped.exit_code
        if trainer.fraction >= 1.0:
            run.save_field(trainer.field())
    if session is not None:
        session.notify("The training has ended", f"warpnerf view {run.folder} shows what it left.")
    if stop.exit_code is not None:
        step = trainer.steps_done
        saved = f"stopped and saved after step {step}; go on with: {run.resume_command}"
        print(saved if run.last_step == step else f"stopped; {run.way_on()}", flush=True)
        return stop.exit_code
    split = _split_to_look_at(scene)
    print(f"rendering the {'test' if split == 'test' else 'training'} views", flush=True)
    try:
        with ProgressBar("first view") as bar:
            result = run.evaluate(trainer.field(), scene, split, bar.report)
        print(result)
    except Stopped as stopped:
        print(f"stopped; the field is saved. Go on with: {run.resume_command}", flush=True)
        return stopped.exit_code
    print(
        f"wrote {run.folder}: field.safetensors, metrics.json, log.jsonl, config.json, and test/ "
        f"with truth, rendering and depth of every view\nlook at {run.sheet}",
    )
    return 0


def _scaling(trainer: Trainer) -> str:
    """How gradients are scaled, and up to where if that is not the content distance."""
    scaling, distances = f"scaling {trainer.config.scaling}", trainer.content_distances
    least, most = f"{min(distances):.3g}", f"{max(distances):.3g}"
    if trainer.config.scaling == "none" or set(distances) == {trainer.content_distance}:
        return scaling
    return f"{scaling} below {least}" + (f" to {most}, by camera" if least != most else "")


def _describe(scene: Scene, trainer: Trainer) -> None:
    """What was understood of a scene."""
    from warpnerf.scenes.frustum import HELD, contraction_of

    train, test = len(scene.splits["train"]), len(scene.splits["test"])
    sizes = sorted({(c.width, c.height) for c in scene.cameras})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
    extent = scene.box_max - scene.box_min
    outside = HELD[contraction_of(scene, trainer.config)]
    print(f"{scene.name}: {train} training and {test} test views, {shown} pixels")
    for warning in scene.warnings:
        print(f"  warning: {warning}")
    for note in scene.notes:
        print(f"  note: {note}")
    print(f"  content distance {trainer.content_distance:.4g} scene units, {_scaling(trainer)}")
    print(
        f"  box {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g} scene units, {outside}",
        flush=True,
    )


def _absolute(source: str) -> str:
    return source if source.startswith("builtin:") else str(Path(source).resolve())


def _text(progress: Progress) -> str:
    speed = progress.step / max(progress.seconds, 1e-6)
    size = " x ".join(str(n) for n in progress.size)
    drawn = f" over {progress.seen:.0%} of pixels" if progress.seen < 1.0 else ""
    return (
        f"step {progress.step}  loss {progress.loss:.5f}  PSNR {progress.psnr:.2f}{drawn}  "
        f"grid {size}  {speed:.1f} steps/s"
    )
