"""A run's folder: what was requested, how it went, what came out.

config.json                  scene, downscale, masks, split, what is kept, training configuration
log.jsonl                    a line for each progress report
log.csv, tensorboard/        the same, by --log
curves.png                   loss and PSNR over steps and seconds, once it is finished
checkpoint-*.safetensors     the training after so many steps; the last two, until it is finished
field.safetensors            the trained field, in half precision
visibility.safetensors       what training cameras see of it, once it has been exported
metrics.json                 figures of the test views
test.png                     a few test views, to look at first: truth, rendering, depth, PSNR
test/                        truth, rendering and depth of each test view, side by side
scene/                       photographs with the poses that were estimated, where they had none
next/scene/                  the same, until the run that it is made for begins
.lock                        while a training writes here
previous/                    a run that was replaced, until this one has saved something
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from warpnerf.checks import InputError, cannot_write
from warpnerf.config import TrainConfig
from warpnerf.evaluation.evaluate import Evaluation
from warpnerf.evaluation.measures import Measures
from warpnerf.evaluation.sight import SurfaceVisibility
from warpnerf.media.curves import curves
from warpnerf.media.pictures import write_png
from warpnerf.rendering.field import Field
from warpnerf.runs import files as run_files
from warpnerf.runs import lock
from warpnerf.runs.checkpoint import (
    load_checkpoint,
    load_field,
    save_checkpoint,
    save_field,
)
from warpnerf.runs.config import Keep, RunConfig, describe
from warpnerf.runs.logs import Log, LogKind, open_log, read_points, read_reports, rewound
from warpnerf.runs.pictures import evaluate_into
from warpnerf.runs.tensor_file import DamagedFileError
from warpnerf.scenes.files import read_json
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.split import Split
from warpnerf.training.state import MAY_GROW, Progress, TrainingState, differences
from warpnerf.writing import open_to_append, write_atomically

KEPT = 2
"""Checkpoints: should the last turn out to be damaged, there is the one before."""

T = TypeVar("T")


class Run:
    """The folder of one training run."""

    def __init__(self, folder: str | Path) -> None:
        """Name a folder; nothing is read or written yet."""
        self.folder = Path(folder)

    @property
    def resume_command(self) -> str:
        """How to resume."""
        return f"warpnerf train --resume {shlex.quote(str(self.folder))}"

    @property
    def checkpoints(self) -> list[Path]:
        """The checkpoints in the folder, the newest first."""
        return run_files.checkpoints(self.folder)

    @property
    def results(self) -> list[Path]:
        """Checkpoints and field in the folder, the furthest last."""
        return run_files.results(self.folder)

    @property
    def sheet(self) -> Path:
        """The picture of a few test views."""
        return self.folder / run_files.SHEET

    @property
    def visibility_file(self) -> Path:
        """Where exports keep what the training cameras see."""
        return self.folder / run_files.VISIBILITY

    @property
    def last_step(self) -> int | None:
        """The step of the newest checkpoint; None where there is none."""
        return run_files.step_of(self.checkpoints[0]) if self.checkpoints else None

    @property
    def is_unlooked_at(self) -> bool:
        """Whether it has finished and keeps its field alone, but its views were not looked at."""
        measured = (self.folder / "metrics.json").exists()
        return bool(self.results) and not self.checkpoints and not measured

    @staticmethod
    def require_free(folder: str | Path, overwrite: bool) -> None:
        """Raise InputError unless a new run may be written to a folder.

        Raises:
            InputError: It is a file, or holds files that must not or may not be replaced.
        """
        path = Path(folder)
        if path.exists() and not path.is_dir():
            raise InputError(f"--output {path} is a file; name a folder.")
        if not path.exists() or not run_files.is_taken(path):
            return
        run = Run(path)
        try:
            run.read_config()
        except InputError:
            raise InputError(f"--output {path} holds other files; name a new folder.") from None
        # One that ended before it saved anything is begun again.
        if not overwrite and (run.results or (path / run_files.PREVIOUS).exists()):
            ways = f"continue with it by --resume {path}, " if run.checkpoints else ""
            raise InputError(
                f"--output {path} holds a run already; {ways}replace it by --overwrite, or name "
                "another folder."
            )

    def only_writer(self) -> AbstractContextManager[None]:
        """Be the only process that writes to the folder, within a `with` statement.

        Raises:
            InputError: Another process trains into it, or it cannot be written to.
        """
        return lock.only_writer(self.folder)

    def create(
        self,
        scene: Scene,
        source: str,
        downscale: int,
        content_distance: float,
        config: TrainConfig,
        masks: str | None = None,
        found: bool = False,
        keep: Keep = "field",
        split: Split | None = None,
    ) -> None:
        """Make the folder and write its configuration; an older run's files go to previous/.

        A scene that waits in next/ is put in its place if it is the source, and else removed.

        Raises:
            InputError: The folder cannot be made or written to.
        """
        stored = run_files.stored_place(self.folder, source)
        how = (downscale, content_distance, config, masks, found, keep, split)
        content = describe(scene, stored, *how)
        try:
            (self.folder / "test").mkdir(parents=True, exist_ok=True)
            run_files.set_aside(self.folder, in_use=Path(source))
            text = json.dumps(content, indent=2) + "\n"
            write_atomically(self.folder / "config.json", text.encode())
            run_files.take_scene(self.folder, source)
        except OSError as error:
            raise cannot_write(f"--output {self.folder}", error) from error

    def read_config(self) -> RunConfig:
        """What ``create`` wrote.

        Raises:
            InputError: The folder holds no run.
        """
        return run_files.read_config(self.folder)

    def log(self, progress: Progress) -> None:
        """Append a report to log.jsonl.

        Raises:
            InputError: It cannot be written.
        """
        with self._writing(), open_to_append(self.folder / "log.jsonl") as file:
            file.write(json.dumps(asdict(progress)).encode() + b"\n")

    def save_checkpoint(self, state: TrainingState) -> None:
        """Write a checkpoint beside the last one; older ones are then removed.

        Raises:
            InputError: It cannot be written; those before are left as they were.
        """
        path = run_files.checkpoint_path(self.folder, state.progress.step)
        with self._writing():
            run_files.sweep(self.folder)
            save_checkpoint(path, state)
            # One of a later step is there only if it was damaged, and training resumed before it.
            step = run_files.step_of(path)
            kept = [p for p in self.checkpoints if run_files.step_of(p) <= step][:KEPT]
            for old in self.checkpoints:
                if old not in kept:
                    old.unlink()
            run_files.discard_previous(self.folder)

    def load_state(self) -> tuple[TrainingState, list[str]]:
        """Where to resume: the newest checkpoint that is whole.

        Returns:
            The state, and a note for each damaged checkpoint that was skipped.

        Raises:
            InputError: There is none, or it is not of this run's configuration.
        """
        config = self.read_config().train
        if not self.checkpoints and self.results:
            raise InputError(
                f"{self.folder} has finished and keeps its field alone, from which no training "
                "resumes; look at it by view, render, eval or export, or, to train it for longer, "
                f"train again with --keep checkpoint --output {self.folder} --overwrite."
            )
        if not self.checkpoints:
            raise InputError(
                f"{self.folder} holds no checkpoint to resume from{self._aside()}; train again "
                "with "
                f"--output {self.folder} --overwrite."
            )
        path, state, notes = _first_whole(self.checkpoints, load_checkpoint)
        for name, here, there in differences(state.decided(config), state.config):
            if name in MAY_GROW:
                continue  # it was saved before they were raised
            raise InputError(
                f"{self.folder / 'config.json'}: train.{name} is {here}, but {path.name} was saved "
                f"with {there}; correct it there, or train again."
            )
        return state, notes

    def extend(self, config: TrainConfig) -> None:
        """Let config.json say for how long a run is trained that is resumed for longer.

        Its field is removed: the checkpoint that it is resumed from holds it.

        Args:
            config: With which it is resumed.

        Raises:
            InputError: It cannot be written.
        """
        longer = {name: getattr(config, name) for name in MAY_GROW}
        with self._writing():
            # First: a field beside a longer training would be taken for what that came to.
            (self.folder / "field.safetensors").unlink(missing_ok=True)
            run_files.change_config(self.folder, lambda content: content["train"].update(longer))

    def set_keep(self, keep: Keep) -> None:
        """Let config.json say what is kept of a run that is resumed with another --keep.

        Raises:
            InputError: It cannot be written.
        """
        with self._writing():
            run_files.change_config(self.folder, lambda content: content.update(keep=keep))

    def open_log(self, kind: LogKind) -> Log:
        """Begin a log besides log.jsonl, or continue one.

        Args:
            kind: csv, tensorboard or wandb.

        Raises:
            InputError: It cannot be written, or its package is not installed.
        """
        with self._writing():
            reports = read_reports(self.folder / "log.jsonl")
            config = json.loads((self.folder / "config.json").read_bytes())
            return open_log(kind, self.folder, reports, config)

    def write_to(self, log: Log, progress: Progress) -> None:
        """Append a report to a log besides log.jsonl.

        Raises:
            InputError: It cannot be written.
        """
        with self._writing():
            log.write(progress)

    def draw_curves(self, name: str) -> None:
        """Draw curves.png, of all that log.jsonl has.

        Args:
            name: Of the scene.

        Raises:
            InputError: It cannot be written.
        """
        points = read_points(self.folder / "log.jsonl")
        if points:
            title = f"{name}: {points[-1].step} steps in {points[-1].seconds:.0f} s"
            with self._writing():
                write_png(self.folder / run_files.CURVES, curves(points, title))

    def rewind_log(self, step: int) -> None:
        """Drop reports of steps that will be done again, and a line that a crash cut off.

        The log becomes a file of its own: that of before may be in a copy of the folder as well,
        as a hard link.

        Raises:
            InputError: It cannot be written.
        """
        path = self.folder / "log.jsonl"
        with self._writing():
            if path.exists():
                write_atomically(path, rewound(path.read_bytes(), step))

    def discard_figures(self) -> None:
        """Remove metrics and pictures, before the field becomes another one.

        Raises:
            InputError: They cannot be removed.
        """
        with self._writing():
            run_files.discard_figures(self.folder)

    def remove_checkpoints(self) -> None:
        """Remove what the training could be resumed from; the field must be saved.

        Raises:
            InputError: They cannot be removed.
        """
        with self._writing():
            for path in self.checkpoints:
                path.unlink()

    def save_field(self, field: Field, keep_checkpoints: bool = True) -> None:
        """Write the field, in half precision.

        Args:
            field: The trained one.
            keep_checkpoints: Else they are removed once the field is written whole.

        Raises:
            InputError: It cannot be written; checkpoints are then left as they were.
        """
        with self._writing():
            run_files.sweep(self.folder)
            save_field(self.folder / "field.safetensors", field, "float16")
            run_files.discard_previous(self.folder)
            for path in [] if keep_checkpoints else self.checkpoints:
                path.unlink()

    def load_field(self, device: str, threads: int | None) -> tuple[Field, list[str]]:
        """Read the field, or that of the newest checkpoint if training is not done.

        Returns:
            The field, and a note for each damaged file that was skipped.

        Raises:
            InputError: There is none, or the device is missing.
        """
        if not self.results:
            raise InputError(
                f"{self.folder} holds no field: nothing was saved{self._aside()}; train it first."
            )
        _, loaded, notes = _first_whole(
            self.results[::-1], lambda p: load_field(p, device, threads)
        )
        return loaded, notes

    def evaluate(
        self,
        field: Field,
        scene: Scene,
        split: str,
        on_progress: Callable[[float, str], None] = lambda done, words: None,
        measures: bool | SurfaceVisibility = False,
    ) -> Evaluation:
        """Measure a split, and write metrics.json, its pictures, and a sheet of a few of them.

        All show depths in the same colours, over the range of the true depths where they are known
        for all views, else of what their cameras see. `on_progress` is called with the share
        that is done, in (0, 1], and what was last, in words. `measures` is that of ``evaluate``.

        Raises:
            InputError: They cannot be written.
        """
        return evaluate_into(self.folder, field, scene, split, self._writing, on_progress, measures)

    def read_metrics(self) -> dict[str, Any] | None:
        """What metrics.json says; None: there is none.

        Raises:
            InputError: It cannot be read.
        """
        path = self.folder / "metrics.json"
        return read_json(path, dict[str, Any]) if path.exists() else None

    def add_measures(self, measures: Measures) -> Path | None:
        """Add measures of the test views to metrics.json; nothing where there is none.

        Returns:
            The file, where there is one.

        Raises:
            InputError: It cannot be read or written.
        """
        metrics = self.read_metrics()
        if metrics is None:
            return None
        path = self.folder / "metrics.json"
        with self._writing():
            content = metrics | {"measures": measures.to_dict()}
            write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())
        return path

    def way_on(self) -> str:
        """How to resume, or that there is nothing to resume from: half a sentence."""
        if self.last_step is not None:
            return f"continue after step {self.last_step} with: {self.resume_command}"
        if self.results:
            return f"the field is saved; continue with: {self.resume_command}"
        return f"nothing was saved yet{self._aside()}"

    def _aside(self) -> str:
        """Where the run is that this one replaces, as long as it has saved nothing."""
        older = self.folder / run_files.PREVIOUS
        return f"; the run before is in {older}" if older.exists() else ""

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Name the folder and the way out where its files cannot be written."""
        try:
            yield
        except OSError as error:
            said = f"{self.folder} cannot be written: {error.strerror or error}; make room or give "
            if not self.results:
                raise InputError(f"{said}access, and begin again: {self.way_on()}.") from error
            then = "; " if self.last_step is None else ", then "
            raise InputError(f"{said}access{then}{self.way_on()}") from error


def _first_whole(paths: list[Path], load: Callable[[Path], T]) -> tuple[Path, T, list[str]]:
    """The first file that is not damaged, what it holds, and a note for each before it."""
    *newer, oldest = paths
    notes: list[str] = []
    for path in newer:
        try:
            return path, load(path), notes
        except DamagedFileError:
            notes.append(f"{path} is damaged; the checkpoint before it is used instead")
    return oldest, load(oldest), notes
