"""Training: one update of the grid, and the schedule of all. No files, no terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.model.grid import FreeCells, grid_size
from warpnerf.model.interface import Model, parts_of
from warpnerf.model.parameters import Parameter, first_weights, parameters_of
from warpnerf.rendering.field import Field
from warpnerf.rendering.losses import Minimised
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.render import Steps, TrainingPass, march_struct
from warpnerf.runtime.memory import give_back
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.points import SeenExtent, seen_scene
from warpnerf.scenes.scene import Scene
from warpnerf.training import extent
from warpnerf.training.optim import RULES, adam_step, add_total_variation, first_states
from warpnerf.training.schedule import Schedule
from warpnerf.training.smoothing import strengths
from warpnerf.training.state import Progress, TrainingState, scene_digest
from warpnerf.training.warmup import training_kernels

REPORT_EVERY = 25
"""Steps between two reports, which come after an update."""

FIRST_LOOK = 200
"""Steps before the first look for free space and the first growth: what is left out then stays out,
so densities must have had time to show."""


class Trainer:
    """A training run between two updates: the grid, its optimiser, and what comes next."""

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        resume: TrainingState | None = None,
        *,
        sight: SeenExtent | None = None,
        seconds: float = 0.0,
    ) -> None:
        """Set up the first update, or the next one of a training to be resumed.

        Args:
            scene: What is trained on.
            config: How.
            resume: Where to go on.
            sight: Gives content distances in place of the scene's, and its box where the scene's is
                a guess, for a new training.
            seconds: Spent on it so far.

        Raises:
            InputError: The device is missing, the grid would not fit the memory, or scene or
                configuration are not those of the training to be resumed.
        """
        if resume is not None:
            resume.require_same(scene, config)
        self.config = config
        self.workers = Workers(config.device, config.threads)
        self.steps_done = 0
        self._given = scene
        self._scene_digest = None if resume is None else resume.scene_digest
        self.sight = sight
        """What a short training has found; None: the scene's own extent is used."""
        if sight is not None:
            scene = seen_scene(scene, sight)
        self.scene = scene
        """What it trains on, with the extent that a new training begins with."""
        extent.require_samples(scene, config)
        if resume is None:
            self.content_distance, distances = extent.content_distances(scene, config)
            self._reach = extent.reach(scene)
        else:  # estimates anew may be rounded otherwise
            self.content_distance, self._reach = resume.content_distance, resume.reach
            n_views = len(scene.splits["train"])
            distances = resume.content_distances or [resume.content_distance] * n_views
            if len(distances) != n_views:
                raise InputError(
                    f"the training to be resumed has {len(distances)} content distances, but "
                    f"{scene.name} {n_views} training views; train anew."
                )
        self.content_distances = distances
        """Of the training views, scene units."""
        self._losses = config.losses_for(scene.kind)
        if scene.kind == "object" and self._losses.opacity != 0.0:
            raise InputError(
                f"loss.opacity is above 0, but photographs of {scene.name} have alpha, and where "
                "they show nothing, nothing should be; set it to 0 or auto."
            )
        views = [scene.views[i] for i in scene.splits["train"]]
        behind = config.background
        if behind == "auto":
            behind = "white" if scene.has_alpha else "black"
        self._background = _COLOURS[behind] if isinstance(behind, str) else behind
        self._sampler = PixelSampler(
            views,
            np.array(distances),
            None if behind == "random" else self._background,
            config.rays_per_step,
            config.march.jitter,
            config.seed,
            self.workers,
        )
        self.schedule = Schedule(config=config, kind=scene.kind)
        self._grown = 0
        self._updates = 0
        self._restarted = 0
        assert isinstance(config.model, Model)
        self.model = config.model
        self.grid = extent.first_grid(
            scene,
            config,
            config.grid.nodes_after(0, scene.kind),
            self.workers.device,
            None if resume is None else resume.field.grid,
        )
        idle = config.scaling == "none" or not self.grid.folded
        if resume is None and idle and config.jacobian != "none":
            raise InputError(
                f"jacobian {config.jacobian} does nothing where gradients are not scaled or space "
                f"is not folded: here scaling is {config.scaling} and grid.contraction "
                f"{self.grid.contraction}; set it to none."
            )
        self.weights = first_weights(self.model, config.seed, self.workers)
        self.optimiser = first_states(self.parameters(), self.workers)
        self.free = FreeCells.none(self.workers)
        self._report_due = False
        self._started: float | None = None
        self._seconds = seconds
        self._progress: Progress | None = None
        if resume is not None:
            self._restore(resume)
        self._occupied = self.free.share()
        self._seen = 1.0
        if resume is not None:
            self._keep_to_what_is_seen()
        self._pass, self._strength = self._training_pass(), self._smoothing()

    def run(
        self,
        on_progress: Callable[[Progress], None] | None = None,
        on_checkpoint: Callable[[TrainingState], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        between: Callable[[], None] | None = None,
    ) -> Progress:
        """Update until the training is done, or ``stop`` says so; callbacks are those of ``train``.

        ``between`` is called after each update, and its time is not counted as training.

        Raises:
            FloatingPointError: The loss, or a value in the grid, is no longer a finite number.
        """
        saved_step, saved_at = self.steps_done, time.monotonic()
        while self.fraction < 1.0 and not stop():
            self.update()
            if between is not None and self._started is not None:
                began = time.perf_counter()
                between()
                self._started += time.perf_counter() - began
            if self.report_due:
                progress = self.report()
                if on_progress is not None:
                    on_progress(progress)
            late = time.monotonic() - saved_at >= self.config.checkpoint_every
            if on_checkpoint is not None and late:
                on_checkpoint(self.state())
                saved_step, saved_at = self.steps_done, time.monotonic()
        if on_checkpoint is not None and self.steps_done > saved_step:
            on_checkpoint(self.state())
        return self.report()

    @property
    def fraction(self) -> float:
        """How much of the training is done: of its steps, or of its time where that is further."""
        done = self.steps_done / self.config.steps
        if self.config.time_limit is not None:
            done = max(done, self._seconds / self.config.time_limit)
        return min(done, 1.0)

    @property
    def report_due(self) -> bool:
        """Whether it is time for a report."""
        return self._report_due or self.fraction >= 1.0

    def update(self) -> None:
        """Draw the batches of some steps, and update the grid by the gradients of their losses.

        When due, the grid grows and free space is looked for before.
        """
        config = self.config
        if self._started is None:  # compiling is not training
            for kernel in self._kernels():
                self.workers.load(kernel)
        fraction = self.fraction
        self._grow(fraction)
        if self._updates % config.occupancy_every == 0:
            self._look_for_free_space()
        before = self.steps_done
        n_steps = min(self.schedule.steps_an_update(fraction), config.steps - before)
        batch = self._sampler.draw(before, n_steps)
        self._pass.run(self.free, batch, n_steps, self._seen)
        if self._updates % config.optim.tv_every == 0 and fraction < config.optim.tv_until:
            add_total_variation(
                self.parameters(),
                self.grid,
                self._pass.gradients,
                config.grid.voxels,
                n_steps,
                self._strength,
                config.optim,
                self.workers,
            )
        self.steps_done += n_steps
        self._updates += 1
        adam_step(
            self.parameters(),
            self.optimiser,
            self._pass.gradients,
            self._updates - self._restarted,
            self.schedule.rate(fraction, self._grown, n_steps),
            config.optim,
            self.workers,
        )
        self._report_due = self.steps_done // REPORT_EVERY > before // REPORT_EVERY
        if self._started is None:  # nor is the first update, in which memory is first touched
            self._started = time.perf_counter() - self._seconds
        self._seconds = time.perf_counter() - self._started

    def report(self) -> Progress:
        """Where training stands.

        Raises:
            FloatingPointError: The loss is not finite.
        """
        if self._progress is not None and self._progress.step == self.steps_done:
            return self._progress
        n_rays = self._pass.n_rays
        error = float(self._pass.error.numpy()[:n_rays].mean())
        loss = float(self._pass.loss.numpy()[:n_rays].mean())
        if not math.isfinite(loss):
            raise self._not_finite("the loss is")
        self._progress = Progress(
            step=self.steps_done,
            fraction=self.fraction,
            seconds=self._seconds,
            loss=loss,
            psnr=-10.0 * math.log10(max(error / 3.0, 1e-12)),
            samples_per_ray=float(self._pass.n_samples.numpy()[:n_rays].mean()),
            size=self.grid.size,
            occupied=self._occupied,
            seen=self._seen,
        )
        return self._progress

    def state(self) -> TrainingState:
        """All that it takes to go on, in the trainer's own arrays, which the next update changes.

        Raises:
            FloatingPointError: The loss, or a value in the grid, is not finite: nothing to go on
                from.
        """
        progress = self.report()
        for parameter in self.parameters():
            if not np.isfinite(parameter.values.numpy()).all():
                raise self._not_finite(f"{parameter.name} of the model are")
        if self._scene_digest is None:  # not before: it takes as long as reading all photographs
            self._scene_digest = scene_digest(self._given)
        threads = self.config.threads if self.workers.device.is_cuda else self.workers.count
        return TrainingState(
            config=replace(self.config, threads=threads),
            scene_digest=self._scene_digest,
            content_distance=self.content_distance,
            content_distances=(
                self.content_distances if isinstance(self.config.content_distance, str) else None
            ),
            reach=self._reach,
            grown=self._grown,
            updates=self._updates,
            restarted=self._restarted,
            progress=progress,
            field=self.field(),
            optimiser=self.optimiser,
        )

    def _not_finite(self, what: str) -> FloatingPointError:
        smaller = "smaller weights of losses, " if self._losses.kinds else ""
        return FloatingPointError(
            f"{what} not finite after step {self.steps_done}; choose a content distance that fits "
            f"the scene, the clamped scaling, {smaller}or lower learning rates."
        )

    def _restore(self, state: TrainingState) -> None:
        """Take over copies of a state's arrays, and where it stands."""

        def copy(array: wp.array) -> wp.array:
            return wp.clone(array, device=self.workers.device)

        field = state.field
        self.grid = field.grid.copied_to(self.workers.device)
        self.free = replace(field.free, distance=copy(field.free.distance))
        self.weights = copy(field.weights)
        self.optimiser = {
            name: {key: copy(array) for key, array in arrays.items()}
            for name, arrays in state.optimiser.items()
        }
        self._grown = state.grown
        self._updates = state.updates
        self._restarted = state.restarted
        self._progress = state.progress
        self.steps_done = state.progress.step
        self._seconds = state.progress.seconds

    def field(self) -> Field:
        """The scene as it stands."""
        return Field(
            model=self.model,
            grid=self.grid,
            weights=self.weights,
            free=self.free,
            steps=self.march_steps(),
            background=self._background,
            workers=self.workers,
        )

    def march_steps(self) -> Steps:
        """How rays are marched through the grid as it stands."""
        return extent.march_steps(self.config.march, self.grid, self._reach)

    def parameters(self) -> tuple[Parameter, ...]:
        """What is trained."""
        return parameters_of(self.model, self.grid, self.weights, self.config.optim)

    def _training_pass(self) -> TrainingPass:
        return TrainingPass(
            self.config.rays_per_step * self.schedule.most_steps_an_update,
            self.model,
            self.grid,
            self.weights,
            self.march_steps(),
            self.config.scaling,
            self.config.jacobian,
            self.workers,
            Minimised(config=self._losses, content_distance=self.content_distance),
        )

    def _kernels(self) -> list[wp.Kernel]:
        return training_kernels(
            self.model,
            self.grid.contraction,
            self.config.scaling,
            self.config.jacobian,
            self.workers.device,
            self._losses,
        )

    def _grow(self, fraction: float) -> None:
        """Carry grid and optimiser over to more voxels, once the schedule says so."""
        grown = self.schedule.growths(fraction)
        if grown == self._grown or self.steps_done < FIRST_LOOK:
            return
        box, nodes = self._tight_box(), self.config.grid.nodes_after(grown, self.scene.kind)
        size = grid_size((box[1] - box[0]) * (1.0 + self.grid.border), nodes)
        del self._pass  # gives its memory back before more is asked for
        grid = self.grid.resized(self.workers, size, box)
        anew = self.config.optim.restart_at_growth
        if not anew:
            for parameter in self.parameters():
                state = self.optimiser[parameter.name]
                resized = RULES[parameter.kind].resized(state, self.grid, grid, self.workers)
                self.optimiser[parameter.name] = resized
        shift = (grown - self._grown) * self.config.grid.shift_at_growth
        self.grid = replace(grid, density_shift=grid.density_shift - shift)
        self._grown = grown
        if anew:
            self.optimiser = first_states(self.parameters(), self.workers)
            self._restarted = self._updates
        give_back()
        self._pass, self._strength = self._training_pass(), self._smoothing()
        self._look_for_free_space()

    def _smoothing(self) -> wp.array:
        return strengths(
            self.grid,
            self.scene.training_cameras,
            self.content_distances,
            self.config.march.near,
            self.config.scaling if any(np.any(p.variation) for p in self.parameters()) else "none",
            self.workers,
        )

    def _tight_box(self) -> tuple[np.ndarray, np.ndarray]:
        """The box around what is occupied, where space is bounded; never larger than before."""
        box_min, box_max = self.grid.box_min, self.grid.box_max
        if self.grid.folded:
            return box_min, box_max
        self._find_free_space()
        occupied = self.free.occupied_range()
        if occupied is None:
            return box_min, box_max
        edges = box_max - box_min
        return box_min + occupied[0] * edges, box_min + occupied[1] * edges

    def _look_for_free_space(self) -> None:
        """Find what need not be sampled, nor drawn.

        Not in the first steps, when nothing has grown yet.
        """
        if self.steps_done < FIRST_LOOK:
            return
        self._find_free_space()
        self._keep_to_what_is_seen()

    def _keep_to_what_is_seen(self) -> None:
        """Draw no pixels whose rays meet free space only; in folded space all see something.

        A single cell tells nothing: it is what there is before the first look, too.
        """
        looked = self.free.size != (1, 1, 1)
        if looked and self.config.skip_empty_rays and self.grid.contraction == "none":
            self._seen = self._sampler.keep_to(self.grid, self.free)

    def _find_free_space(self) -> None:
        march = march_struct(self.model, "float32", self.march_steps(), self.workers)
        sampler = parts_of(self.model, "float32").sampler
        self.free = FreeCells.of(self.grid, self.workers, march, self.config.alpha_min, sampler)
        self._occupied = self.free.share()


_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "random": (1.0, 1.0, 1.0)}
