"""Trainings that take turns, each on a clock of its own.

A machine that is slow for a while is then slow for all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from warpnerf.training.trainer import Trainer

TURN_SECONDS = 0.4


def take_turns(
    trainers: dict[str, Trainer], after_turn: Callable[[str, float], None]
) -> dict[str, float]:
    """Train until all are done.

    Args:
        trainers: By name; fresh ones. What they compile, and their first update, counts for none.
        after_turn: Called after each turn with the name of who had it and the seconds that it has
            trained so far; what it takes counts for none either.

    Returns:
        Seconds that each has trained.
    """
    paused_at: dict[str, float] = {}
    for name, trainer in trainers.items():
        trainer.update()  # compiles; its clock starts after it
        paused_at[name] = time.perf_counter()
    seconds = dict.fromkeys(trainers, 0.0)
    n_rounds = 0
    while waiting := [name for name in trainers if trainers[name].fraction < 1.0]:
        n_rounds += 1
        for name in waiting[:: 1 if n_rounds % 2 else -1]:
            trainer, begin = trainers[name], time.perf_counter()
            assert trainer._started is not None
            trainer._started += begin - paused_at[name]
            trainer.run(stop=partial(_is_past, begin + TURN_SECONDS))
            paused_at[name] = time.perf_counter()
            seconds[name] += paused_at[name] - begin
            after_turn(name, seconds[name])
    return seconds


def _is_past(until: float) -> bool:
    return time.perf_counter() > until
