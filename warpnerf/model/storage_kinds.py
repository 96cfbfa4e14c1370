"""What fields are stored in: kinds with a name, and what of them is known without a device.

A kind is a frozen value, as a model is; ``warpnerf.fields.storage`` says what it becomes on a
device.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, TypeVar

from warpnerf.checked import checked
from warpnerf.checks import (
    InputError,
    require_at_least,
    require_one_of,
    require_positive,
    require_whole,
    said,
)
from warpnerf.model import registry
from warpnerf.model.interface import Load, Model, loader

NUMBER_BYTES = 12
"""Memory that a number takes in training: value, two moments together, and gradient, 4 each."""
LOOK_BYTES = 3
"""Memory of a look for free space, for each node, where nodes are not stored."""
MAX_WIDTH = 128
"""Numbers of an entry of planes, or of all levels of a hash together, at most."""
LAYER_TIME = 4e-4
"""Training time of a multiplication of a hidden layer, which each sample goes through, over that of
a sample of dense."""
COLUMNS = 16
"""Of a decoder, at least."""
MAX_CELLS = 1 << 15
"""Of a level of a hash along an edge: positions in it are float32."""
MAX_TABLE = 1 << 24
"""Entries of a level, at most: all levels together are counted by int32."""


class StorageKind(ABC):
    """How raw values are stored over space, as it is configured."""

    name: ClassVar[str]
    """What files call it."""
    box_is_fixed: ClassVar[bool] = False
    """Whether what is stored is tied to the box, so that this never becomes tighter."""
    seen_share: ClassVar[float] = 1.0
    """What counts as visible at a node, as a share of ``TrainConfig.alpha_min``: 1 where nothing
    between nodes can be denser than they are."""
    own_rates: ClassVar[bool] = False
    """Whether it has learning rates of its own, so that those of the numbers that it stands for, of
    densities, colours and features, do nothing."""
    own_epsilon: ClassVar[bool] = False
    """Whether Adam has another epsilon for all of it, so that ``OptimConfig.epsilon`` is for others
    only."""
    as_fine_as_nodes: ClassVar[bool] = True
    """Whether the nodes of the lattice say how fine it is."""
    auto_voxels: ClassVar[int] = 224**3
    """What ``GridConfig.voxels`` is where it is auto: for a dense grid as many as a quarter of an
    hour on two cores can train."""
    smoothed: ClassVar[bool] = True
    """Whether total variation smooths it, so that what is configured of that does something."""
    owns_densities: ClassVar[bool] = False
    """Whether each node has a raw density of its own, so that ``OptimConfig.near_decay`` can lower
    it."""

    @property
    def sample_bytes(self) -> int:
        """Memory of a sample's gradient on its way from one thread of the CPU to others, where each
        sample has something for others; 0 where few do."""
        return 0

    @property
    def has_sparsity(self) -> bool:
        """Whether an L1 loss makes it sparse, added as often as total variation is."""
        return False

    @property
    @abstractmethod
    def rules(self) -> Mapping[str, str]:
        """The arrays that are learned, by their names in files, and the name of the rule of the
        optimiser that updates each."""

    @abstractmethod
    def encoding(self, load: Load, model: Model) -> Any:
        """The part that reads it.

        Args:
            load: The kernels' modules, in the precision that is wanted.
            model: Reads ``n_floats`` numbers at a sample, sample by sample if it is ``by_sample``.

        Returns:
            ``warpnerf_kernels.base.parts.Encoding``.
        """

    @abstractmethod
    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        """Memory that training takes on a lattice of so many nodes along each axis."""

    @property
    def relative_time(self) -> float:
        """How long a step of training takes, about, over one with a dense grid."""
        return 1.0

    def in_words(self, model: Model, size: tuple[int, int, int]) -> str:
        """What needs that memory."""
        return f"a {self.name} field over {size[0]} x {size[1]} x {size[2]} nodes"


@dataclass(frozen=True, kw_only=True)
class Dense(StorageKind):
    """Dense voxel grid: a value at each node, trilinear interpolation in between."""

    name: ClassVar[str] = "dense"
    owns_densities: ClassVar[bool] = True

    @property
    def rules(self) -> Mapping[str, str]:
        """The tensors that are stored: one array of grid nodes."""
        return {"values": "nodes"}

    def encoding(self, load: Load, model: Model) -> Any:
        """The kernels' encoding: a dense grid of the model's numbers."""
        return load("fields.dense").dense(model.n_floats, model.by_sample)

    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        """Training memory in bytes: values, gradient and Adam's moments of each node."""
        return math.prod(size) * model.n_floats * NUMBER_BYTES

    def in_words(self, model: Model, size: tuple[int, int, int]) -> str:
        """A description in words: a voxel grid, and what a node has."""
        grid = f"a grid of {size[0]} x {size[1]} x {size[2]} nodes"
        return f"{grid} of {model.n_floats} numbers"


@checked("field")
@dataclass(frozen=True, kw_only=True)
class Vm(StorageKind):
    """TensoRF's vector-matrix (VM) decomposition: three planes and three lines of vectors, and a
    matrix that decodes their products. Memory grows with the square of the nodes along an axis."""

    name: ClassVar[str] = "vm"
    auto_voxels: ClassVar[int] = 300**3
    own_rates: ClassVar[bool] = True
    density: int = 4
    """Density components: numbers of an entry whose products start out as the raw density."""
    appearance: int = 12
    """Appearance components: the other numbers of an entry, for colour. Density and appearance
    together are a multiple of 16."""
    learning_rate: float = 0.1
    """Adam's learning rate of planes and lines, at the start."""
    learning_rate_decoder: float = 5e-3
    """Adam's learning rate of the decoder matrix, at the start."""
    sparsity: float = 0.0
    """Weight of TensoRF's L1 loss: the mean magnitude of density components of planes and lines,
    where rays have been. It is added as optim.tv_every and optim.tv_until say."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        require_whole("field.density", self.density, 1)
        require_whole("field.appearance", self.appearance, 1)
        if self.width % 16 or self.width > MAX_WIDTH:
            raise InputError(
                f"field.density and field.appearance must be a multiple of 16 together, up to "
                f"{MAX_WIDTH}, not {self.density} + {self.appearance}: numbers of an entry are "
                "worked on sixteen at a time."
            )
        require_positive("field.learning_rate", self.learning_rate)
        require_positive("field.learning_rate_decoder", self.learning_rate_decoder)
        require_at_least("field.sparsity", self.sparsity, 0.0)
        registry.keep_plain(self, "field")

    @property
    def has_sparsity(self) -> bool:
        """Whether TensoRF's L1 loss has a weight."""
        return self.sparsity > 0.0

    @property
    def width(self) -> int:
        """VM components of an entry: how many numbers it has."""
        return self.density + self.appearance

    @property
    def relative_time(self) -> float:
        """Training time relative to a dense grid, by benchmarks/factors.py."""
        return 0.6 + 0.06 * self.width

    @property
    def rules(self) -> Mapping[str, str]:
        """The tensors that are stored: planes, lines, decoder."""
        return {"planes": "nodes", "lines": "lines", "decoder": "weights"}

    def encoding(self, load: Load, model: Model) -> Any:
        """The kernels' encoding: products of planes and lines, decoded to the model's numbers."""
        factors = load("fields.factors").factors
        return factors(self.width, model.n_floats, 1 + model.n_features, model.by_sample)

    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        """Training memory in bytes: of each entry of planes; and of a look for free space, which is
        for all nodes."""
        x, y, z = size
        return (x * y + x * z + y * z) * self.width * NUMBER_BYTES + x * y * z * LOOK_BYTES

    def in_words(self, model: Model, size: tuple[int, int, int]) -> str:
        """A description in words: TensoRF planes, and what an entry has."""
        x, y, z = size
        return f"a field of planes over {x} x {y} x {z} nodes with entries of {self.width} numbers"


@checked("field")
@dataclass(frozen=True, kw_only=True)
class Hash(StorageKind):
    """Multiresolution hash encoding, by rows: Instant-NGP's tables of entries, and a matrix that
    decodes them. Memory does not grow with the nodes of the lattice."""

    name: ClassVar[str] = "hash"
    box_is_fixed: ClassVar[bool] = True
    own_rates: ClassVar[bool] = True
    own_epsilon: ClassVar[bool] = True
    as_fine_as_nodes: ClassVar[bool] = False
    smoothed: ClassVar[bool] = False
    seen_share: ClassVar[float] = 0.4
    levels: int = 6
    """Levels of resolution, from the coarsest to the finest by equal factors. Fine ones are
    switched on as the lattice grows."""
    features: int = 4
    """Numbers of an entry: 2, 4 or 8."""
    coarsest: int = 32
    """Cells of the first level along the longest edge of what is trained."""
    finest: int = 1024
    """Cells of the last level."""
    table: int = 1 << 17
    """Entries of a level, at most, a power of two; where a level has more nodes, nodes share
    them."""
    hidden: int = 0
    """Units of a hidden layer with ReLU before the decoder, as Instant-NGP's density network has: a
    multiple of 16 up to 128. 0: the decoder sees entries themselves."""
    learning_rate: float = 0.1
    """Adam's learning rate of entries, at the start."""
    learning_rate_decoder: float = 0.01
    """Adam's learning rate of the matrices behind entries, at the start."""
    epsilon: float = 1e-12
    """Adam's, in place of ``OptimConfig.epsilon``: entries of fine levels get small gradients."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        require_whole("field.levels", self.levels, 2)
        require_whole("field.features", self.features, 1)
        if self.features not in (2, 4, 8):
            raise InputError(f"field.features must be 2, 4 or 8, not {said(self.features)}.")
        if self.levels * self.features > MAX_WIDTH:
            raise InputError(
                f"field.levels times field.features must be at most {MAX_WIDTH}, not "
                f"{self.levels} x {self.features}; use fewer of one."
            )
        require_whole("field.coarsest", self.coarsest, 1)
        require_whole("field.finest", self.finest, self.coarsest)
        if self.finest > MAX_CELLS:
            raise InputError(f"field.finest must be at most {MAX_CELLS}, not {said(self.finest)}.")
        require_whole("field.table", self.table, 16)
        if self.table & (self.table - 1) or self.table > MAX_TABLE:
            raise InputError(
                f"field.table must be a power of two, up to {MAX_TABLE}, not {said(self.table)}."
            )
        require_whole("field.hidden", self.hidden, 0)
        if self.hidden % 16 or self.hidden > MAX_WIDTH:
            raise InputError(
                f"field.hidden must be a multiple of 16 up to {MAX_WIDTH}, or 0 for no hidden "
                f"layer, not {said(self.hidden)}: units are worked on sixteen at a time."
            )
        require_positive("field.learning_rate", self.learning_rate)
        require_positive("field.learning_rate_decoder", self.learning_rate_decoder)
        require_positive("field.epsilon", self.epsilon)
        registry.keep_plain(self, "field")

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Hash grid resolution of each level: cells along the longest edge."""
        between = max(1, self.levels - 1)
        ratio = self.finest / self.coarsest
        return tuple(round(self.coarsest * ratio ** (n / between)) for n in range(self.levels))

    @property
    def relative_time(self) -> float:
        """Training time relative to a dense grid, by benchmarks/factors.py; and that of a hidden
        layer, for each sample."""
        of_layer = self.hidden * (self.levels * self.features + COLUMNS)
        return 0.6 + 0.4 * self.levels + LAYER_TIME * of_layer

    @property
    def sample_bytes(self) -> int:
        """Memory of a sample's gradient on its way in bytes: its position, and a number for each of
        all levels, in whole packs of sixteen. Levels belong to different threads."""
        return 4 * (3 + -(-self.levels * self.features // 16) * 16)

    @property
    def rules(self) -> Mapping[str, str]:
        """The tensors that are stored: hash table entries, hidden layer, decoder."""
        hidden = {"hidden": "weights"} if self.hidden else {}
        return {"values": "nodes", **hidden, "decoder": "weights"}

    def encoding(self, load: Load, model: Model) -> Any:
        """The kernels' encoding: hash table entries of all levels, decoded to the model's
        numbers."""
        return load("fields.hashed").hashed(
            *(self.features, self.levels, model.n_floats, 1 + model.n_features, model.by_sample),
            self.hidden,
        )

    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        """Training memory in bytes: of each entry, as in a cube; of a hidden layer; and of a look
        for free space, which is for all nodes."""
        entries = sum(min(self.table, (n + 1) ** 3) + n for n in self.resolutions)
        numbers = self.features * (entries + self.levels * self.hidden)
        return numbers * NUMBER_BYTES + math.prod(size) * LOOK_BYTES

    def in_words(self, model: Model, size: tuple[int, int, int]) -> str:
        """A description in words: hash grid levels, and what an entry has."""
        return f"a hash of {self.levels} levels with up to {self.table} entries of {self.features}"


@dataclass(frozen=True, kw_only=True)
class AutoField(StorageKind):
    """VM decomposition or dense voxel grid, as suits the scene: ``TrainConfig.for_kind``."""

    name: ClassVar[str] = "auto"
    owns_densities: ClassVar[bool] = True

    @property
    def rules(self) -> Mapping[str, str]:
        """None: it has to be decided first."""
        raise TypeError(_UNDECIDED)

    def encoding(self, load: Load, model: Model) -> Any:
        """None: it has to be decided first."""
        raise TypeError(_UNDECIDED)

    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        """None: it has to be decided first."""
        raise TypeError(_UNDECIDED)


_UNDECIDED = "a field that is auto stores nothing; see TrainConfig.for_kind"

DENSE = Dense()
AUTO_FIELD = AutoField()

STORAGE_KINDS: dict[str, type[StorageKind]] = {
    kind.name: kind for kind in (Dense, Vm, Hash, AutoField)
}
"""By name."""


@cache
def parts_of(model: Model, precision: str, stored: StorageKind = DENSE) -> Any:
    """A model's parts in float32 or float64, with the encoding of what its field is stored in.

    Raises:
        ValueError: A part is another one each time, so that nothing made of it is found again.
    """
    load = loader(precision)

    def made() -> Any:
        return model.parts(load)._replace(encoding=stored.encoding(load, model))

    parts = made()
    for name, part, again in zip(parts._fields, parts, made(), strict=True):
        if part != again:
            raise ValueError(
                f"model {model.name!r}, field {stored.name!r}: each call makes another part "
                f"{name!r}; decorate the function that makes it with functools.cache"
            )
    return parts


AnyKind = TypeVar("AnyKind", bound=type[StorageKind])


def register(kind: AnyKind) -> AnyKind:
    """Make a kind of storage known by its name, to files and configurations; a decorator.

    Args:
        kind: The class. What it is configured by are numbers with defaults.

    Raises:
        ValueError: Another one has that name.
    """
    return registry.add(STORAGE_KINDS, kind.name, kind, "storage")


def storage_of(name: str) -> StorageKind:
    """The storage of a name, as it is configured by default.

    Raises:
        InputError: There is none.
    """
    require_one_of("field", name, tuple(STORAGE_KINDS))
    return STORAGE_KINDS[name]()


def from_json(tree: Any) -> StorageKind:
    """The kind that ``registry.to_json`` wrote.

    Raises:
        ValueError: It is none that this version knows.
    """
    kind = registry.from_json(STORAGE_KINDS, tree, "storage", {})
    assert isinstance(kind, StorageKind)
    return kind
