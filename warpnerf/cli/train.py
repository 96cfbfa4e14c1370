"""`warpnerf train`: begins a run, or resumes one."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from warpnerf.checks import InputError
from warpnerf.cli.arguments import Settings, Usual
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given
from warpnerf.cli.machine import FAILED
from warpnerf.cli.pose import with_poses
from warpnerf.cli.progress import ProgressBar
from warpnerf.cli.view import PageOptions, training_page
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runs import lock
from warpnerf.runtime.memory import require_threads
from warpnerf.runtime.signals import Stopped, StopRequest

if TYPE_CHECKING:
    from warpnerf.runs.run import Run
    from warpnerf.scenes.images.photographs import Place
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.plan import TrainingPlan
    from warpnerf.training.state import Progress
    from warpnerf.training.trainer import Trainer
    from warpnerf.viewer.session import Session


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What `warpnerf train` is given besides a configuration."""

    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENE]")] = None
    """Folder of a scene (transforms.json, Blender, COLMAP, LLFF), an .npz file, builtin:room or
    builtin:room-sparse; or photographs without poses or a video, whose poses are then estimated
    first, as by `warpnerf pose`."""
    output: Path | None = None
    """Folder for the configuration, the field, the log, the figures and the pictures."""
    preset: (
        Literal[
            "fast", "quality", "dvgo", "dvgo-unbounded", "dvgo-llff", "tensorf", "ngp", "mip360"
        ]
        | None
    ) = None
    """Starting point, by default fast, which takes a minute or three on two cores; quality takes a
    quarter of an hour; dvgo, dvgo-unbounded and dvgo-llff are the published hyperparameters of
    DirectVoxGO, tensorf those of TensoRF, ngp those of Instant-NGP, and take hours; mip360 samples
    and contracts as Mip-NeRF 360 does. Other options replace its values."""
    config: Path | None = None
    """Starting point instead of a preset: the config.json of a run, which is repeated, with its
    scene, downscale and masks, but for what other options replace."""
    resume: Path | None = None
    """Resume the run in this folder, as it was begun; scene only if it has moved."""
    overwrite: bool = False
    """Replace the run that the output folder holds."""
    downscale: int | None = None
    """Average blocks of so many pixels squared; by default 1, as they are."""
    masks: Path | None = None
    """Folder of images named after the photographs, white where pixels count and black where they
    are ignored; with --resume only if it has moved."""
    images: Literal["auto", "memory", "disk"] = "auto"
    """Where the photographs' pixels are during the training: memory, disk (decoded once, into a
    file without a name in the output folder, gone at the end), or by what is free."""
    view: bool = False
    """Serve a page to look at the training in a browser."""
    host: str | None = None
    """Where, by name or address of this machine; by default 127.0.0.1."""
    port: int | None = None
    """Where; 0: any that is free. By default 8080, or the next that is free."""
    model_options: Settings = ()
    """Of the model, such as specular=8 width=64: the same as --model.specular 8
    --model.width 64."""
    loss: Settings = ()
    """What is minimised besides, such as distortion=0.01 entropy=0.001: the same as
    --loss.distortion 0.01 --loss.entropy 0.001."""

    @property
    def page(self) -> PageOptions | None:
        """Where the page of the training is served; None: nowhere."""
        return PageOptions.chosen(self.view, self.host, self.port)


USUAL = Usual(
    (
        "output",
        "preset",
        "steps",
        "time_limit",
        "grid.voxels",
        "downscale",
        "masks",
        "model",
        "resume",
        "config",
        "overwrite",
        "view",
        "scaling",
        "content_distance",
        "box",
        "grid.border",
        "grid.contraction",
        "march.near",
        "device",
        "threads",
        "seed",
        "checkpoint_every",
    )
)


def train_command(options: TrainOptions, given: Annotated[Given, USUAL] = NOTHING) -> int:
    """Train a voxel grid on a scene, and look at its test views.

    Each field of the configuration is an option too, such as --optim.decay 0.03.

    --help-all shows them all. Defaults are those of the --preset beside it.
    """
    page = options.page

    def changed(config: TrainConfig) -> TrainConfig:
        return configured(config, given, options.model_options, options.loss)

    if options.resume is not None:
        for name in ("output", "preset", "config", "downscale", "overwrite"):
            if getattr(options, name) is not None and getattr(options, name) is not False:
                raise InputError(
                    f"--{name} does not go with --resume: the run in {options.resume} continues as "
                    "it was begun; leave it out."
                )
        return _resume(options.resume, options.scene, options.masks, options.images, changed, page)
    begin, options = _starting_point(options)
    config = begun_with(changed(begin), given)
    if options.scene is None or options.output is None:
        raise InputError(
            "train wants a SCENE and --output DIR for a new run, or --resume DIR to resume one."
        )
    if config.loss.sample_colour > 0.0:  # before photographs are posed or read; loads Warp
        from warpnerf.rendering.losses import parts_with

        parts_with(config.model, "float32", config.loss)
    return _begin(
        options.scene,
        options.output,
        1 if options.downscale is None else options.downscale,
        options.masks,
        options.images,
        config,
        options.overwrite,
        page,
    )


def _starting_point(options: TrainOptions) -> tuple[TrainConfig, TrainOptions]:
    """The configuration of the preset or the file, and the options with what the file has."""
    if options.config is None:
        return PRESETS[options.preset or "fast"], options
    if options.preset is not None:
        raise InputError(
            f"--preset does not go with --config: {options.config} says what to begin with; leave "
            "one of them out."
        )
    from warpnerf.cli.repeat import run_to_repeat
    from warpnerf.runs.scene import masks_of, path_of

    run = run_to_repeat(options.config)
    if options.downscale is None:
        options = dataclasses.replace(options, downscale=run.downscale)
    if options.scene is None:  # and not another one, for which masks would be others
        masks = options.masks or masks_of(run)
        options = dataclasses.replace(options, scene=path_of(run), masks=masks)
    return run.train, options


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
        from warpnerf.runs.run import Run

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
    scene = _read(source, downscale, masks, images, output, config.threads)

    # Not before: these load Warp, and bad input is refused at once.
    from warpnerf.inspection.diagnostics import diagnostics
    from warpnerf.runs.run import Run
    from warpnerf.scenes.formats.survey import survey
    from warpnerf.training.coarse import prepare_trainer
    from warpnerf.training.plan import resolve

    plan = resolve(scene, config)
    if plan.looks_first:
        print("looking for how far the cameras see", flush=True)
        with ProgressBar("first step") as bar:
            trainer = prepare_trainer(
                scene, plan, on_progress=lambda found: bar.report(found.fraction, _text(found))
            )
    else:
        trainer = prepare_trainer(scene, plan)
    trained = trainer.scene  # in which box and distance may be other ones
    _describe(trained, trainer)
    distance, near, looked = trainer.plan.content_distance, config.march.near, plan.looks_first
    found_odd = diagnostics(
        trained, survey(source), distance, near, looked=looked, threads=config.threads
    )
    for finding in found_odd:
        print(f"  warning: {finding}", flush=True)
    run = Run(output)
    with training_page(page, trained, trainer) as session:
        folder = None if masks is None else str(masks.resolve())
        found = trainer.observed is not None
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
    from warpnerf.runs.run import Run

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
    from warpnerf.runs.scene import masks_of, path_of
    from warpnerf.training.trainer import Trainer

    begun = run.read_config()
    state, notes = run.load_state()
    config = changed(state.config)
    state.require_same_config(config)
    _require_machine(config)
    masks = masks or masks_of(begun, moved)
    source = path_of(begun, moved)
    scene = _read(source, begun.downscale, masks, images, run.folder, config.threads)
    trainer = Trainer(scene, config, state)
    scene = begun.as_trained(scene)
    _describe(scene, trainer)
    for note in notes:
        print(f"  note: {note}")
    for name in ("device", "threads"):
        old, new = getattr(state.config, name), getattr(config, name)
        if new != old:
            print(f"  note: {name} {new} instead of {old}: sums are rounded in another order")
    print(f"  resuming after step {trainer.steps_done}")
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
    source: str,
    downscale: int,
    masks: Path | str | None,
    images: Place,
    output: Path,
    threads: int | None,
) -> Scene:
    """The scene, whose photographs are kept where the run will be if they are kept on disk."""
    from warpnerf.evaluation.evaluate import require_measurable
    from warpnerf.scenes.formats.load import load_scene

    print(f"reading {source}", flush=True)
    there = next((folder for folder in (output, *output.parents) if folder.is_dir()), None)
    scene = load_scene(
        source,
        downscale=downscale,
        masks=masks,
        images=images,
        image_folder=there,
        threads=threads,
    )
    require_measurable(scene, _split_to_look_at(scene))
    return scene


def _split_to_look_at(scene: Scene) -> str:
    return "test" if scene.splits.get("test") else "train"


def _train(run: Run, scene: Scene, trainer: Trainer, session: Session | None) -> int:
    """Train to the end, or until asked to stop; look at the test views."""
    from warpnerf.reports.limits import what_limits

    between = None if session is None else session.after_update
    reports: list[Progress] = []
    with StopRequest() as stop:
        try:
            with ProgressBar("first step") as bar:

                def on_progress(progress: Progress) -> None:
                    run.log(progress)
                    reports.append(progress)
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
        saved = f"stopped and saved after step {step}; continue with: {run.resume_command}"
        print(saved if run.last_step == step else f"stopped; {run.way_on()}", flush=True)
        return stop.exit_code
    split = _split_to_look_at(scene)
    print(f"rendering the {'test' if split == 'test' else 'training'} views", flush=True)
    try:
        with ProgressBar("first view") as bar:
            result = run.evaluate(trainer.field(), scene, split, bar.report)
        print(result)
        limit = what_limits(
            reports, _voxel_pixels(trainer), result.mean["psnr"] if split == "test" else None
        )
        if limit is not None:
            print(limit)
    except Stopped as stopped:
        print(f"stopped; the field is saved. Continue with: {run.resume_command}", flush=True)
        return stopped.exit_code
    print(
        f"wrote {run.folder}: field.safetensors, metrics.json, log.jsonl, config.json, and test/ "
        f"with truth, rendering and depth of every view\nlook at {run.sheet}",
    )
    return 0


def _voxel_pixels(trainer: Trainer) -> float | None:
    """Width of a voxel of the grid that there is now, pixels; None: it says nothing."""
    from warpnerf.scenes.extent.sharpness import sharpness

    if not trainer.config.field.as_fine_as_nodes:
        return None
    lattice = trainer.lattice
    return sharpness(trainer.scene, lattice.space, math.prod(lattice.size), True).median


def _scaling(plan: TrainingPlan) -> str:
    """How gradients are scaled, and up to where if that is not the content distance."""
    scaling, distances = f"scaling {plan.config.scaling}", plan.content_distances
    least, most = f"{min(distances):.3g}", f"{max(distances):.3g}"
    if plan.config.scaling == "none" or set(distances) == {plan.content_distance}:
        return scaling
    return f"{scaling} below {least}" + (f" to {most}, by camera" if least != most else "")


def _describe(scene: Scene, trainer: Trainer) -> None:
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
    space = trainer.lattice.space  # of an object that is resumed, tighter than the plan's
    print(f"  box {in_words(space, space.kind.words)}")
    if trainer.steps_done == 0:
        print(f"  voxels {plan.voxel_pixels}")
    sys.stdout.flush()


def _absolute(source: str) -> str:
    return source if source.startswith("builtin:") else str(Path(source).resolve())


def _text(progress: Progress) -> str:
    speed = progress.step / max(progress.seconds, 1e-6)
    size = " x ".join(str(n) for n in progress.size)
    drawn = f" ({progress.psnr:.2f} over {progress.seen:.0%} of pixels)"
    return (
        f"step {progress.step}  loss {progress.loss:.5f}  "
        f"PSNR {progress.picture_psnr:.2f}{drawn if progress.seen < 1.0 else ''}  "
        f"grid {size}  {speed:.1f} steps/s"
    )
