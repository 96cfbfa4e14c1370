"""Experiments: configurations times seeds, each a run in a folder, that end where they were cut.

experiment.json             what is trained: capture, configurations, seeds
runs/CONFIGURATION-seed-K/  a run, as ``warpnerf train`` leaves it, with measures in metrics.json;
                            failed.json says why, where its training failed
moments/CONFIGURATION/K.npz one camera's rendering at a few moments of the training with seed 0
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from warpnerf.checks import InputError, cannot_write
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_from_json, config_to_json, decode
from warpnerf.evaluation.sight import SurfaceVisibility
from warpnerf.rendering.field import Field, Rendering
from warpnerf.runs.files import is_leftover, sweep
from warpnerf.runs.lock import matching, require_own
from warpnerf.runs.run import Run
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.files import read_json
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.split import Split
from warpnerf.training.coarse import prepare_trainer
from warpnerf.training.plan import resolve
from warpnerf.training.state import Progress, scene_digest
from warpnerf.training.trainer import Trainer
from warpnerf.writing import write_atomically

MOMENTS = (0.125, 0.3125, 0.5, 1.0)
"""Shares of a training after which a camera is rendered: 500, 1250, 2000 and 4000 of 4000 steps, as
in Philip & Deschaintre 2023, figure 6."""

MOMENT_PIXELS = 320 * 240
"""Of these renderings, at most, about."""

RECORD, FAILED = "experiment.json", "failed.json"

WRITTEN = (
    *("*.json", "*.html", "*.png", "*.mp4", "*.gif", "views", "views/*.png"),
    *("moments", "moments/*", "moments/*/*.npz", "runs", "runs/*", "runs/*/*.json*"),
)
"""What an experiment and its report write in the folder, as patterns of names; folders before what
lies in them. Each run has a list of its own."""


@dataclass(frozen=True, kw_only=True)
class Capture:
    """What all configurations are trained on."""

    scene: Scene
    """As it was read; it has test views."""
    source: str
    """Where from: an absolute path, or a built-in name."""
    downscale: int = 1
    """As for ``load_scene``."""
    masks: str | None = None
    """Absolute path of the folder of masks that was given."""
    split: Split | None = None
    """As for ``load_scene``."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A configuration that is compared."""

    name: str
    """Also of its folders."""
    config: TrainConfig
    """Its seed counts for nothing."""
    against: str | None = None
    """The name of that which it is compared with."""


class Experiment:
    """Trainings of configurations times seeds in a folder."""

    def __init__(
        self, folder: Path, capture: Capture, candidates: Sequence[Candidate], n_seeds: int
    ) -> None:
        """Name all; nothing is read or written yet."""
        self.folder, self.capture = folder, capture
        self.candidates, self.seeds = tuple(candidates), tuple(range(n_seeds))
        # Of cameras and depths, which no training changes.
        self._visibility = SurfaceVisibility(capture.scene)

    @property
    def trials(self) -> list[tuple[Candidate, int]]:
        """Configurations and seeds, in the order of their trainings: seed by seed."""
        return [(candidate, seed) for seed in self.seeds for candidate in self.candidates]

    def begin(self) -> None:
        """Make the folder, or continue in it, with more seeds or configurations as well.

        Raises:
            InputError: It holds another experiment, other files, or links in place of its own; or
                it cannot be written to.
        """
        path = self.folder / RECORD
        require_free(self.folder)
        wanted = json.loads(json.dumps(self._record()))
        found = read_json(path, dict[str, Any], _of_today) if path.exists() else None
        begun = wanted if found is None else _begun(wanted, found)
        if found is not None and any(found.get(name) != begun[name] for name in begun):
            wrong = f"holds another comparison: its {_difference(found, begun)}; name a new folder."
            if found | {"views": begun["views"]} == begun:
                wrong = (
                    "holds a comparison on other photographs, masks, cameras or split; bring them "
                    "back, or name a new folder."
                )
            raise InputError(f"--output {self.folder} {wrong}")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for place in (self.folder, *self.folder.glob("moments/*"), *self.folder.glob("views")):
                sweep(place)
            if found != wanted:
                write_atomically(path, (json.dumps(wanted, indent=2) + "\n").encode())
        except OSError as error:
            raise cannot_write(f"--output {self.folder}", error) from error

    def _record(self) -> dict[str, Any]:
        return {
            "scene": self.capture.source,
            "downscale": self.capture.downscale,
            "masks": self.capture.masks,
            "split": self.capture.split,
            "views": scene_digest(self.capture.scene, ("train", "test")),
            "seeds": len(self.seeds),
            "configurations": {
                candidate.name: config_to_json(candidate.config.for_kind(self.capture.scene.kind))
                for candidate in self.candidates
            },
        }

    def run(self, candidate: Candidate, seed: int) -> Run:
        """The folder of a training."""
        return Run(self.folder / "runs" / f"{candidate.name}-seed-{seed}")

    def metrics(self, candidate: Candidate, seed: int) -> dict[str, Any] | None:
        """metrics.json of a training; None: it has not finished."""
        return self.run(candidate, seed).read_metrics()

    def failure(self, candidate: Candidate, seed: int) -> str | None:
        """Why a training failed, a sentence; None: it did not. Without its folder it starts again.

        Raises:
            InputError: The record of it is damaged.
        """
        path = self.run(candidate, seed).folder / FAILED
        return read_json(path, dict[str, str]).get("error", "") if path.exists() else None

    def train(
        self,
        candidate: Candidate,
        seed: int,
        stop: Callable[[], bool] = lambda: False,
        on_progress: Callable[[float, str], None] = lambda done, words: None,
    ) -> bool:
        """Train to the end and measure, from where it was cut; nothing where both are done.

        A training whose loss is no longer finite ends, and is recorded as failed.

        Args:
            candidate: What is trained.
            seed: With which seed.
            stop: Whether to save and end early.
            on_progress: Called with the share of the training that is done, and a few words.

        Returns:
            Whether all is done.

        Raises:
            InputError: The folder cannot be written to, or another process trains there.
        """
        if self.metrics(candidate, seed) or self.failure(candidate, seed) is not None:
            return True
        run = self.run(candidate, seed)
        run.folder.parent.mkdir(exist_ok=True)
        with run.only_writer():
            if not (run.folder / "field.safetensors").exists():

                def report(progress: Progress) -> None:
                    run.log(progress)
                    on_progress(progress.fraction, str(progress))

                try:
                    trainer = self._trainer(run, candidate, seed)
                    moments = _Moments(trainer, self._moments(candidate)) if seed == 0 else None
                    if trainer.steps_done == 0 and moments is not None:
                        moments.discard()
                    trainer.run(
                        report,
                        run.save_checkpoint,
                        stop,
                        None if moments is None else moments.after_update,
                        checkpoint_when_done=False,
                    )
                except FloatingPointError as error:
                    text = json.dumps({"error": str(error)}) + "\n"
                    write_atomically(run.folder / FAILED, text.encode())
                    return True
                if trainer.fraction < 1.0:
                    return False
                run.save_field(trainer.field())
                del trainer, moments
            run.remove_checkpoints()
            run.draw_curves(self.capture.scene.name)
            self._measure(run, candidate, on_progress)
        return True

    def field(self, candidate: Candidate, seed: int) -> Field:
        """The field of a training that has finished."""
        config = candidate.config
        return self.run(candidate, seed).load_field(config.device, config.threads)[0]

    def moments(self, candidate: Candidate) -> list[Rendering]:
        """Renderings at MOMENTS of the training with seed 0, as many as there are."""
        found = []
        for k in range(len(MOMENTS)):
            path = self._moments(candidate) / f"{k}.npz"
            if path.exists():
                with np.load(path) as arrays:
                    found.append(Rendering(**{name: arrays[name] for name in arrays.files}))
        return found

    def _moments(self, candidate: Candidate) -> Path:
        return self.folder / "moments" / candidate.name

    def _trainer(self, run: Run, candidate: Candidate, seed: int) -> Trainer:
        """A trainer that begins, or that resumes from the run's last checkpoint."""
        capture = self.capture
        if run.checkpoints:
            state, _ = run.load_state()
            run.rewind_log(state.progress.step)
            return Trainer(capture.scene, state.config, state)
        config = replace(candidate.config, seed=seed)
        plan = resolve(capture.scene, config)
        trainer = prepare_trainer(capture.scene, plan)
        distance, found = trainer.plan.content_distance, trainer.observed is not None
        of_scene = (capture.source, capture.downscale, distance)
        run.create(trainer.scene, *of_scene, config, capture.masks, found, "field", capture.split)
        return trainer

    def _measure(
        self, run: Run, candidate: Candidate, on_progress: Callable[[float, str], None]
    ) -> None:
        config = candidate.config
        field, _ = run.load_field(config.device, config.threads)
        scene = run.read_config().as_trained(self.capture.scene)
        run.evaluate(field, scene, "test", on_progress, measures=self._visibility)


class _Moments:
    """Renders a camera when so much of a training is done, which that does not change by a bit."""

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        self._trainer, self._folder = trainer, folder
        self._camera = camera_of_moments(trainer.scene)

    def discard(self) -> None:
        """Remove what another beginning of the training has left."""
        for path in self._folder.glob("*.npz"):
            path.unlink()

    def after_update(self) -> None:
        """Render, where a moment has come for the first time."""
        for k, share in enumerate(MOMENTS):
            path = self._folder / f"{k}.npz"
            if self._trainer.fraction < share or path.exists():
                continue
            seen = self._trainer.field().render(self._camera)
            file = BytesIO()
            np.savez_compressed(file, **asdict(seen))
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(path, file.getvalue())


def camera_of_moments(scene: Scene) -> Camera:
    """The camera that is rendered during trainings: the middle one of the training views."""
    cameras = scene.training_cameras
    camera = cameras[len(cameras) // 2]
    return camera.downscaled(camera.block_for(MOMENT_PIXELS))


def require_free(folder: Path) -> None:
    """Raise InputError where a folder holds other files than those of an experiment.

    Raises:
        InputError: It does, has links in place of them, or cannot be read.
    """
    try:
        names = sorted(p.name for p in folder.iterdir() if not is_leftover(p))
    except (FileNotFoundError, NotADirectoryError):
        names = []  # is made later, or refused
    except OSError as error:
        raise cannot_write(f"--output {folder}", error) from error
    if names and RECORD not in names:
        raise InputError(f"--output {folder} holds other files ({names[0]}); name a new folder.")
    require_own(matching(folder, WRITTEN), "a comparison")


def _of_today(record: Any) -> Any:
    """A record of an earlier version: options that came after it have their defaults."""
    configurations = record.get("configurations") if isinstance(record, dict) else None
    if not isinstance(configurations, dict):
        return record
    read = dict(configurations)
    for name, tree in configurations.items():
        try:
            config = msgspec.convert(config_from_json(tree), TrainConfig, dec_hook=decode)
        except (msgspec.ValidationError, TypeError, AttributeError):
            continue  # it is another's, which is said where they are compared
        today = json.loads(json.dumps(config_to_json(config)))
        if _has_all(today, tree):
            read[name] = today
    return record | {"configurations": read}


def _has_all(tree: Any, other: Any) -> bool:
    """Whether a tree has all keys of another."""
    if not (isinstance(tree, dict) and isinstance(other, dict)):
        return True
    return all(name in tree and _has_all(tree[name], other[name]) for name in other)


def _begun(wanted: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """A record without the seeds and configurations that it has besides another's."""
    begun, configurations = dict(wanted), found.get("configurations")
    if isinstance(found.get("seeds"), int):
        begun["seeds"] = min(found["seeds"], wanted["seeds"])
    if isinstance(configurations, dict) and set(configurations) <= set(wanted["configurations"]):
        begun["configurations"] = {name: wanted["configurations"][name] for name in configurations}
    return begun


def _difference(found: Any, wanted: Any, where: str = "") -> str:
    """Half a sentence on the first value in which a record is not what it should be."""
    if not (isinstance(found, dict) and isinstance(wanted, dict)):
        return f"{where} is {json.dumps(found)}, not {json.dumps(wanted)}"
    if where and list(found) != list(wanted):
        return f"{where} has {', '.join(found)}, not {', '.join(wanted)}"
    name = next(name for name in wanted if found.get(name) != wanted[name])
    return _difference(found.get(name), wanted[name], f"{where}.{name}".removeprefix("."))
