"""Train a voxel radiance field, by one call. No files."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace

from warpnerf.checked import checked_arguments
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.rendering.field import Field
from warpnerf.runtime.progress import ProgressBar, has_bar
from warpnerf.scenes.scene import Scene
from warpnerf.training.coarse import prepare_trainer
from warpnerf.training.exposure import Exposure, in_use
from warpnerf.training.held_out import HeldOut, require_eval
from warpnerf.training.state import Progress, TrainingState


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainResult:
    """The result of training: the radiance field, and the scene with its content distance."""

    field: Field
    """The trained scene."""
    content_distance: float
    """The one that was used, scene units."""
    progress: Progress
    """The last report."""
    scene: Scene
    """What was trained on, with the extent that was used: it may have been looked for first."""
    exposures: dict[str, Exposure] | None
    """Of the training views, by name, where ``TrainConfig.appearance`` fits them."""
    photograph_psnr: dict[str, float]
    """Of training views, by name, dB: over the rays of reports in the last third of the training,
    since it was resumed, and in this process; of views of which these were enough. A view far below
    the others may have a wrong pose."""


@checked_arguments
def train(
    scene: Scene,
    config: TrainConfig | None = None,
    *,
    on_progress: Callable[[Progress], None] | None = None,
    on_checkpoint: Callable[[TrainingState], None] | None = None,
    resume: TrainingState | None = None,
    progress: bool | None = None,
    eval_every: int | None = None,
) -> TrainResult:
    """Train a voxel grid on a scene's training views.

    Each step takes pixels in a random order, marches their rays, and runs one hand-written adjoint
    back into the grid that scales each sample's gradient by its distance from the camera (Philip &
    Deschaintre 2023). kernels/README.md derives it.

    Args:
        scene: From ``load_scene``.
        config: How to train; None: as the training to be resumed, or else the preset "fast".
        on_progress: Called every ``trainer.REPORT_EVERY`` steps and at the end with a ``Progress``.
        on_checkpoint: Called every ``config.checkpoint_every`` seconds and at the end with what
            ``save_checkpoint`` takes, whose arrays the next update changes.
        resume: Where to resume, from ``load_checkpoint``. On the CPU and with the same number of
            threads, the result is that of a training that was never interrupted, bit for bit.
        progress: Whether to show a progress bar; None: in a terminal or a notebook, where
            ``on_progress`` is not given.
        eval_every: Steps from one look at a few test views to the next; reports then have their
            mean PSNR as ``test_psnr``. It takes no time of a time limit, and changes no bit of the
            result. None: they are not looked at.

    Returns:
        The field, and how training ended.

    Raises:
        InputError: Scene or configuration is none, the device is missing, the grid would not fit
            the memory, a short training for the content distance met nothing opaque, or scene or
            configuration are not those of the training to be resumed.
        FloatingPointError: The loss, or a value in the grid, is no longer a finite number.
    """
    if config is None:
        config = PRESETS["fast"] if resume is None else resume.config
    if eval_every is not None:
        require_eval(scene, eval_every)
    if progress is None:
        progress = on_progress is None and has_bar()
    last: Progress | None = None
    with ProgressBar("first step") if progress else nullcontext() as bar:

        def report(found: Progress) -> None:
            nonlocal last
            last = found if held_out is None else held_out.added_to(found)
            if bar is not None:
                latest = None if held_out is None else held_out.psnr
                bar.report(found.fraction, str(replace(last, test_psnr=latest)))
            if on_progress is not None:
                on_progress(last)

        trainer = prepare_trainer(scene, config, resume)
        held_out = None if eval_every is None else HeldOut(trainer, eval_every)
        between = None if held_out is None else held_out.after_update
        end = trainer.run(report, on_checkpoint, between=between)
    exposures, names = in_use(trainer.exposures), scene.training_names
    return TrainResult(
        field=trainer.field(),
        content_distance=trainer.plan.content_distance,
        progress=last or end,
        scene=trainer.scene,
        exposures=None if exposures is None else exposures.by_name(names),
        photograph_psnr=trainer.photograph_errors.psnr(names),
    )
