"""Several processes that train one scene: what each does of an update, and what they agree on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from warpnerf.runtime.memory import zero_bytes

if TYPE_CHECKING:
    import warp as wp

    from warpnerf.fields.gradients import Gradients
    from warpnerf.fields.parameters import Parameter
    from warpnerf.runtime.parallel import Workers

T = TypeVar("T")


class PeerLostError(RuntimeError):
    """Another process of a training has ended, or does not answer."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """What processes agree on between two updates."""

    seconds: float
    """Of training; those of the first process count."""
    stop: bool
    """Whether one of them is asked to stop."""
    save: bool
    """Whether a checkpoint is due at the first process."""
    finite: bool = True
    """Whether the losses of all of them are finite numbers."""


class Peers:
    """The processes of a training, seen from one of them. This class is for a process alone.

    All of them hold the same field, differentiate their shares of a batch, add their gradients, and
    update alike. So they do the same things in the same order, and none needs what others have.
    """

    rank: int = 0
    """Which one this is; 0 is the first, which alone writes and prints."""
    count: int = 1
    """How many there are."""

    def is_first_to_fail(self) -> bool:
        """Whether no process has called this before: of one error, one tells."""
        return True

    def from_first(self, make: Callable[[], T]) -> T:
        """What a function returns in the first process, which alone calls it.

        Args:
            make: What it returns can be pickled.

        Raises:
            InputError: The function raises it; then all processes do.
            PeerLostError: One has ended.
        """
        return make()

    def require_same(self, what: Callable[[], dict[str, str]]) -> None:
        """Raise InputError, in every process, unless all have the same.

        Args:
            what: Called where there are several: values by the words for them, such as "scene".

        Raises:
            PeerLostError: One has ended.
        """

    def wait(self) -> None:
        """Until all are here, however long they take: after set-up, or while one of them saves.

        Raises:
            PeerLostError: One has ended.
        """

    def agree(self, signals: Signals) -> Signals:
        """What all do next.

        Args:
            signals: What this process would do.

        Raises:
            PeerLostError: One has ended, or does not come.
        """
        return signals

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What ``add`` launches."""
        return ()

    def zeros(self, n_bytes: int) -> np.ndarray:
        """Memory for gradients on the CPU, [n_bytes] uint8, in whole pages where others reach it.

        All processes request the same, in the same order.

        Raises:
            PeerLostError: One has ended.
        """
        return zero_bytes(n_bytes)

    def add(self, accumulated: Sequence[tuple[Gradients, Parameter]], workers: Workers) -> None:
        """Replace gradients by their sums over all processes, and flags by those of all tiles that
        hold any.

        Args:
            accumulated: Parameters, and where their gradients of an update are, once all of its
                rays are through.
            workers: Where to work.

        Raises:
            PeerLostError: One has ended, or does not come.
        """


ALONE = Peers()
"""One process draws all rays."""
