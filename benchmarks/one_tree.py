"""Steps of the warpnerf that PYTHONPATH names, timed when told to; against.py starts two of it.

It says nothing of its own tree but what a candidate needs, so that it runs with others' modules:
`workload` and `candidates.warpnerf_step` come from that tree's benchmarks, whatever they import.
Commands come as lines of JSON, and so do answers.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

FORMER = {"per_sample": "features"}
"""Names that models had in older trees."""


class Tree:
    """A step of one workload at a time."""

    def __init__(self) -> None:
        """Fetch this tree's modules."""
        self._make_workload: Callable[..., Any] = importlib.import_module("workload").make_workload
        self._load: Callable[..., Any] = importlib.import_module("candidates.warpnerf_step").load
        self._step: Any = None

    def knows(self, model: str) -> bool:
        """Whether it has a model."""
        if model == "rgb":
            return True
        found = "model" in inspect.signature(self._make_workload).parameters
        return found and bool({model, FORMER.get(model)} & set(self._models()))

    def _models(self) -> Any:
        return importlib.import_module("workload").MODELS

    def load(self, case: dict[str, Any], n_rays: int, n_steps: int, threads: int) -> None:
        """Load a workload and compile for it."""
        named = dict(case)
        if named["model"] == "rgb":  # a tree may have no other, and no word for it
            del named["model"]
        elif named["model"] not in self._models():
            named["model"] = FORMER[named["model"]]
        work = self._make_workload(named.pop("rays"), named.pop("grid"), n_rays, n_steps, **named)
        self._step = None  # gives its memory back
        self._step = self._load(work, threads, "cpu")
        self._step.step()
        self._step.step()

    def results(self, path: str) -> None:
        """Write what the step computes to a file."""
        np.savez(path, rgb=self._step.rgb(), gradient=self._step.gradient())

    def seconds(self, repeats: int) -> tuple[float, float]:
        """Of the fastest of some steps in a row, and least seconds of the cores in one."""
        walls, cores = [], []
        for _ in range(repeats):
            begin, begin_of_cores = time.perf_counter(), time.process_time()
            self._step.step()
            cores.append(time.process_time() - begin_of_cores)
            walls.append(time.perf_counter() - begin)
        return min(walls), min(cores)


def main() -> None:
    """Answer until there are no more commands."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever else is printed, by compilers too
    tree = Tree()
    for line in sys.stdin:
        name, arguments = json.loads(line)
        answers.write(json.dumps(getattr(tree, name)(*arguments)) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
