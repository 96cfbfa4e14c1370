"""Experiment logs of a run besides log.jsonl: CSV, TensorBoard, Weights & Biases."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec

from warpnerf.checks import InputError
from warpnerf.media.curves import CurvePoint
from warpnerf.training.state import Progress
from warpnerf.writing import open_to_append, write_atomically

LogKind = Literal["csv", "tensorboard", "wandb"]

CSV = "log.csv"
"""The file of ``csv``, in the run's folder."""
TENSORBOARD = "tensorboard"
"""The folder of ``tensorboard`` there."""
EVENTS = "events.out.tfevents.*"
"""Its files."""
COLUMNS = ("step", "seconds", "fraction", "loss", "psnr", "test_psnr", "samples_per_ray")
"""Of the table."""


class Log(Protocol):
    """Where reports of a training are written."""

    def write(self, progress: Progress) -> None:
        """Write a report."""

    def close(self, metrics: Mapping[str, float]) -> None:
        """End it, with the mean metrics of the test views, where these were measured."""


def open_log(
    kind: LogKind, folder: Path, reports: Sequence[Mapping[str, Any]], config: dict[str, Any]
) -> Log:
    """Begin a log, or continue that of a run that is resumed.

    Args:
        kind: csv, tensorboard or wandb.
        folder: Of the run.
        reports: Those so far, as log.jsonl has them.
        config: What is trained how, as config.json has it.

    Raises:
        InputError: Its package does not begin a log.
        OSError: The file cannot be written.
    """
    if kind == "csv":
        return CsvLog(folder / CSV, reports)
    try:
        if kind == "tensorboard":
            return TensorboardLog(folder / TENSORBOARD, reports)
        return WandbLog(folder, reports, config)
    except Exception as error:
        way_out = "make room or give access there"
        if kind == "wandb":
            way_out = "log in by `wandb login`, or set WANDB_MODE=offline"
        said = " ".join(str(error).split())[:200]
        raise InputError(f"--log {kind} does not begin ({said}); {way_out}.") from error


class CsvLog:
    """A table with a line for each report."""

    def __init__(self, path: Path, reports: Sequence[Mapping[str, Any]]) -> None:
        """Write the lines so far; what a resumed training does again is dropped."""
        self._path = path
        # A file of its own: that of before may have another name as well, as a hard link.
        write_atomically(path, (",".join(COLUMNS) + "\n" + "".join(map(_line, reports))).encode())

    def write(self, progress: Progress) -> None:
        """Append a line."""
        with open_to_append(self._path) as file:
            file.write(_line(vars(progress)).encode())

    def close(self, metrics: Mapping[str, float]) -> None:
        """All is written already."""


class TensorboardLog:
    """Scalars for TensorBoard."""

    def __init__(self, folder: Path, reports: Sequence[Mapping[str, Any]]) -> None:
        """Begin a file of events, which replaces those of later steps."""
        from tensorboardX import SummaryWriter

        first = reports[-1]["step"] + 1 if reports else 0
        self._writer = SummaryWriter(str(folder), purge_step=first)
        self._step = first

    def write(self, progress: Progress) -> None:
        """Add a scalar for each number."""
        self._step = progress.step
        for name, value in scalars(vars(progress)).items():
            self._writer.add_scalar(name, value, progress.step)
        self._writer.flush()

    def close(self, metrics: Mapping[str, float]) -> None:
        """Add the metrics at the last step."""
        for name, value in metrics.items():
            self._writer.add_scalar(f"final/{name}", value, self._step)
        self._writer.close()


class WandbLog:
    """A run of Weights & Biases, in its project warpnerf unless WANDB_PROJECT says otherwise."""

    def __init__(
        self, folder: Path, reports: Sequence[Mapping[str, Any]], config: dict[str, Any]
    ) -> None:
        """Begin a run, with the reports so far."""
        import wandb

        project = os.environ.get("WANDB_PROJECT", "warpnerf")
        self._run = wandb.init(project=project, name=folder.resolve().name, config=config)
        for report in reports:
            self._run.log(scalars(report), step=report["step"])

    def write(self, progress: Progress) -> None:
        """Log the numbers."""
        self._run.log(scalars(vars(progress)), step=progress.step)

    def close(self, metrics: Mapping[str, float]) -> None:
        """Put the metrics into its summary."""
        self._run.summary.update({f"final/{name}": value for name, value in metrics.items()})
        self._run.finish()


def scalars(report: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of a report, by the tags under which they are plotted."""
    found = {f"train/{name}": report[name] for name in ("loss", "psnr", "seconds", "occupied")}
    if report.get("test_psnr") is not None:
        found["test/psnr"] = report["test_psnr"]
    return found


def read_reports(log: Path) -> list[dict[str, Any]]:
    """Reports of log.jsonl that are whole, with what a report has today."""
    if not log.exists():
        return []
    found = []
    for line in log.read_bytes().splitlines():
        try:
            report = json.loads(line)
        except (ValueError, RecursionError):  # cut off
            continue
        if isinstance(report, dict):
            whole = {"occupied": 1.0, "seen": 1.0, "test_psnr": None} | report
            if _is_report(whole):
                found.append(whole)
    return found


def read_points(log: Path) -> list[CurvePoint]:
    """What curves show of the reports of log.jsonl, over whole pictures."""
    return [
        CurvePoint(
            step=report["step"],
            seconds=report["seconds"],
            loss=report["loss"] * report["seen"],  # rays that are not drawn have none
            psnr=report["psnr"] - 10.0 * math.log10(report["seen"]),
            test_psnr=report["test_psnr"],
        )
        for report in read_reports(log)
    ]


def rewound(log: bytes, step: int) -> bytes:
    """The content of log.jsonl without reports of later steps, and without a line that a crash cut
    off."""
    lines = log.splitlines(keepends=True)
    return b"".join(line for line in lines if _reported_step(line) <= step)


class _Step(msgspec.Struct):
    """A line of log.jsonl, as far as a resumed training reads it."""

    step: int


def _reported_step(line: bytes) -> float:
    """The step of a report; infinity where a line is none."""
    try:
        return msgspec.json.decode(line, type=_Step).step
    except msgspec.DecodeError:
        return float("inf")


def _is_report(report: Mapping[str, Any]) -> bool:
    """Whether a line of log.jsonl, which anybody may have edited, holds a report's numbers."""
    numbers: list[Any] = [
        report.get(name) for name in ("seconds", "loss", "psnr", "occupied", "seen")
    ]
    if report["test_psnr"] is not None:
        numbers.append(report["test_psnr"])
    step = report.get("step")
    return (
        type(step) is int
        and 0 <= step < 2**63
        and all(type(number) in (int, float) and abs(number) < 1e30 for number in numbers)
        and report["seen"] > 0.0
    )


def _line(report: Mapping[str, Any]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow([report.get(name) for name in COLUMNS])
    return text.getvalue()
