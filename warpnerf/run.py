"""A run's folder: what was asked for, how it went, what came out.

config.json         scene, downscale, content distance used, training configuration
log.jsonl           a line for each progress report
field.safetensors   the trained field
metrics.json        figures of the test views
test/               truth, rendering and depth of each test view, side by side
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.checkpoint import load_field, save_field, write_atomically
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.evaluation import Evaluation, evaluate
from warpnerf.field import Field, Rendering
from warpnerf.pictures import comparison, picture_files, write_png
from warpnerf.scene import Scene, View, require_split
from warpnerf.training import Progress

_OWN = ("config.json", "log.jsonl", "field.safetensors", "metrics.json")


class Run:
    """The folder of one training run."""

    def __init__(self, folder: str | Path) -> None:
        """Name a folder; nothing is read or written yet."""
        self.folder = Path(folder)

    @staticmethod
    def require_free(folder: str | Path, overwrite: bool) -> None:
        """Raise InputError unless a new run may be written to a folder.

        Raises:
            InputError: It is a file, or holds files that must not or may not be replaced.
        """
        path = Path(folder)
        if path.exists() and not path.is_dir():
            raise InputError(f"--output {path} is a file; name a folder.")
        if not path.exists() or not any(path.iterdir()):
            return
        try:
            Run(path).read_config()
        except InputError:
            raise InputError(f"--output {path} holds other files; name a new folder.") from None
        if not overwrite:
            raise InputError(
                f"--output {path} holds a run already; name another folder, or add --overwrite."
            )

    def create(
        self,
        scene: Scene,
        source: str,
        downscale: int,
        content_distance: float,
        config: TrainConfig,
    ) -> None:
        """Make the folder and write its configuration; an older run's files are removed.

        Raises:
            InputError: The folder cannot be made or written to.
        """
        try:
            (self.folder / "test").mkdir(parents=True, exist_ok=True)
            for name in _OWN:
                (self.folder / name).unlink(missing_ok=True)
            for picture in (self.folder / "test").glob("*.png"):
                picture.unlink()
            self._write_json(
                "config.json",
                {
                    "scene": source,
                    "downscale": downscale,
                    "content_distance": content_distance,
                    "box_min": scene.box_min.tolist(),
                    "box_max": scene.box_max.tolist(),
                    "notes": [*scene.warnings, *scene.notes],
                    "train": asdict(config),
                },
            )
        except OSError as error:
            raise InputError(
                f"--output {self.folder} cannot be written: {error.strerror}."
            ) from error

    def read_config(self) -> dict[str, Any]:
        """What ``create`` wrote.

        Raises:
            InputError: The folder holds no run.
        """
        path = self.folder / "config.json"
        try:
            config = json.loads(path.read_text())
            _ = config["train"], config["content_distance"]
            return {"scene": str(config["scene"]), "downscale": int(config["downscale"])}
        except OSError as error:
            raise InputError(
                f"{path} cannot be read ({error.strerror}); name the folder of a run."
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is not a run's configuration ({error}).") from error

    def log(self, progress: Progress) -> None:
        """Append a report to log.jsonl."""
        with (self.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(asdict(progress)) + "\n")

    def save_field(self, field: Field) -> None:
        """Write the field."""
        save_field(self.folder / "field.safetensors", field)

    def load_field(self, device: str, threads: int | None) -> Field:
        """Read the field; see ``warpnerf.load_field``."""
        return load_field(self.folder / "field.safetensors", device, threads)

    def evaluate(self, field: Field, scene: Scene, split: str, far: float) -> Evaluation:
        """Measure a split, and write metrics.json and the pictures, depth in colour up to far."""
        files = picture_files([scene.views[index].name for index in require_split(scene, split)])

        def picture(view: View, target: np.ndarray, rendering: Rendering) -> None:
            path = self.folder / "test" / files[view.name]
            write_png(path, comparison(target, rendering, 0.0, far))

        result = evaluate(field, scene, split, picture)
        write_atomically(self.folder / "metrics.json", result.to_json().encode())
        return result

    def _write_json(self, name: str, content: dict[str, Any]) -> None:
        write_atomically(self.folder / name, (json.dumps(content, indent=2) + "\n").encode())
