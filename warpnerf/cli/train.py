"""`warpnerf train`: begins a run, or resumes one."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from warpnerf.checks import InputError
from warpnerf.cli import processes
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given
from warpnerf.cli.machine import require_machine
from warpnerf.cli.pose import with_poses
from warpnerf.cli.train_options import USUAL, TrainOptions
from warpnerf.cli.training import describe, evaluate_run, split_to_look_at, train_to_the_end
from warpnerf.cli.view import training_page
from warpnerf.config import TrainConfig
from warpnerf.model.storage_kinds import AUTO_FIELD
from warpnerf.presets import PRESETS
from warpnerf.runs import lock
from warpnerf.runs.names import new_folder
from warpnerf.runtime.progress import ProgressBar
from warpnerf.scenes.split import Split, read_split
from warpnerf.training.peers import ALONE, Peers

if TYPE_CHECKING:
    from warpnerf.runs.run import Run
    from warpnerf.scenes.scene import Scene


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
    describe(trained, trainer)
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
        return train_to_the_end(run, trained, trainer, session, options)


def _resume(
    folder: Path,
    options: TrainOptions,
    changed: Callable[[TrainConfig], TrainConfig],
    peers: Peers,
) -> int:
    """Train from the last checkpoint on."""
    from warpnerf.blocks.folder import FILE
    from warpnerf.runs.run import Run

    if (folder / FILE).is_file():
        raise InputError(
            f"--resume {folder} holds blocks; warpnerf train-blocks {shlex.quote(str(folder))} "
            "continues their trainings."
        )
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
        require_same_config(_with_auto_of(begun.train, config), config)
        if raised(begun.train, config):
            run.load_state()  # refuses: there is none
        options.require_no_training(run.folder)
        require_machine(config)
        masks = options.masks or masks_of(begun, moved)
        source = path_of(begun, moved)
        scene = _read(
            source, begun.downscale, masks, run.folder, options, config.threads, begun.split
        )
        decided = begun.train.for_kind(scene.kind)  # a name keeps what that field is then
        require_same_config(decided, changed(decided).for_kind(scene.kind))
        return evaluate_run(run, begun.as_trained(scene), options, config.device, config.threads)
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
    describe(scene, trainer)
    for note in notes:
        print(f"  note: {note}")
    for name in ("device", "threads"):
        old, new = getattr(state.config, name), getattr(config, name)
        if new != old:
            print(f"  note: {name} {new} instead of {old}: sums are rounded in another order")
    for name in longer:
        told, old, new = (getattr(c, name) for c in (begun.train, state.config, config))
        if new < told:
            print(f"  note: {name} {new}, not {told}, to which the run had been extended")
        if new > old:
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
        return train_to_the_end(run, scene, trainer, session, options)


def _with_auto_of(begun: TrainConfig, asked: TrainConfig) -> TrainConfig:
    """What was begun, with what is requested where it was auto: the scene tells what that was."""
    grid = begun.grid
    if grid.voxels == "auto":
        grid = dataclasses.replace(grid, voxels=asked.grid.voxels)
    field = asked.field if begun.field == AUTO_FIELD else begun.field
    return dataclasses.replace(begun, grid=grid, field=field)


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
        require_measurable(scene, split_to_look_at(scene))
    if options.eval_every is not None:
        from warpnerf.training.held_out import require_eval  # loads Warp

        require_eval(scene, options.eval_every)
    return scene


def _absolute(source: str) -> str:
    return source if source.startswith("builtin:") else str(Path(source).resolve())
