"""`warpnerf train`: begins a run, or resumes one."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from warpnerf.checks import InputError, require_whole
from warpnerf.cli.arguments import Settings, Usual
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given
from warpnerf.cli.machine import FAILED
from warpnerf.cli.pose import with_poses
from warpnerf.cli.view import PageOptions, training_page
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runs import lock
from warpnerf.runtime.memory import require_threads
from warpnerf.runtime.progress import ProgressBar
from warpnerf.runtime.signals import Stopped, StopRequest

if TYPE_CHECKING:
    from warpnerf.runs.run import Run
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
    """Folder for configuration, field, log, figures and pictures; by default runs/SCENE-TIME."""
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
    eval_views: Literal["all", "none"] | int = "all"
    """Test views that are rendered and measured at the end: all, none, or so many, spread.
    warpnerf eval does it at any time."""
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

    def require_usable(self) -> None:
        """Raise InputError where an option cannot be followed, before anything is read."""
        PageOptions.chosen(self.view, self.host, self.port)
        if isinstance(self.eval_views, int):
            require_whole("--eval-views", self.eval_views, 1)


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
    options.require_usable()

    def changed(config: TrainConfig) -> TrainConfig:
        return configured(config, given, options.model_options, options.loss)

    if options.resume is not None:
        for name in ("output", "preset", "config", "downscale", "overwrite"):
            if getattr(options, name) is not None and getattr(options, name) is not False:
                raise InputError(
                    f"--{name} does not go with --resume: the run in {options.resume} continues as "
                    "it was begun; leave it out."
                )
        return _resume(options.resume, options, changed)
    begin, options = _starting_point(options)
    config = begun_with(changed(begin), given)
    if options.scene is None:
        raise InputError("train wants a SCENE for a new run, or --resume DIR to resume one.")
    if config.loss.sample_colour > 0.0:  # before photographs are posed or read; loads Warp
        from warpnerf.rendering.losses import parts_with

        parts_with(config.model, "float32", config.loss)
    output = options.output or _named_by(options.scene)
    return _begin(options.scene, output, options, config)


def _named_by(source: str) -> Path:
    """A folder for a run of a scene, named by it and by the time."""
    builtin = source.startswith("builtin:")
    name = source.removeprefix("builtin:") if builtin else Path(source).resolve().stem
    return Path("runs", f"{name or 'scene'}-{time.strftime('%Y-%m-%d-%H%M%S')}")


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


def _begin(source: str, output: Path, options: TrainOptions, config: TrainConfig) -> int:
    """Train from the first step on."""
    _require_free(output, options.overwrite)
    with lock.only_writer(output):
        _require_free(output, options.overwrite)  # once more, now that nobody else begins there
        return _begin_alone(source, output, options, config)


def _require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError unless a run may begin there; loads Warp only where something is."""
    from warpnerf.scenes.files import exists

    if exists(output) and not (
        output.is_dir() and all(path.name == lock.NAME for path in output.iterdir())
    ):
        from warpnerf.runs.run import Run

        Run.require_free(output, overwrite)


def _begin_alone(source: str, output: Path, options: TrainOptions, config: TrainConfig) -> int:
    """Train from the first step on, as the only one that writes to the folder."""
    _require_machine(config)
    photographs, masks = source, options.masks
    downscale = 1 if options.downscale is None else options.downscale
    source = with_poses(photographs, output, masks, config.threads)
    if source != photographs:
        masks = None  # the posed scene brings them
    scene = _read(source, downscale, masks, output, options, config.threads)

    # Not before: these load Warp, and bad input is refused at once.
    from warpnerf.inspection.diagnostics import diagnostics
    from warpnerf.runs.run import Run
    from warpnerf.scenes.formats.survey import survey
    from warpnerf.training.coarse import prepare_trainer
    from warpnerf.training.plan import resolve

    plan = resolve(scene, config)
    if plan.looks_first:
        print("estimating the extent of the scene", flush=True)
        with ProgressBar("first step") as bar:
            trainer = prepare_trainer(
                scene, plan, on_progress=lambda found: bar.report(found.fraction, str(found))
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
    with training_page(options.page, trained, trainer) as session:
        folder = None if masks is None else str(masks.resolve())
        found = trainer.observed is not None
        run.create(trained, _absolute(source), downscale, distance, config, folder, found)
        return _train(run, trained, trainer, session, options.eval_views)


def _resume(
    folder: Path, options: TrainOptions, changed: Callable[[TrainConfig], TrainConfig]
) -> int:
    """Train from the last checkpoint on."""
    from warpnerf.runs.run import Run

    Run(folder).read_config()
    with Run(folder).only_writer():
        return _go_on(Run(folder), options, changed)


def _go_on(run: Run, options: TrainOptions, changed: Callable[[TrainConfig], TrainConfig]) -> int:
    from warpnerf.runs.scene import masks_of, path_of
    from warpnerf.training.trainer import Trainer

    begun, moved = run.read_config(), options.scene
    state, notes = run.load_state()
    config = changed(state.config)
    state.require_same_config(config)
    _require_machine(config)
    masks = options.masks or masks_of(begun, moved)
    source = path_of(begun, moved)
    scene = _read(source, begun.downscale, masks, run.folder, options, config.threads)
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
    with training_page(options.page, scene, trainer) as session:
        run.rewind_log(trainer.steps_done)
        del state  # the trainer has copies
        return _train(run, scene, trainer, session, options.eval_views)


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
    output: Path,
    options: TrainOptions,
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
        images=options.images,
        image_folder=there,
        threads=threads,
    )
    if options.eval_views != "none":
        require_measurable(scene, _split_to_look_at(scene))
    return scene


def _split_to_look_at(scene: Scene) -> str:
    return "test" if scene.splits.get("test") else "train"


def _some_views(scene: Scene, split: str, count: Literal["all"] | int) -> Scene:
    """The scene with so many of a split's views, spread."""
    indices = scene.splits[split]
    if count == "all" or count >= len(indices):
        return scene
    chosen = tuple(indices[len(indices) * k // count] for k in range(count))
    return dataclasses.replace(scene, splits={**scene.splits, split: chosen})


def _train(
    run: Run,
    scene: Scene,
    trainer: Trainer,
    session: Session | None,
    eval_views: Literal["all", "none"] | int,
) -> int:
    """Train to the end, or until asked to stop; look at the test views."""
    from warpnerf.reports.limits import voxel_pixels, what_limits

    between = None if session is None else session.after_update
    reports: list[Progress] = []
    with StopRequest() as stop:
        try:
            with ProgressBar("first step") as bar:

                def on_progress(progress: Progress) -> None:
                    run.log(progress)
                    reports.append(progress)
                    bar.report(progress.fraction, str(progress))

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
    if eval_views == "none":
        print(f"wrote {run.folder}: field.safetensors, log.jsonl and config.json")
        return 0
    split = _split_to_look_at(scene)
    scene = _some_views(scene, split, eval_views)
    print(f"rendering the {'test' if split == 'test' else 'training'} views", flush=True)
    try:
        with ProgressBar("first view") as bar:
            result = run.evaluate(trainer.field(), scene, split, bar.report)
        print(result)
        limit = what_limits(
            reports, voxel_pixels(trainer), result.mean["psnr"] if split == "test" else None
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
