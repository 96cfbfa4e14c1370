"""`warpnerf blocks` and `warpnerf train-blocks`: scenes larger than a machine."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from warpnerf.checks import InputError, require_whole
from warpnerf.cli.arguments import SceneName
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.runtime.memory import require_threads, usable_cores
from warpnerf.runtime.progress import has_bar
from warpnerf.runtime.terminal import print_table
from warpnerf.scenes.split import read_split

if TYPE_CHECKING:
    from rich.live import Live

    from warpnerf.blocks.engines import Engine
    from warpnerf.blocks.train import BlockState

BlocksFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]


def blocks_command(
    scene: SceneName,
    /,
    output: Path,
    count: int,
    downscale: int = 1,
    masks: Path | None = None,
    split: str | None = None,
    threads: int | None = None,
) -> int:
    """Cut a scene into blocks, which train-blocks trains one by one.

    Args:
        scene: As for train.
        output: A new folder for the blocks.
        count: How many blocks.
        downscale: As of train; all blocks are trained so.
        masks: As of train.
        split: As of train.
        threads: CPU threads that times are estimated for; by default one per usable core.
    """
    from warpnerf.blocks.cut import cut
    from warpnerf.blocks.folder import FILE, PLAN, stored_source, write_blocks
    from warpnerf.inspection.inspection import cost_of, duration
    from warpnerf.scenes.formats.load import load_scene
    from warpnerf.scenes.formats.part import part_of, read_part
    from warpnerf.scenes.images.photographs import Keeping

    chosen = None if split is None else read_split(split)
    source = stored_source(scene, downscale, masks, chosen)
    print(f"reading {scene}", flush=True)
    whole = load_scene(
        scene, downscale=downscale, masks=masks, images="files", threads=threads, split=chosen
    )
    made = write_blocks(output, whole, source, cut(whole, count))
    configs = [
        replace(preset, grid=replace(preset.grid, box="scene", contraction="linf"))
        for preset in map(PRESETS.__getitem__, DEFAULT_PRESETS)
    ]
    rows = []
    for number, entry in enumerate(made.config.blocks):
        path = made.part(number)
        part = part_of(whole, read_part(path), path, Keeping(place="files"), downscale)
        costs = [cost_of(part, config, threads or usable_cores()) for config in configs]
        edges = " x ".join(
            f"{b - a:.3g}" for a, b in zip(entry.core_min, entry.core_max, strict=True)
        )
        taken = [f"{c.plan.memory / 2**30:.2g} GiB, {duration(c.seconds)}" for c in costs]
        rows.append([made.name(number), edges, str(entry.photographs), *taken])
    print_table(["block", "core", "photographs", *DEFAULT_PRESETS], rows)
    print(
        f"memory and time are those of training by a preset on {threads or usable_cores()} CPU "
        "threads, very roughly"
    )
    print(f"wrote {output}: {FILE}, {PLAN} and the scene of each block")
    print(f"train them by: warpnerf train-blocks {shlex.quote(str(output))}")
    return 0


def train_blocks_command(
    folder: BlocksFolder,
    /,
    engine: Literal["local", "ray"] = "local",
    address: str | None = None,
    workers: int | None = None,
    threads: int | None = None,
    only: int | None = None,
    train_options: str = "",
) -> int:
    """Train the blocks of a scene as jobs that can be stopped and resumed.

    Options of train for all blocks stand behind --, as in train-blocks DIR -- --preset quality.

    Args:
        folder: That blocks has made.
        engine: Where: in processes of this machine, or on the workers of a Ray cluster whose
            machines see the same files (pip install "warpnerf[scale]").
        address: HOST:PORT of the cluster's head, or auto; by default Ray is started here.
        workers: Blocks that are trained at a time; by default 1, and with Ray as many as its cores
            allow.
        threads: CPU threads of each; by default the cores of this machine divided by the workers,
            with Ray 2.
        only: Train this block alone, counted from 0: a job of a SLURM array.
        train_options: The same as what stands behind --, as one word.
    """
    from warpnerf.blocks.folder import BlockFolder
    from warpnerf.blocks.train import HEADINGS, BlockTraining, options_of

    blocks = BlockFolder.read(folder)
    if only is not None and not 0 <= only < len(blocks):
        raise InputError(f"--only {only}: {folder} has blocks 0 to {len(blocks) - 1}; name one.")
    if address is not None and engine != "ray":
        raise InputError("--address is of a Ray cluster; give --engine ray with it.")
    for name, value in (("--workers", workers), ("--threads", threads)):
        if value is not None:
            require_whole(name, value, 1)
    if threads is not None and engine == "local":
        require_threads(threads)
    numbers = range(len(blocks)) if only is None else [only]
    blocks.require_own_files(numbers)
    blocks.require_own_runs(numbers)
    options = options_of(blocks, _words_for_train(train_options))
    where = _engine(engine, address, workers, threads)
    try:
        training = BlockTraining(blocks, numbers, options, where)
        with _Board() as board:
            code = training.run(board.say, board.show)
    finally:
        where.close()
    states = training.states()
    print_table(HEADINGS, [s.row for s in states], [s.state == "failed" for s in states])
    for number in training.failed:
        print(f"{blocks.name(number)} failed; {blocks.log(number)} says why")
    if code > 1:
        print(f"stopped; continue with: warpnerf train-blocks {shlex.quote(str(folder))}")
    return code


def _words_for_train(options: str) -> list[str]:
    """Words of options that train can read; InputError where it cannot."""
    from warpnerf.cli.main import call_of

    try:
        words = shlex.split(options)
    except ValueError as error:
        raise InputError(f"--train-options {options!r}: {error}; quote it as a shell.") from None
    if words:
        call_of(["train", "SCENE", *words])
    return words


def _engine(name: str, address: str | None, workers: int | None, threads: int | None) -> Engine:
    from warpnerf.blocks.engines import LocalEngine, RayEngine

    if name == "ray":
        return RayEngine(address, workers, threads)
    return LocalEngine(workers, threads)


class _Board:
    """What happens to blocks: a table that is kept up to date in a terminal, else lines."""

    def __init__(self) -> None:
        self._live: Live | None = None
        self._last = ""

    def __enter__(self) -> _Board:
        if has_bar():
            from rich.live import Live

            self._live = Live(transient=True)
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, line: str) -> None:
        """A line that stays."""
        if self._live is not None:
            self._live.console.print(line, highlight=False)
        else:
            print(line, flush=True)

    def show(self, states: Sequence[BlockState]) -> None:
        """How far blocks are."""
        if self._live is not None:
            from rich.text import Text

            from warpnerf.blocks.train import HEADINGS
            from warpnerf.runtime.terminal import table_text

            self._live.update(Text(table_text(HEADINGS, [state.row for state in states])))
            return
        running = [f"{s.name} {s.fraction:.0%}" for s in states if s.state == "training"]
        done = sum(state.state == "done" for state in states)
        line = f"{done} of {len(states)} blocks done"
        if running:
            line += f"; training {', '.join(running)}"
        if line != self._last:
            print(line, flush=True)
            self._last = line
