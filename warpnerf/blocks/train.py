"""Training blocks: each is a job of its own, which is resumed wherever it was left."""

from __future__ import annotations

import json
import shlex
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from warpnerf.blocks.engines import Engine, Work
from warpnerf.blocks.folder import OPTIONS, BlockFolder
from warpnerf.checks import InputError, cannot_write
from warpnerf.runs import lock
from warpnerf.runs.listing import last_report
from warpnerf.runtime.signals import StopRequest
from warpnerf.scenes.files import exists, read_json
from warpnerf.writing import write_atomically

BEHIND, VIEWS = ("--contraction", "--grid.contraction"), ("--eval-views", "--eval_views")
OF_BLOCKS = {BEHIND: "linf", VIEWS: "none"}
"""Options of a block's training unless they are given, by their names: what its cameras see behind
its box is contracted, and test views are those of the whole."""

OWN = (
    *("--output", "--resume", "--config", "--overwrite", "--downscale", "--masks", "--split"),
    *("--view", "--host", "--port", "--threads", "--box", "--grid.box"),
)
"""Options of train that a block's training has by itself."""

TRIES = 5
"""Attempts at a block without a step of progress between them."""

POLL = 0.2
"""Seconds from one look at the jobs to the next."""

SHOW = 2.0
"""Seconds from one look at how far they are to the next."""

AGAIN = 2.0
"""Seconds before a lost job is begun again: what is left of it may still be saving."""


class StoredOptions(msgspec.Struct, frozen=True):
    """What train.json says."""

    options: list[str]
    """Of ``warpnerf train``, for all blocks."""


@dataclass(frozen=True, kw_only=True)
class BlockState:
    """How far a block is."""

    name: str
    photographs: int
    state: str
    """waiting, queued (given to the engine, but silent yet), training, done, stopped or failed."""
    step: int
    fraction: float
    """Of its training, [0, 1]."""
    seconds: float
    """Of training."""

    @property
    def row(self) -> list[str]:
        """Cells of a table with HEADINGS."""
        minutes, seconds = divmod(round(self.seconds), 60)
        done = f"{self.fraction:.0%}"
        time_taken = f"{minutes}:{seconds:02}"
        return [self.name, str(self.photographs), self.state, str(self.step), done, time_taken]


HEADINGS = ["block", "photographs", "state", "steps", "done", "time"]


def options_of(blocks: BlockFolder, given: Sequence[str]) -> list[str]:
    """The options that all blocks are trained with; kept in train.json.

    Args:
        blocks: The folder.
        given: Words of ``warpnerf train``; none: those of before.

    Raises:
        InputError: A block's training has such an option by itself, or blocks were begun with
            others.
    """
    path = blocks.folder / OPTIONS
    before = read_json(path, StoredOptions).options if exists(path) else None
    for where, words in (("", given), (f"{path}: $.options: ", before or ())):
        for name in (word.partition("=")[0] for word in words):
            if name in OWN:
                raise InputError(
                    f"{where}{name} is not an option for the training of blocks, which have their "
                    "own; leave it out."
                )
    if before is not None and (not given or list(given) == before):
        return before
    begun = blocks.begun
    if begun and before is not None:
        said = shlex.join(before) or "no options"
        raise InputError(
            f"{blocks.name(begun[0])} was begun with {said}, and all blocks of a scene are trained "
            "alike; leave the options out, or cut the scene into another folder."
        )
    try:
        write_atomically(path, json.dumps({"options": list(given)}).encode() + b"\n")
    except OSError as error:
        raise cannot_write(str(path), error) from error
    return list(given)


def work_of(blocks: BlockFolder, number: int, options: Sequence[str], threads: int) -> Work:
    """The job of a block: it begins, or it resumes from the last checkpoint.

    Args:
        blocks: The folder.
        number: Of the block.
        options: Of ``options_of``.
        threads: CPU threads.
    """
    run, config = blocks.run(number), blocks.config
    folder, part = run.folder.absolute(), str(blocks.part(number).absolute())
    if run.checkpoints:
        words = ["train", part, "--resume", str(folder), "--eval-views", "none"]
    else:
        words = ["train", part, "--output", str(folder)]
        words += ["--downscale", str(config.downscale), "--grid.box", "scene"]
        words += [] if config.masks is None else ["--masks", config.masks]
        given = {word.partition("=")[0] for word in options}
        for names, value in OF_BLOCKS.items():
            words += [] if given & {*names} else [names[0], value]
        words += options
    words += ["--threads", str(threads)]
    return Work(arguments=words, log=blocks.log(number).absolute())


class BlockTraining:
    """Trains blocks of a folder by an engine."""

    def __init__(
        self, blocks: BlockFolder, numbers: Sequence[int], options: Sequence[str], engine: Engine
    ) -> None:
        """Nothing is begun yet.

        Args:
            blocks: The folder.
            numbers: Of the blocks; those that are finished are left alone.
            options: Of ``options_of``.
            engine: Where they are trained.
        """
        self._blocks, self._numbers, self._options = blocks, numbers, options
        self._engine = engine
        self._waiting = [n for n in numbers if not blocks.is_finished(n)]
        self._running: dict[int, Any] = {}
        self._tries: Counter[int] = Counter()
        self._reached: dict[int, int] = {}
        self._said: dict[int, int] = {}
        self._not_before: dict[int, float] = {}
        self._waited_for: set[int] = set()
        self.failed: dict[int, str] = {}
        """Why blocks could not be trained, by number."""

    def states(self) -> list[BlockState]:
        """How far each block is."""
        return [self._state(number) for number in self._numbers]

    def run(self, say: Callable[[str], None], show: Callable[[list[BlockState]], None]) -> int:
        """Train until all blocks are finished, or a signal comes.

        Args:
            say: Is told what happens, a line each.
            show: Is shown the states now and then.

        Returns:
            0; 1 where blocks failed; 129, 130, 143 after SIGHUP, Ctrl-C, SIGTERM.

        Raises:
            InputError: The first attempt at a block was refused, and none was ever begun.
        """
        shown = 0.0
        with StopRequest() as stop:
            try:
                while (self._waiting or self._running) and not stop.asked:
                    self._begin(say)
                    self._look(say)
                    if time.monotonic() - shown > SHOW:
                        show(self.states())
                        shown = time.monotonic()
                    time.sleep(POLL)
            finally:
                if self._running:
                    say("stopping: blocks that are trained are saved")
                self._engine.stop(self._running.values())
                self._running.clear()
                show(self.states())
        if stop.exit_code is not None and self._waiting_or_unfinished():
            return stop.exit_code
        return 1 if self.failed else 0

    def _waiting_or_unfinished(self) -> bool:
        return not all(self._blocks.is_finished(n) for n in self._numbers if n not in self.failed)

    def _begin(self, say: Callable[[str], None]) -> None:
        """Start as many jobs as there is room for."""
        now = time.monotonic()
        ready = [n for n in self._waiting if self._not_before.get(n, 0.0) <= now]
        for number in ready:
            if len(self._running) >= self._engine.slots:
                return
            if lock.is_held(self._blocks.run(number).folder):
                self._wait(number, say)
                continue
            work = work_of(self._blocks, number, self._options, self._engine.threads)
            self._waiting.remove(number)
            self._tries[number] += 1
            self._reached[number] = self._step(number)
            self._said[number] = _size(work.log)
            try:
                self._running[number] = self._engine.start(work)
            except OSError as error:
                raise cannot_write(str(work.log), error) from error
            resumed = "--resume" in work.arguments
            say(f"{self._blocks.name(number)} {'resumes' if resumed else 'begins'}")

    def _wait(self, number: int, say: Callable[[str], None]) -> None:
        """Leave a block for a while to the process that still trains or saves it."""
        self._not_before[number] = time.monotonic() + AGAIN
        if number not in self._waited_for:
            say(f"{self._blocks.name(number)} is held by another process, which is waited for")
            self._waited_for.add(number)

    def _look(self, say: Callable[[str], None]) -> None:
        """See which jobs have ended, and how."""
        for number, job in list(self._running.items()):
            code = self._engine.ended(job)
            if code is None:
                continue
            del self._running[number]
            name = self._blocks.name(number)
            if self._blocks.is_finished(number):
                say(f"{name} is done")
                continue
            if self._step(number) > self._reached[number]:
                self._tries[number] = 1
            last = _last_line(self._blocks.log(number))
            refused = code == 2 and self._tries[number] == 1 and not self._step(number)
            if refused and not self._blocks.begun:  # so would be the others
                raise InputError(f"{name}: {last.removeprefix('warpnerf: error: ')}")
            if code in (0, 1) or refused or self._tries[number] >= TRIES:
                self.failed[number] = last
                say(f"{name} failed: {last}")
                continue
            say(f"{name} was lost; it is taken over")
            self._not_before[number] = time.monotonic() + AGAIN
            self._waiting.insert(0, number)

    def _step(self, number: int) -> int:
        """Of a block's newest checkpoint."""
        return self._blocks.run(number).last_step or 0

    def _state(self, number: int) -> BlockState:
        report = last_report(self._blocks.run(number).folder)
        if self._blocks.is_finished(number):
            state = "done"
        elif number in self.failed:
            state = "failed"
        elif number in self._running:
            silent = _size(self._blocks.log(number)) == self._said[number]
            state = "queued" if silent else "training"
        else:
            state = "stopped" if self._step(number) else "waiting"
        return BlockState(
            name=self._blocks.name(number),
            photographs=self._blocks.config.blocks[number].photographs,
            state=state,
            step=report.step,
            fraction=report.fraction,
            seconds=report.seconds,
        )


def _size(log: Path) -> int:
    """Bytes of a file; 0 where there is none."""
    try:
        return log.stat().st_size
    except OSError:
        return 0


def _last_line(log: Path) -> str:
    """What a training said last."""
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    said = [line for line in lines if line.strip()]
    return said[-1].strip() if said else "it said nothing"
