"""The folder of a scene in blocks: what was cut, and the trained blocks as one field.

blocks.json              the capture, and the core of each block
blocks.png               a plan: cores, margins and cameras from above
block-07.part.json       photographs and box of a block: a scene, for train and inspect
train.json               options that all blocks are trained with
block-07/                the run of a block
block-07.log             what its training printed
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from warpnerf.blocks.cut import MOST, Block, fills
from warpnerf.checks import InputError, cannot_write
from warpnerf.media.pictures import png
from warpnerf.media.scene_plan import blocks_picture
from warpnerf.rendering.composite import CompositeField
from warpnerf.rendering.field import Field
from warpnerf.runs.config import RunConfig, TrainedScene
from warpnerf.runs.lock import require_own
from warpnerf.runs.run import Run
from warpnerf.runtime.memory import available_memory
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.files import exists, read_json
from warpnerf.scenes.formats.load import BUILTIN
from warpnerf.scenes.formats.part import ENDING, Part, Triple, read_part
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.split import Split
from warpnerf.writing import StagedWrites

FILE, PLAN, OPTIONS = "blocks.json", "blocks.png", "train.json"

MEMORY_SHARE = 0.5
"""Of the memory that is free, in which fields of blocks are kept; others are read again."""


class BlockEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A block, as blocks.json has it."""

    core_min: Triple
    """Lower corner of its core, scene units."""
    core_max: Triple
    """Upper corner."""
    photographs: Annotated[int, msgspec.Meta(ge=1)]
    """How many train it or are withheld."""


class BlocksConfig(TrainedScene, frozen=True, kw_only=True):
    """What blocks.json says."""

    box_min: Triple
    """Lower corner of the box that was cut, scene units. Cores that end at its faces extend behind
    them without end."""
    box_max: Triple
    """Upper corner."""
    blocks: Annotated[list[BlockEntry], msgspec.Meta(min_length=1, max_length=MOST)]
    """In the order of their numbers."""


@dataclass(frozen=True, kw_only=True)
class BlockFolder:
    """The folder of a scene that is trained in blocks."""

    folder: Path
    """It."""
    config: BlocksConfig
    """What its blocks.json says."""

    @staticmethod
    def read(folder: Path) -> BlockFolder:
        """Read blocks.json.

        Raises:
            InputError: It is missing or damaged.
        """
        path = folder / FILE
        if not exists(path):
            raise InputError(f"{path} does not exist; name a folder that warpnerf blocks has made.")
        config = read_json(path, BlocksConfig)
        cores = np.array([[block.core_min, block.core_max] for block in config.blocks])
        if not fills(cores, np.array([config.box_min, config.box_max])):
            raise InputError(
                f"{path}: $.blocks: cores must fill the box of the scene, each place once; cut the "
                "scene again."
            )
        return BlockFolder(folder=folder, config=config)

    def __len__(self) -> int:
        """How many blocks there are."""
        return len(self.config.blocks)

    def name(self, number: int) -> str:
        """What a block is called."""
        return f"block-{number:0{len(str(len(self) - 1))}}"

    def part(self, number: int) -> Path:
        """The scene that a block is trained on."""
        return self.folder / f"{self.name(number)}{ENDING}"

    def run(self, number: int) -> Run:
        """The run of a block."""
        return Run(self.folder / self.name(number))

    def log(self, number: int) -> Path:
        """What the training of a block printed."""
        return self.folder / f"{self.name(number)}.log"

    @property
    def begun(self) -> list[int]:
        """Blocks whose training has begun, whether or not it has saved anything yet."""
        return [n for n in range(len(self)) if exists(self.run(n).folder / "config.json")]

    def is_finished(self, number: int) -> bool:
        """Whether the field of a block is there."""
        return exists(self.run(number).folder / "field.safetensors")

    def read_config(self) -> BlocksConfig:
        """On what the blocks were trained."""
        return self.config

    @property
    def cells(self) -> np.ndarray:
        """[n, 2, 3] where each block is rendered, see ``blocks.cut.Block.cell``."""
        root = np.array([self.config.box_min, self.config.box_max])
        cores = np.array([[block.core_min, block.core_max] for block in self.config.blocks])
        return np.where(cores == root, np.array([[-np.inf] * 3, [np.inf] * 3]), cores)

    def require_own_files(self, numbers: Sequence[int]) -> None:
        """Refuse links, pipes and devices in place of what is written when blocks are trained.

        Args:
            numbers: Of the blocks.

        Raises:
            InputError: There is one.
        """
        paths = [(self.run(number).folder, self.log(number)) for number in numbers]
        require_own([self.folder / OPTIONS, *chain(*paths)], "train-blocks")

    def require_own_runs(self, numbers: Sequence[int]) -> None:
        """Refuse blocks whose folder has results of another scene, such as of another cut.

        Args:
            numbers: Of the blocks; those that have no results yet are left alone.

        Raises:
            InputError: A run is of another scene, or cannot be read.
        """
        for number in numbers:
            if self.run(number).results:
                self._own_config(number)

    def _own_config(self, number: int) -> RunConfig:
        """The configuration of a block's run; InputError where the run is of another scene."""
        run, path = self.run(number), self.part(number)
        config, part = run.read_config(), read_part(path)
        trained = (config.box_min, config.box_max, config.downscale, len(config.pictures or ()))
        cut = (part.box_min, part.box_max, self.config.downscale, len({*part.photographs}))
        if trained != cut:
            raise InputError(
                f"{run.folder} holds a run of another scene than {path.name}: its box, downscale "
                "or photographs are others; move it away, and train the block again."
            )
        return config

    def run_config(self, number: int) -> RunConfig:
        """The configuration of a block's run.

        Raises:
            InputError: The block has not been trained to its end, or the run is of another scene.
        """
        name, run = self.name(number), self.run(number)
        if not self.is_finished(number):
            done = "has not finished" if run.checkpoints else "has not been trained"
            raise InputError(
                f"{self.folder}: {name} {done}, and a scene is shown whole; run warpnerf "
                f"train-blocks {self.folder} until all blocks are there."
            )
        config = self._own_config(number)
        if config.train.grid.contraction == "ndc":
            raise InputError(
                f"{run.folder} was trained in normalised device coordinates, in which blocks have "
                "no common rays; train it again without --contraction."
            )
        return config

    def load_field(self, device: str, threads: int | None) -> tuple[CompositeField, list[str]]:
        """The blocks as one field; each is read when a ray first meets its core.

        Args:
            device: Where they live.
            threads: CPU threads; None: one per usable core.

        Returns:
            The field, and no notes.

        Raises:
            InputError: A block is missing, or the device.
        """
        for number in range(len(self)):
            self.run_config(number)
        fields = _Fields(runs=[self.run(n) for n in range(len(self))], how=(device, threads))
        first = fields.of(0)
        return CompositeField(
            cells=self.cells,
            members=[partial(fields.of, number) for number in range(len(self))],
            surroundings=(np.array(self.config.box_min), np.array(self.config.box_max)),
            background=first.background,
            transmittance_min=first.steps.transmittance_min,
            workers=first.workers,
        ), []


@dataclass(kw_only=True)
class _Fields:
    """Fields of runs, of which as many are kept as there is memory for."""

    runs: Sequence[Run]
    how: tuple[str, int | None]
    _kept: OrderedDict[int, tuple[Field, int]] = field(default_factory=OrderedDict)
    _room: float | None = None

    def of(self, number: int) -> Field:
        """The field of a run; that which was not needed for longest makes room."""
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number][0]
        if self._room is None:
            device = Workers(*self.how).device
            free = device.free_memory if device.is_cuda else available_memory()
            self._room = np.inf if free is None else MEMORY_SHARE * free
        run = self.runs[number]
        size = 2 * (run.folder / "field.safetensors").stat().st_size  # its numbers have 16 bits
        while self._kept and sum(n for _, n in self._kept.values()) + size > self._room:
            self._kept.popitem(last=False)
        loaded, _ = run.load_field(*self.how)
        self._kept[number] = loaded, size
        return loaded


Trained = Run | BlockFolder
"""What can be looked at: a run, or a scene in blocks."""


def open_trained(folder: Path) -> Trained:
    """The run, or the scene in blocks, in a folder.

    Args:
        folder: Of one of them.

    Raises:
        InputError: Its blocks.json is damaged.
    """
    return BlockFolder.read(folder) if exists(folder / FILE) else Run(folder)


def stored_source(
    scene: str, downscale: int, masks: Path | None, split: Split | None
) -> dict[str, Any]:
    """What blocks.json says of a capture, see ``TrainedScene``.

    Raises:
        InputError: The scene is a part of a capture.
    """
    if scene.endswith(ENDING):
        raise InputError(f"{scene} is a part of a capture already; name the whole one.")
    return {
        "scene": scene if scene.startswith(BUILTIN) else str(Path(scene).resolve()),
        "downscale": downscale,
        "masks": None if masks is None else str(masks.resolve()),
        "split": list(split) if isinstance(split, tuple) else split,
    }


def write_blocks(
    folder: Path, scene: Scene, source: dict[str, Any], blocks: Sequence[Block]
) -> BlockFolder:
    """Write blocks.json, the plan, and the scene of each block: all of them or none.

    Args:
        folder: New or empty.
        scene: That was cut.
        source: Of ``stored_source``.
        blocks: Its blocks.

    Raises:
        InputError: The folder holds something, or cannot be written to.
    """
    if exists(folder) and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"--output {folder} is there already; name a new folder.")
    config = BlocksConfig(
        **source,
        content_distance=scene.content_distance,
        offset=None if scene.offset is None else _triple(scene.offset),
        box_min=_triple(scene.box_min),
        box_max=_triple(scene.box_max),
        blocks=[
            BlockEntry(
                core_min=_triple(block.core[0]),
                core_max=_triple(block.core[1]),
                photographs=len(block.views),
            )
            for block in blocks
        ],
    )
    made = BlockFolder(folder=folder, config=config)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with StagedWrites() as staged:
            for number, block in enumerate(blocks):
                part = Part(
                    part_of=config.scene,
                    photographs=[scene.views[index].name for index in block.views],
                    box_min=_triple(block.box[0]),
                    box_max=_triple(block.box[1]),
                    split=config.split,
                )
                staged.add(made.part(number), part.to_json())
            cores, boxes = (np.stack([b.core for b in blocks]), np.stack([b.box for b in blocks]))
            staged.add(folder / PLAN, png(blocks_picture(scene, cores, boxes)))
            text = json.dumps(msgspec.to_builtins(config), indent=1) + "\n"
            staged.add(folder / FILE, text.encode())
    except OSError as error:
        raise cannot_write(f"--output {folder}", error) from error
    return made


def _triple(values: np.ndarray) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
