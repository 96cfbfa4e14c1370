"""A run's folder: what was asked for, how it went, what came out.

config.json                  scene, downscale, masks, content distance used, training configuration
log.jsonl                    a line for each progress report
checkpoint-*.safetensors     the training after so many steps; the last two are kept
field.safetensors            the trained field
metrics.json                 figures of the test views
test.png                     a few test views, to look at first: truth, rendering, depth, PSNR
test/                        truth, rendering and depth of each test view, side by side
scene/                       photographs with the poses that were estimated, where they had none
.lock                        while a training writes here
next/scene/                  the same, until the run that it is made for begins
previous/                    a run that was replaced, until this one has saved something
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from warpnerf.checks import InputError, cannot_write
from warpnerf.config import TrainConfig
from warpnerf.evaluation.evaluate import Evaluation, evaluate
from warpnerf.media.contact_sheet import SheetRow, contact_sheet, spread
from warpnerf.media.filming import depth_range, range_of
from warpnerf.media.pictures import comparison, picture_files, write_png
from warpnerf.rendering.field import Field, Rendering
from warpnerf.scenes.scene import Scene, View, require_split
from warpnerf.sfm.scene_files import (
    IN_RUN,
    NEXT_IN_RUN,
    copy_written,
    move_into,
    read_record,
    remove_posed,
)
from warpnerf.training import lock
from warpnerf.training.checkpoint import (
    load_checkpoint,
    load_field,
    save_checkpoint,
    save_field,
)
from warpnerf.training.run_config import RunConfig, describe, read_run_config
from warpnerf.training.state import Progress, TrainingState, differences
from warpnerf.training.tensor_file import DamagedFileError
from warpnerf.writing import write_atomically

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
        """How to go on."""
        return f"warpnerf train --resume {shlex.quote(str(self.folder))}"

    @property
    def checkpoints(self) -> list[Path]:
        """The checkpoints in the folder, the newest first."""
        found = self.folder.glob("checkpoint-????????.safetensors")
        return sorted((path for path in found if _step_of(path).isdigit()), reverse=True)

    @property
    def results(self) -> list[Path]:
        """Checkpoints and field in the folder, the furthest last."""
        field = self.folder / "field.safetensors"
        return [*reversed(self.checkpoints), *([field] if field.exists() else [])]

    @property
    def sheet(self) -> Path:
        """The picture of a few test views."""
        return self.folder / "test.png"

    @property
    def last_step(self) -> int | None:
        """The step of the newest checkpoint; None where there is none."""
        return int(_step_of(self.checkpoints[0])) if self.checkpoints else None

    @staticmethod
    def require_free(folder: str | Path, overwrite: bool) -> None:
        """Raise InputError unless a new run may be written to a folder.

        Raises:
            InputError: It is a file, or holds files that must not or may not be replaced.
        """
        path = Path(folder)
        if path.exists() and not path.is_dir():
            raise InputError(f"--output {path} is a file; name a folder.")
        if not path.exists() or not any(map(_counts, path.iterdir())):
            return
        run = Run(path)
        try:
            run.read_config()
        except InputError:
            raise InputError(f"--output {path} holds other files; name a new folder.") from None
        # One that ended before it saved anything is begun anew.
        if not overwrite and (run.results or (path / "previous").exists()):
            ways = f"go on with it by --resume {path}, " if run.checkpoints else ""
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
    ) -> None:
        """Make the folder and write its configuration; an older run's files go to previous/.

        A scene that waits in next/ is put in its place if it is the source, and else removed.

        Raises:
            InputError: The folder cannot be made or written to.
        """
        stored = self._stored(source)
        content = describe(scene, stored, downscale, content_distance, config, masks, found)
        try:
            (self.folder / "test").mkdir(parents=True, exist_ok=True)
            self._set_aside(in_use=Path(source))
            text = json.dumps(content, indent=2) + "\n"
            write_atomically(self.folder / "config.json", text.encode())
            waiting = self.folder / NEXT_IN_RUN
            if stored == IN_RUN and _same(source, waiting):
                move_into(waiting, self.folder / IN_RUN)
            remove_posed(waiting)
            with suppress(OSError):  # not empty, or not there
                waiting.parent.rmdir()
        except OSError as error:
            raise cannot_write(f"--output {self.folder}", error) from error

    def read_config(self) -> RunConfig:
        """What ``create`` wrote.

        Raises:
            InputError: The folder holds no run.
        """
        path = self.folder / "config.json"
        if not path.exists():
            raise InputError(f"{path} does not exist; name the folder of a run.")
        config = read_run_config(path)
        if config.scene.startswith("builtin:"):
            return config
        return msgspec.structs.replace(config, scene=str(self.folder / config.scene))

    def log(self, progress: Progress) -> None:
        """Append a report to log.jsonl.

        Raises:
            InputError: It cannot be written.
        """
        with self._writing(), (self.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(asdict(progress)) + "\n")

    def save_checkpoint(self, state: TrainingState) -> None:
        """Write a checkpoint beside the last one; older ones are then removed.

        Raises:
            InputError: It cannot be written; those before are left as they were.
        """
        path = self.folder / f"checkpoint-{state.progress.step:08}.safetensors"
        with self._writing():
            self._sweep()
            save_checkpoint(path, state)
            # One of a later step is there only if it was damaged, and training resumed before it.
            kept = [p for p in self.checkpoints if p.name <= path.name][:KEPT]
            for old in self.checkpoints:
                if old not in kept:
                    old.unlink()
            self._discard_previous()

    def load_state(self) -> tuple[TrainingState, list[str]]:
        """Where to go on: the newest checkpoint that is whole.

        Returns:
            The state, and a note for each damaged checkpoint that was passed over.

        Raises:
            InputError: There is none, or it is not of this run's configuration.
        """
        config = self.read_config().train
        if not self.checkpoints:
            raise InputError(
                f"{self.folder} holds no checkpoint to go on from; train anew with --output "
                f"{self.folder} --overwrite."
            )
        path, state, notes = _first_whole(self.checkpoints, load_checkpoint)
        for name, here, there in differences(config, state.config):
            raise InputError(
                f"{self.folder / 'config.json'}: train.{name} is {here}, but {path.name} was saved "
                f"with {there}; correct it there, or train anew."
            )
        return state, notes

    def rewind_log(self, step: int) -> None:
        """Drop reports of steps that will be done again, and a line that a crash cut off.

        Raises:
            InputError: It cannot be written.
        """
        path = self.folder / "log.jsonl"
        with self._writing():
            lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
            kept = [line for line in lines if _reported_step(line) <= step]
            if kept != lines:
                write_atomically(path, b"".join(kept))

    def save_field(self, field: Field) -> None:
        """Write the field.

        Raises:
            InputError: It cannot be written.
        """
        with self._writing():
            self._sweep()
            save_field(self.folder / "field.safetensors", field)
            self._discard_previous()

    def load_field(self, device: str, threads: int | None) -> tuple[Field, list[str]]:
        """Read the field, or that of the newest checkpoint if training is not done.

        Returns:
            The field, and a note for each damaged file that was passed over.

        Raises:
            InputError: There is none, or the device is missing.
        """
        if not self.results:
            raise InputError(f"{self.folder} holds no field: nothing was saved; train it first.")
        _, loaded, notes = _first_whole(
            self.results[::-1], lambda p: load_field(p, device, threads)
        )
        return loaded, notes

    def evaluate(self, field: Field, scene: Scene, split: str) -> Evaluation:
        """Measure a split, and write metrics.json, its pictures, and a sheet of a few of them.

        All show depths in the same colours, over the range of the true depths where they are known
        for all views, else of what their cameras see.

        Raises:
            InputError: They cannot be written.
        """
        views = [scene.views[index] for index in require_split(scene, split)]
        files = picture_files([view.name for view in views])
        depths = (view.depth for view in views)
        known = [depth[np.isfinite(depth)] for depth in depths if depth is not None]
        if len(known) == len(views) and any(depth.size for depth in known):
            near, far = range_of(np.concatenate(known))
        else:
            near, far = depth_range(field, [view.camera for view in views])
        on_sheet = {views[index].name for index in spread(len(views))}
        seen: dict[str, tuple[View, np.ndarray, Rendering]] = {}

        def picture(view: View, target: np.ndarray, rendering: Rendering) -> None:
            path = self.folder / "test" / files[view.name]
            with self._writing():
                write_png(path, comparison(target, rendering, near, far, view.mask))
            if view.name in on_sheet:
                seen[view.name] = view, target, rendering

        with self._writing():
            (self.folder / "test").mkdir(exist_ok=True)
        result = evaluate(field, scene, split, picture)
        rows = [
            SheetRow(
                name=image.name,
                psnr=image.psnr,
                target=seen[image.name][1],
                rendering=seen[image.name][2],
                depth=seen[image.name][0].depth,
                mask=seen[image.name][0].mask,
            )
            for image in result.images
            if image.name in seen
        ]
        kind = "training" if split == "train" else split
        title = f"{scene.name}: {len(rows)} of {len(views)} {kind} views"
        if split == "train" and not scene.splits.get("test"):
            title += ", as there are no test views"
        with self._writing():
            write_png(self.sheet, contact_sheet(rows, title, near, far))
            write_atomically(self.folder / "metrics.json", result.to_json().encode())
        return result

    def way_on(self) -> str:
        """How to go on, or that there is nothing to go on from: half a sentence."""
        if self.last_step is None:
            older = self.folder / "previous"
            aside = f"; the run before is in {older}" if older.exists() else ""
            return f"nothing was saved yet{aside}"
        return f"go on after step {self.last_step} with: {self.resume_command}"

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Name the folder and the way out where its files cannot be written."""
        try:
            yield
        except OSError as error:
            said = f"{self.folder} cannot be written: {error.strerror or error}; make room or give "
            if self.last_step is None:
                raise InputError(f"{said}access, and begin anew: {self.way_on()}.") from error
            raise InputError(f"{said}access, then {self.way_on()}") from error

    def _sweep(self) -> None:
        """Remove what processes left behind that were killed while saving."""
        for path in self.folder.glob(".*.tmp"):
            if re.fullmatch(r"\..+\.(json|jsonl|png|safetensors)\.\d+\.tmp", path.name):
                path.unlink()

    def _by_products(self) -> list[Path]:
        """What else a run writes, but its configuration."""
        files = [self.folder / "log.jsonl", self.folder / "metrics.json", self.sheet]
        files += [self.folder / "test" / name for name in self._pictures()]
        return [path for path in files if path.exists()]

    def _pictures(self) -> list[str]:
        """File names of the pictures that the run may have written to test/."""
        try:
            listed = self.read_config().pictures
        except InputError:
            return []
        if listed is not None:
            return [name for name in listed if Path(name).name == name]
        return [path.name for path in (self.folder / "test").glob("*.png")]

    def _stored(self, source: str) -> str:
        """A scene's place as config.json has it, so that a run can be moved with its scene."""
        if source.startswith("builtin:"):
            return source
        if _same(source, self.folder / NEXT_IN_RUN):
            return IN_RUN
        path, root = Path(source).resolve(), self.folder.resolve()
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)

    def _own_scene(self) -> Path | None:
        """The posed scene in the folder; None where there is none, or the run is not of it."""
        scene = self.folder / IN_RUN
        try:
            return scene if _same(self.read_config().scene, scene) and read_record(scene) else None
        except InputError:
            return None

    def _set_aside(self, in_use: Path) -> None:
        """Move an older run to previous/, so that at any moment one of the two folders is whole.

        Args:
            in_use: What the new run is made of; stays, even if it is the older one's scene.
        """
        self._sweep()
        scene = self._own_scene()
        if self.results:
            self._discard_previous()
            older = self.folder / "previous"
            (older / "test").mkdir(parents=True, exist_ok=True)
            write_atomically(older / "config.json", (self.folder / "config.json").read_bytes())
            record = None if scene is None else read_record(scene)
            if scene is not None and record is not None:
                copy_written(scene, record, older / IN_RUN)
            for path in [*self.results, *self._by_products()]:
                path.replace(older / path.relative_to(self.folder))
        else:
            for path in self._by_products():
                path.unlink()
        if scene is not None and not _same(in_use, scene):
            remove_posed(scene)

    def _discard_previous(self) -> None:
        """Remove what ``_set_aside`` put aside, but nothing that others put there."""
        older = Run(self.folder / "previous")
        if older.folder.exists():
            older._sweep()
            for path in [*older._by_products(), *older.results]:
                path.unlink()
            scene = older._own_scene()
            if scene is not None:
                remove_posed(scene)
            (older.folder / "config.json").unlink(missing_ok=True)
            for folder in (older.folder / "test", older.folder):
                with suppress(OSError):  # not empty
                    folder.rmdir()


def _counts(path: Path) -> bool:
    """Whether a file or folder of an output folder is more than an attempt to begin leaves."""
    if path.name == lock.NAME:
        return False
    if path.name == IN_RUN and read_record(path) is not None:
        return False
    if path.name == Path(NEXT_IN_RUN).parent.name and path.is_dir():
        return any(map(_counts, path.iterdir()))
    if re.fullmatch(rf"\.{IN_RUN}\.\d+\.tmp", path.name):
        return False
    return not (path.name == "test" and path.is_dir() and not any(path.iterdir()))


def _same(path: str | Path, other: Path) -> bool:
    return Path(path).resolve() == other.resolve()


def _step_of(checkpoint: Path) -> str:
    return checkpoint.stem.removeprefix("checkpoint-")


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


class _Report(msgspec.Struct):
    """A line of log.jsonl, as far as it is read again."""

    step: int


def _reported_step(line: bytes) -> float:
    """The step of a report; infinity where a line is none."""
    try:
        return msgspec.json.decode(line, type=_Report).step
    except msgspec.DecodeError:
        return float("inf")
