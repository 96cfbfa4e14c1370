"""Training: one update of the grid, and the schedule of all. No files, no terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from warpnerf.config import TrainConfig
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.parameters import Parameter, first_weights, head_parameters
from warpnerf.fields.storage import Regulariser
from warpnerf.model.interface import Model
from warpnerf.rendering.field import Field
from warpnerf.rendering.losses import Objective
from warpnerf.rendering.rays import RayBatch
from warpnerf.rendering.render import TrainingPass
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.memory import release_free_memory
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.points import ObservedExtent, with_extent
from warpnerf.scenes.scene import Scene
from warpnerf.training.exposure import STATE, Exposures, exposures_of
from warpnerf.training.extent import march_steps, require_samples
from warpnerf.training.free_space import SampledSpace, has_settled, occupied_box, pixel_sampler
from warpnerf.training.growth import (
    averaged_over,
    first_storage,
    grown_states,
    grown_storage,
    require_room,
    trained_on,
)
from warpnerf.training.optim import adam_step, first_states
from warpnerf.training.peers import ALONE, Peers, Signals
from warpnerf.training.photograph_errors import PhotographErrors
from warpnerf.training.plan import TrainingPlan, resolve
from warpnerf.training.resampling import first_proposal, grown_proposal, resampling_of
from warpnerf.training.state import (
    Progress,
    TrainingState,
    not_finite,
    require_finite,
    scene_digest,
)
from warpnerf.training.warmup import kernels_of

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
        config: TrainConfig | TrainingPlan,
        resume: TrainingState | None = None,
        *,
        observed: ObservedExtent | None = None,
        seconds: float = 0.0,
        peers: Peers = ALONE,
    ) -> None:
        """Set up the first update, or the next one of a training to be resumed.

        Args:
            scene: What is trained on.
            config: How; a plan where that is resolved already. A resumed training goes by its own
                plan, and of this takes what may change (``state.MAY_CHANGE``).
            resume: Where to resume.
            observed: Gives content distances in place of the scene's, and its box where the scene's
                is a guess, for a new training; a plan has been resolved with it.
            seconds: Spent on it so far.
            peers: The processes that train; each has a trainer, and draws its share of the rays.

        Raises:
            InputError: The device is missing, the grid would not fit the memory, or scene or
                configuration are not those of the training to be resumed, or scene and extent not
                those of the plan.
        """
        self._given = scene
        self._scene_digest = None if resume is None else resume.scene_digest
        self.observed = observed
        """What was found before; None: the scene's own extent is used."""
        if observed is not None:
            scene = with_extent(scene, observed)
        self.scene = scene
        """What it trains on, with the extent that a new training begins with."""
        if resume is not None:
            asked = config.config if isinstance(config, TrainingPlan) else config
            resume.require_same(self._given, asked)
            plan = resume.plan_of(scene, asked)
        elif isinstance(config, TrainingPlan):
            plan = config
        else:
            plan = resolve(scene, config, looked=True)
        plan.require_fits(scene)
        self.plan = plan
        """What it goes by; nothing is resolved after it."""
        self.config = config = plan.config
        self.workers = Workers(config.device, config.threads, peers.zeros)
        require_room(plan, self.workers.device)
        if resume is None:
            require_samples(scene, plan.space, config.march)
        self.steps_done = 0
        self._sampler = pixel_sampler(scene, plan, self.workers)
        self.schedule = plan.schedule
        self._grown = 0
        self._updates = 0
        self._restarted = 0
        assert isinstance(config.model, Model)
        self.model = config.model
        self.peers = peers
        self._report_due = False
        self._started: float | None = None
        self._seconds = seconds
        self._progress: Progress | None = None
        if resume is None:
            self.storage = first_storage(plan, self.workers.device)
            self.proposal = first_proposal(plan, self.workers.device)
            self.weights = first_weights(self.model, config.seed, self.workers)
            self.optimiser = first_states(self.parameters(), self.workers)
            free = FreeCells.none(self.workers)
        else:
            free = self._restore(resume)
        self._sampler.average_over(averaged_over(plan, self._grown))
        settled = resume is not None and has_settled(resume)
        self._space = SampledSpace(config, self._sampler, free, settled, self.workers)
        self.exposures: Exposures | None = None
        """Those of the training views, where it fits them."""
        if resume is None or STATE in self.optimiser:  # else they were dropped
            kept = self.optimiser.pop(STATE, None)
            self.exposures = exposures_of(scene, config.appearance, self.workers, kept)
        if self.exposures is not None:
            self._sampler.take_out_exposures(self.exposures.gains, self.exposures.offsets)
        self.photograph_errors = PhotographErrors(len(scene.splits["train"]))
        """Of the rays of reports, since it was set up."""
        self._views: wp.array | None = None
        self._space.cull_background(self.lattice)
        self._pass = self._training_pass()
        self._regularise_lattice()

    def run(
        self,
        on_progress: Callable[[Progress], None] | None = None,
        on_checkpoint: Callable[[TrainingState], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        between: Callable[[], None] | None = None,
        *,
        checkpoint_when_done: bool = True,
    ) -> Progress:
        """Update until the training is done, or ``stop`` says so; callbacks are those of ``train``.

        ``between`` is called after each update, and its time is not counted as training. Without
        ``checkpoint_when_done``, ``on_checkpoint`` is called at the end only where it was stopped.

        Raises:
            FloatingPointError: The loss, or a value in the grid, is no longer a finite number.
        """
        self._load_kernels()
        self.peers.wait()
        saved_step, saved_at = self.steps_done, time.monotonic()
        finite = True
        while True:
            late = time.monotonic() - saved_at >= self.config.checkpoint_every
            due = late and self.steps_done > saved_step
            agreed = self.peers.agree(
                Signals(seconds=self._seconds, stop=stop(), save=due, finite=finite)
            )
            if not agreed.finite:
                raise not_finite("the loss is", self.plan, self.steps_done)
            self._seconds = agreed.seconds
            if agreed.save and on_checkpoint is not None:
                on_checkpoint(self.state())
                self.peers.wait()
                saved_step, saved_at = self.steps_done, time.monotonic()
            # One update at least, where what came before has taken all the time.
            done = self.fraction >= 1.0 and self.steps_done > 0
            if done or agreed.stop:
                break
            self.update()
            if between is not None and self._started is not None:
                began = time.perf_counter()
                between()
                self._started += time.perf_counter() - began
            if self.report_due or self.peers.count > 1:  # of which one may be about to save
                finite = math.isfinite(self._mean(self._pass.loss))
            if finite and self.report_due and on_progress is not None:
                on_progress(self.report())
        unsaved = self.steps_done > saved_step
        if on_checkpoint is not None and unsaved and (checkpoint_when_done or self.fraction < 1.0):
            on_checkpoint(self.state())
        else:
            self._require_finite()
        self.peers.wait()  # torchrun ends all once one exits with other than 0
        return self.report()

    @property
    def fraction(self) -> float:
        """How much of the training is done: of its steps, or of its time where that is further."""
        done = self.steps_done / self.config.steps
        if self.config.time_limit is not None:
            done = max(done, self._seconds / self.config.time_limit)
        return min(done, 1.0)

    @property
    def _rays_drawn(self) -> int:
        """Rays of the steps done, those counted that met nothing."""
        return self.steps_done * self.config.rays_per_step

    @property
    def report_due(self) -> bool:
        """Whether it is time for a report."""
        return self._report_due or self.fraction >= 1.0

    def update(self) -> None:
        """Draw the batches of some steps, and update the grid by the gradients of their losses.

        When due, the grid grows and free space is looked for before.
        """
        if self._started is None:  # compiling is not training
            self._load_kernels()
        fraction = self.fraction
        self._grow(fraction)
        if self._settle(fraction):
            self._drop_pass()
            self._pass = self._training_pass()
        if self._updates % self.config.occupancy_every == 0:
            self._look_for_free_space()
        before = self.steps_done
        n_steps = min(self.schedule.steps_an_update(fraction), self.config.steps - before)
        self._pass.minimise(self._objective(fraction))
        self._differentiate(self._draw(n_steps), n_steps)
        self._add_gradients()
        self._regularise(fraction, n_steps)
        self._step(fraction, n_steps)
        self._report_due = self.steps_done // REPORT_EVERY > before // REPORT_EVERY
        if self._started is None:  # nor is the first update, in which memory is first touched
            self._started = time.perf_counter() - self._seconds
        self._seconds = time.perf_counter() - self._started

    def _draw(self, n_steps: int) -> RayBatch:
        """The rays of the next steps, put together; this process's share of them."""
        return self._sampler.draw(self.steps_done, n_steps, (self.peers.rank, self.peers.count))

    def _differentiate(self, batch: RayBatch, n_steps: int) -> None:
        """Add the gradient of a batch's losses to that of the update."""
        if self._resampling is not None:
            self._resampling.propose(self.free, batch, self.fraction)
        share = batch.count / self._sampler.count(n_steps)
        self._pass.run(self.free, batch, n_steps, share)
        self._views = batch.views
        if self._resampling is not None:
            self._resampling.learn(batch, n_steps * share, self._updates, self.fraction)
        if self.exposures is not None:
            self.exposures.add(batch, self._pass.rgb, self.fraction, self._rays_drawn)

    def _add_gradients(self) -> None:
        """Sum the gradients of all processes."""
        accumulated = [(self._pass.gradients, parameter) for parameter in self._of_field()]
        if self._resampling is not None and self.proposal is not None:
            gradients = self._resampling.gradients
            parameters = self.proposal.parameters(self.config.optim)
            accumulated += [(gradients, parameter) for parameter in parameters]
        if self.exposures is not None:
            accumulated.append(self.exposures.accumulated)
        self.peers.add(accumulated, self.workers)

    def _regularise(self, fraction: float, n_steps: int) -> None:
        """Add the gradient of the storage's regulariser, where it has one."""
        if self.regulariser is not None:
            self.regulariser(self._pass.gradients, self._updates, fraction, n_steps)

    def _step(self, fraction: float, n_steps: int) -> None:
        """Update what is trained by its gradients, which are zeroed."""
        self.steps_done += n_steps
        self._updates += 1
        rate = self.schedule.rate(fraction, self._grown, n_steps)
        how = self._updates - self._restarted, rate, self.config.optim
        of_field = self._of_field(), self.optimiser, self._pass.gradients
        adam_step(*of_field, *how, self.workers, self._decays)
        if self._resampling is not None:
            self._resampling.step(self.optimiser, *how)
        if self.exposures is not None:
            self.exposures.fit(round(self._space.seen * self._sampler.count(n_steps)))
            self.exposures = self.exposures.judged(self.fraction, self._rays_drawn, self.peers)

    def report(self) -> Progress:
        """Where training stands; FloatingPointError where the loss is not finite."""
        if self._progress is not None and self._progress.step == self.steps_done:
            return self._progress
        error, loss = self._mean(self._pass.error), self._mean(self._pass.loss)
        require_finite([("the loss is", loss)], self.plan, self.steps_done)
        if self._views is not None:
            errors = self._pass.error.numpy()[: self._pass.n_rays]
            self.photograph_errors.add(self._views.numpy(), errors, self.fraction)
        self._progress = Progress(
            step=self.steps_done,
            fraction=self.fraction,
            seconds=self._seconds,
            loss=loss,
            psnr=-10.0 * math.log10(max(error / 3.0, 1e-12)),
            samples_per_ray=self._mean(self._pass.n_samples),
            size=self.lattice.size,
            occupied=self._space.occupied,
            seen=self._space.seen,
        )
        return self._progress

    def _mean(self, of_rays: wp.array) -> float:
        """Over the rays of the last pass."""
        return float(of_rays.numpy()[: self._pass.n_rays].mean())

    def state(self) -> TrainingState:
        """All that it takes to resume, in the trainer's own arrays, which the next update changes.

        Raises:
            FloatingPointError: The loss, or a value in the grid, is not finite: nothing to resume
                from.
        """
        progress = self.report()
        self._require_finite()
        if self._scene_digest is None:  # not before: it takes as long as reading all photographs
            self._scene_digest = scene_digest(self._given)
        threads = self.config.threads if self.workers.device.is_cuda else self.workers.count
        return TrainingState(
            plan=replace(self.plan, config=replace(self.config, threads=threads)),
            scene_digest=self._scene_digest,
            grown=self._grown,
            updates=self._updates,
            restarted=self._restarted,
            progress=progress,
            field=self.field(),
            optimiser=self.optimiser | ({} if self.exposures is None else self.exposures.state),
        )

    def _require_finite(self) -> None:
        values = ((f"{p.name} of the model are", p.values.numpy()) for p in self.parameters())
        require_finite(values, self.plan, self.steps_done)

    def _restore(self, state: TrainingState) -> FreeCells:
        """Take over copies of a state's arrays, and where it stands; its free cells."""
        state = state.copied_to(self.workers.device)
        field = state.field
        self.storage, self.weights = field.storage, field.weights
        self.proposal = field.proposal
        self.optimiser = state.optimiser
        self._grown = state.grown
        self._updates = state.updates
        self._restarted = state.restarted
        self._progress = state.progress
        self.steps_done = state.progress.step
        self._seconds = state.progress.seconds
        return field.free

    @property
    def free(self) -> FreeCells:
        """Which cells hold nothing."""
        return self._space.free

    @property
    def lattice(self) -> Lattice:
        """The nodes over the space that is trained, as they stand."""
        return self.storage.lattice

    def field(self) -> Field:
        """The scene as it stands."""
        return Field(
            model=self.model,
            storage=self.storage,
            weights=self.weights,
            free=self.free,
            steps=self.march_steps(),
            background=self.plan.background,
            workers=self.workers,
            proposal=self.proposal,
        )

    def march_steps(self) -> Steps:
        """How rays are marched through the grid as it stands."""
        steps = march_steps(self.config.march, self.lattice, self.lattice.size, self.plan.reach)
        return self._space.terminated(steps)

    def parameters(self) -> tuple[Parameter, ...]:
        """What is trained."""
        of_proposal = () if self.proposal is None else self.proposal.parameters(self.config.optim)
        return self._of_field() + of_proposal

    def _of_field(self) -> tuple[Parameter, ...]:
        of_storage = self.storage.parameters(self.model, self.config.optim)
        return of_storage + head_parameters(self.model, self.weights)

    def _training_pass(self) -> TrainingPass:
        n_rays = self.config.rays_per_step * self.schedule.most_steps_an_update
        steps = self.march_steps()
        self._resampling = resampling_of(n_rays, self.proposal, steps, self.workers)
        return TrainingPass(
            n_rays,
            self.model,
            self.storage,
            self.weights,
            steps if self._resampling is None else self._resampling.intervals,
            self.config.scaling,
            self.config.jacobian,
            self.workers,
            self._objective(self.fraction),
        )

    def _objective(self, fraction: float) -> Objective:
        """What is minimised when so much of the training is done."""
        losses = self.plan.losses.at(fraction)
        return Objective(config=losses, content_distance=self.plan.content_distance)

    def _drop_pass(self) -> None:
        """What holds its arrays gives their memory back before more is requested."""
        if self.peers.count > 1 and self.steps_done:  # of which one may be lost meanwhile
            self.report()
        del self._pass, self._resampling

    def _load_kernels(self) -> None:
        """Compile what is not yet in the cache."""
        of_training = kernels_of(self.plan, self.lattice.contraction, self.workers.device)
        of_peers = self.peers.kernels if self.workers.device.is_cpu else ()
        self.workers.load(*of_training, *of_peers)

    def _grow(self, fraction: float) -> None:
        """Carry field and optimiser over to more voxels, once the schedule says so."""
        grown = self.schedule.growths(fraction)
        if grown <= self._grown or self.steps_done < FIRST_LOOK:
            return
        config, box, nodes = self.config, self._tight_box(), self.plan.stages[grown].nodes
        self._drop_pass()
        del self.regulariser, self._decays
        before, shift = self.storage, (grown - self._grown) * config.grid.shift_at_growth
        storage = grown_storage(before, box, nodes, shift, self.workers)
        restarts = config.optim.restart_at_growth
        if not restarts:
            of_field = self._of_field()
            self.optimiser |= grown_states(self.optimiser, of_field, before, storage, self.workers)
        if self.proposal is not None:
            self.proposal = grown_proposal(
                self.proposal, storage.lattice, self.optimiser, config.optim, self.workers
            )
        self.storage = storage
        self._grown = grown
        self._sampler.average_over(averaged_over(self.plan, grown))
        if restarts:
            self.optimiser = first_states(self.parameters(), self.workers)
            self._restarted = self._updates
        del before, storage
        release_free_memory()
        self._pass = self._training_pass()
        self._regularise_lattice()
        self._look_for_free_space()

    def _settle(self, fraction: float) -> bool:
        """Sample less from now on, if it is time to: not before the grid has its final size."""
        grown = self._grown >= self.schedule.growths(1.0)
        return grown and self._space.settle(fraction, self.steps_done)

    def _regularise_lattice(self) -> None:
        """Find what regularises the nodes that there are."""
        training = trained_on(self.scene, self.plan)
        self.regulariser: Regulariser | None = self.storage.regulariser(training, self.workers)
        self._decays = self.storage.decays(training, self.workers)

    def _tight_box(self) -> tuple[np.ndarray, np.ndarray]:
        """The box around what is occupied, where space is bounded; never larger than before."""
        if self.lattice.contracted or self.config.field.box_is_fixed:
            return self.lattice.box_min, self.lattice.box_max
        self._space.update_occupancy(self.storage, self.march_steps())
        return occupied_box(self.lattice, self.free)

    def _look_for_free_space(self) -> None:
        """Find what need not be sampled, nor drawn.

        Not in the first steps, when nothing has grown yet.
        """
        if self.steps_done < FIRST_LOOK:
            return
        self._space.update_occupancy(self.storage, self.march_steps())
        self._space.cull_background(self.lattice)
