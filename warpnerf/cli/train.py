"""`warpnerf train`: begins a run, or resumes one."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from warpnerf.checks import InputError
from warpnerf.cli import processes
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given
from warpnerf.cli.machine import FAILED, require_machine
from warpnerf.cli.pose import with_poses
from warpnerf.cli.train_options import USUAL, TrainOptions
from warpnerf.cli.view import training_page
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runs import lock
from warpnerf.runs.names import new_folder
from warpnerf.runtime.progress import ProgressBar
from warpnerf.runtime.signals import Stopped, StopRequest
from warpnerf.scenes.split import Split, read_split
from warpnerf.training.peers import ALONE, PeerLostError, Peers

if TYPE_CHECKING:
    from warpnerf.runs.run import Run
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.plan import TrainingPlan
    from warpnerf.training.state import Progress
    from warpnerf.training.trainer import Trainer
    from warpnerf.viewer.session import Session


def train_command(options: TrainOptions, given: Annotated[Given, USUAL] = NOTHING) -> int:
    """Train a voxel grid on a scene, and look at its test views.

    Each field of the configuration is an option too, such as --optim.decay 0.03.

    --help-all shows them all. Defaults are those of the --preset beside it.
    """
    options.require_usable()
    if processes.are_several():
        return processes.together(lambda peers: _train_command(options, given, peers))
    return _train_command(options, given, ALONE)


def _train_command(options: TrainOptions, given: Given, peers: Peers) -> int:
    """The command, in one process of those that train."""

    def changed(config: TrainConfig) -> TrainConfig:
        config = configured(config, given, options.model_options, options.loss)
        return config if peers.count == 1 else processes.share_of_machine(config, given)

    if peers.count > 1:
        options.require_no_looks()
    if options.resume is not None:
        for name in ("output", "preset", "config", "downscale", "split", "overwrite"):
            if getattr(options, name) is not None and getattr(options, name) is not False:
                raise InputError(
                    f"--{name} does not go with --resume: the run in {options.resume} continues as "
                    "it was begun; leave it out."
                )
        return _resume(options.resume, options, changed, peers)
    begin, options = _starting_point(options)
    config = begun_with(changed(begin), given)
    if options.scene is None:
        raise InputError("train wants a SCENE for a new run, or --resume DIR to resume one.")
    if config.loss.sample_colour > 0.0:  # before photographs are posed or read; loads Warp
        from warpnerf.rendering.losses import parts_with

        parts_with(config.model, "float32", config.loss)
    source = options.scene
    with ExitStack() as stack:  # the first process alone writes
        output = peers.from_first(lambda: stack.enter_context(_run_folder(source, options)))
        return _begin(source, output, options, config, peers)


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
        split: Any = run.split if options.split is None else options.split
        options = dataclasses.replace(options, scene=path_of(run), masks=masks, split=split)
    return run.train, options


@contextmanager
def _run_folder(source: str, options: TrainOptions) -> Iterator[Path]:
    """The folder of a new run, which nobody else writes to meanwhile."""
    with ExitStack() as stack:
        output = options.output
        if output is None:
            output = stack.enter_context(new_folder(source))
            print(f"training into {output}", flush=True)
        _require_free(output, options.overwrite)
        stack.enter_context(lock.only_writer(output))
        _require_free(output, options.overwrite)  # once more, now that nobody else begins there
        yield output


def _require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError unless a run may begin there; loads Warp only where something is."""
    from warpnerf.scenes.files import exists

    if exists(output) and not (
        output.is_dir() and all(path.name == lock.NAME for path in output.iterdir())
    ):
        from warpnerf.runs.run import Run

        Run.require_free(output, overwrite)


def _begin(
    source: str, output: Path, options: TrainOptions, config: TrainConfig, peers: Peers
) -> int:
    """Train from the first step on."""
    require_machine(config)
    split = None if options.split is None else read_split(options.split)
    photographs, masks = source, options.masks
    downscale = 1 if options.downscale is None else options.downscale
    source = peers.from_first(lambda: with_poses(photographs, output, masks, config.threads))
    if source != photographs:
        masks = None  # the posed scene brings them
    scene = _read(source, downscale, masks, output, options, config.threads, split)

    # Not before: these load Warp, and bad input is refused at once.
    from warpnerf.inspection.diagnostics import diagnostics
    from warpnerf.runs.run import Run
    from warpnerf.scenes.formats.survey import survey
    from warpnerf.training.coarse import prepare_trainer
    from warpnerf.training.plan import resolve

    peers.require_same(lambda: processes.identity(scene, config))
    plan = resolve(scene, config)
    if plan.looks_first:
        print("estimating the extent of the scene", flush=True)
        with ProgressBar("first step") as bar:
            trainer = prepare_trainer(
                scene,
                plan,
                on_progress=lambda found: bar.report(found.fraction, str(found)),
                peers=peers,
            )
    else:
        trainer = prepare_trainer(scene, plan, peers=peers)
    if peers.rank > 0:
        return processes.follow(Run(output), trainer)
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
        keep = options.keep or "field"
        of_scene = (_absolute(source), downscale, distance)
        run.create(trained, *of_scene, config, folder, found, keep, split)
        return _train(run, trained, trainer, session, options)


def _resume(
    folder: Path,
    options: TrainOptions,
    changed: Callable[[TrainConfig], TrainConfig],
    peers: Peers,
) -> int:
    """Train from the last checkpoint on."""
    from warpnerf.runs.run import Run

    run = Run(folder)
    run.read_config()
    with ExitStack() as stack:  # the first process alone writes
        peers.from_first(lambda: stack.enter_context(run.only_writer()))
        return _go_on(run, options, changed, peers)


def _go_on(
    run: Run,
    options: TrainOptions,
    changed: Callable[[TrainConfig], TrainConfig],
    peers: Peers,
) -> int:
    from warpnerf.runs.scene import masks_of, path_of
    from warpnerf.training.state import MAY_GROW, raised, require_same_config
    from warpnerf.training.trainer import Trainer

    begun, moved = run.read_config(), options.scene
    # Stopped while it was looked at.
    if peers.from_first(lambda: run.is_unlooked_at) and options.eval_views != "none":
        if peers.rank > 0:
            return 0
        config = changed(begun.train)
        require_same_config(begun.train, config)
        if raised(begun.train, config):
            run.load_state()  # refuses: there is none
        options.require_no_training(run.folder)
        require_machine(config)
        masks = options.masks or masks_of(begun, moved)
        source = path_of(begun, moved)
        scene = _read(
            source, begun.downscale, masks, run.folder, options, config.threads, begun.split
        )
        return _evaluate(run, begun.as_trained(scene), options, config.device, config.threads)
    state, notes = run.load_state()
    config = changed(
        dataclasses.replace(state.config, **{n: getattr(begun.train, n) for n in MAY_GROW})
    )
    state.require_same_config(config)
    longer = raised(begun.train, config)
    if longer:
        state.require_longer(config)
    require_machine(config)
    masks = options.masks or masks_of(begun, moved)
    source = path_of(begun, moved)
    scene = _read(source, begun.downscale, masks, run.folder, options, config.threads, begun.split)
    peers.require_same(lambda: processes.identity(scene, config))
    trainer = Trainer(scene, config, state, peers=peers)
    if peers.rank > 0:
        return processes.follow(run, trainer)
    scene = begun.as_trained(scene)
    _describe(scene, trainer)
    for note in notes:
        print(f"  note: {note}")
    for name in ("device", "threads"):
        old, new = getattr(state.config, name), getattr(config, name)
        if new != old:
            print(f"  note: {name} {new} instead of {old}: sums are rounded in another order")
    for name in longer:
        old, new = getattr(begun.train, name), getattr(config, name)
        print(
            f"  note: {name} {new} instead of {old}: learning rates rise to those of the "
            "longer training; one that is as long from the start ends otherwise"
        )
    print(f"  resuming after step {trainer.steps_done}")
    with training_page(options.page, scene, trainer) as session:
        if longer:
            run.extend(config)
        if options.keep not in (None, begun.keep):
            run.set_keep(options.keep)
        run.rewind_log(trainer.steps_done)
        del state  # the trainer has copies
        return _train(run, scene, trainer, session, options)


def _read(
    source: str,
    downscale: int,
    masks: Path | str | None,
    output: Path,
    options: TrainOptions,
    threads: int | None,
    split: Split | Sequence[str] | None,
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
        split=split,
    )
    if options.eval_views != "none":
        require_measurable(scene, _split_to_look_at(scene))
    if options.eval_every is not None:
        from warpnerf.training.held_out import require_eval  # loads Warp

        require_eval(scene, options.eval_every)
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
    options: TrainOptions,
) -> int:
    """Train to the end, or until asked to stop; look at the test views."""
    from warpnerf.reports.limits import voxel_pixels, what_limits
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
    del trainer  # its grid, and what its optimiser keeps

    def at_end(metrics: Mapping[str, float], split: str) -> None:
        limit = what_limits(reports, pixels, metrics["psnr"] if split == "test" else None)
        if limit is not None:
            print(limit)
        if log is not None:
            log.close(metrics)

    return _evaluate(run, scene, options, device, threads, at_end)


def _evaluate(
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
    split = _split_to_look_at(scene)
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
    print(f"  rays are {plan.sampler.past}")
    space = trainer.lattice.space  # of an object that is resumed, tighter than the plan's
    print(f"  box {in_words(space, space.kind.words)}")
    if trainer.steps_done == 0:
        print(f"  voxels {plan.voxel_pixels}")
    sys.stdout.flush()


def _absolute(source: str) -> str:
    return source if source.startswith("builtin:") else str(Path(source).resolve())
