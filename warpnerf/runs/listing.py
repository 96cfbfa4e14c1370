"""All runs in a folder: how far each is, its metrics, its disk usage, and its configuration."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_to_json
from warpnerf.presets import PRESETS
from warpnerf.runs import files, lock
from warpnerf.runs.config import RunConfig
from warpnerf.runs.names import scene_name
from warpnerf.runtime.terminal import table_text
from warpnerf.scenes.files import exists, printable, require_regular_file
from warpnerf.sfm.scene_files import IN_RUN, read_record

DEPTH = 3
"""Folders within folders in which runs are looked for."""
LEFT_OUT = ("steps", "time_limit", "device", "threads", "checkpoint_every")
"""Fields of a configuration that are not listed."""
METRICS = {"psnr": ("PSNR", ".2f"), "ssim": ("SSIM", ".4f"), "flip": ("FLIP", ".4f")}
"""Heading and format of the metrics of test views that are listed."""


class Report(msgspec.Struct, frozen=True):
    """A line of log.jsonl, as far as it is listed."""

    step: int = 0
    fraction: float = 0.0
    seconds: float = 0.0


class Metrics(msgspec.Struct, frozen=True):
    """metrics.json, as far as it is listed."""

    split: str = "test"
    mean: dict[str, float] = {}
    images: list[msgspec.Raw] = []


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """A run: progress, metrics of its test views, configuration and disk usage."""

    folder: Path
    """Of the run."""
    config: RunConfig
    """What was requested."""
    step: int
    """Of the last report or checkpoint; 0: there is none."""
    fraction: float
    """Of the training that is done, [0, 1]."""
    seconds: float
    """Of training."""
    metrics: Mapping[str, float]
    """Means over the views that were measured, by name; empty: none were."""
    split: str
    """Which these are: test, or train of a run without test views."""
    n_views: int
    """Over how many views; 0: none, or it is not known."""
    n_bytes: int
    """Of all its files."""

    @property
    def is_finished(self) -> bool:
        """Whether the training is at its end and its field is there."""
        return self.fraction >= 1.0 and (self.folder / "field.safetensors").exists()


def runs_in(folder: Path) -> list[RunSummary]:
    """Summaries of the runs in a folder, by name.

    Args:
        folder: Of a run, or of folders of runs.

    Raises:
        InputError: It is no folder, or holds no run.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; name one that holds runs.")
    found = []
    for place in _candidates(folder):
        with suppress(InputError):  # of another program, or damaged
            found.append(_summary(place))
    if not found:
        damaged = damaged_in(folder)
        if damaged:
            why = next(iter(damaged.values()))
            raise InputError(f"{folder} holds no run that can be read: {why}")
        raise InputError(f"{folder} holds no run; name a folder that holds runs.")
    return sorted(found, key=lambda run: run.folder)


def damaged_in(folder: Path) -> dict[Path, str]:
    """Folders that hold what a run has saved, but whose config.json cannot be read, and why.

    Args:
        folder: As of ``runs_in``.
    """
    found = {}
    for place in _candidates(folder):
        try:
            files.read_config(place)
        except InputError as error:
            if files.results(place):
                found[place] = str(error)
    return found


def _candidates(folder: Path) -> list[Path]:
    """Folders that have a config.json, but for runs that wait in another one's previous/."""
    places = [
        path.parent
        for depth in range(DEPTH)
        for path in sorted(folder.glob("*/" * depth + "config.json"))
    ]
    return [place for place in places if place == folder or _around(place) is None]


def _around(folder: Path) -> Path | None:
    """The run in whose previous/ a run lies; None where it lies in none."""
    folder = folder.resolve()
    waits = folder.name == files.PREVIOUS and exists(folder.parent / "config.json")
    return folder.parent if waits else None


def in_words(config: TrainConfig) -> str:
    """A configuration as the preset that it is nearest to, and what is changed of that.

    Args:
        config: Any. How long it trains and on what is left out.

    Returns:
        Such as ``fast grid.voxels=8000000``.
    """
    changes = {preset: _changes(config, begin) for preset, begin in PRESETS.items()}
    preset = min(changes, key=lambda name: len(changes[name]))
    return " ".join([preset, *(f"{name}={_said(v)}" for name, v in changes[preset].items())])


def remove_checkpoints(run: RunSummary) -> int:
    """Remove the checkpoints of a finished run, and what exports keep; its field stays.

    Args:
        run: Any; one that is not finished is left alone.

    Returns:
        Bytes that were removed.

    Raises:
        InputError: Another process trains into its folder, or they cannot be removed.
    """
    if not run.is_finished:
        return 0
    n_bytes = 0
    with lock.only_writer(_around(run.folder) or run.folder):
        if not _summary(run.folder).is_finished:  # another one has begun there meanwhile
            return 0
        for path in [*files.checkpoints(run.folder), run.folder / files.VISIBILITY]:
            if path.is_dir():  # none of the run's, whatever its name
                continue
            with suppress(FileNotFoundError):
                size = path.stat().st_size
                path.unlink()
                n_bytes += size
    return n_bytes


def runs_table(runs: Sequence[RunSummary], folder: Path) -> str:
    """A table with a line for each run, and at its end how it is configured."""
    metrics = {k: how for k, how in METRICS.items() if any(k in run.metrics for run in runs)}
    headings = ["run", "scene", "steps", "done", "time"]
    headings += [*(["views"] if metrics else []), *(name for name, _ in metrics.values())]
    rows = []
    for run in runs:
        name = printable(run.folder.relative_to(folder).as_posix())
        minutes, seconds = divmod(round(run.seconds), 60)
        found = [
            format(run.metrics[key], how) if key in run.metrics else ""
            for key, (_, how) in metrics.items()
        ]
        if metrics:
            kind = " train" if run.split == "train" else ""
            found.insert(0, f"{run.n_views}{kind}" if run.n_views else "")
        rows.append(
            [
                printable(folder.resolve().name) if name == "." else name,
                printable(_scene_of(run)),
                str(run.step),
                f"{run.fraction:.0%}",
                f"{minutes}:{seconds:02}",
                *found,
                f"{run.n_bytes / 1e6:.0f} MB",
            ]
        )
    lines = table_text([*headings, "disk"], rows).splitlines()
    configured = ["configuration", *(in_words(run.config.train) for run in runs)]
    return "\n".join(f"{a}  {b}" for a, b in zip(lines, configured, strict=True))


def _summary(folder: Path) -> RunSummary:
    config = files.read_config(folder)
    last, metrics = last_report(folder), Metrics()
    with suppress(msgspec.MsgspecError):
        metrics = msgspec.json.decode(_content(folder / "metrics.json"), type=Metrics)
    return RunSummary(
        folder=folder,
        config=config,
        step=last.step,
        fraction=last.fraction,
        seconds=last.seconds,
        metrics=metrics.mean,
        split=metrics.split,
        n_views=len(metrics.images),
        n_bytes=_disk_usage(folder),
    )


def _disk_usage(folder: Path) -> int:
    """Bytes of a folder's files, without photographs that lie elsewhere too, as hard links.

    A training may remove files meanwhile.
    """
    total = 0
    for place, _, names in os.walk(folder):
        in_scene = IN_RUN in Path(place).relative_to(folder).parts
        for name in names:
            with suppress(OSError):
                state = os.lstat(os.path.join(place, name))  # noqa: PTH118, many files
                total += 0 if in_scene and state.st_nlink > 1 else state.st_size
    return total


def _scene_of(run: RunSummary) -> str:
    """What the scene of a run is called; one that lies in the run, by what it was made of."""
    source = run.config.scene
    if Path(source) == run.folder / IN_RUN:
        with suppress(InputError):
            record = read_record(Path(source))
            source = str(record.made_of.get("source", source)) if record is not None else source
    return scene_name(source)


def last_report(folder: Path) -> Report:
    """The last line of a run's log that is whole, as a crash may have cut one off; with the step of
    its newest checkpoint where that is a later one."""
    saved = max(map(files.step_of, files.checkpoints(folder)), default=0)
    for line in reversed(_content(folder / "log.jsonl").splitlines()):
        with suppress(msgspec.MsgspecError):
            report = msgspec.json.decode(line, type=Report)
            return msgspec.structs.replace(report, step=max(report.step, saved))
    return Report(step=saved)


def _content(path: Path) -> bytes:
    """What a file holds; nothing where it cannot be read, or a pipe or device is in its place."""
    with suppress(OSError, InputError):
        require_regular_file(path)
        return path.read_bytes()
    return b""


def _changes(config: TrainConfig, begin: TrainConfig) -> dict[str, Any]:
    """What is configured differently, by dotted name; a part of another kind by what is not its
    default."""
    before = _flat(begin)
    for part in ("model", "field", "sampler"):
        kind = type(getattr(config, part))
        if kind is not type(getattr(begin, part)):
            before |= {f"{part}.{name}": value for name, value in asdict(kind()).items()}
    return {name: value for name, value in _flat(config).items() if value != before.get(name)}


def _flat(config: TrainConfig) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in config_to_json(config).items():
        if isinstance(value, dict):  # a part, which is named if there are several kinds of it
            found |= {f"{name}.{inner}".removesuffix(".name"): v for inner, v in value.items()}
        elif name not in LEFT_OUT:
            found[name] = value
    return found


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value).replace(" ", "") if isinstance(value, list | tuple) else str(value)
