"""The cases of throughput.py, which against.py and threads.py have as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from field_workload import made_field
from workload import DEFAULT_MODELS, ModelName, Rays, Scene, Workload, make_workload


@dataclass(frozen=True)
class Case:
    """One workload."""

    rays: Rays
    grid: int
    scene: Scene = "dense"
    scaled: bool = True
    model: ModelName = "rgb"

    def __str__(self) -> str:
        """In words."""
        scaling = "scaled" if self.scaled else "not scaled"
        return f"{self.model}, {self.rays} rays, {self.grid}^3, {self.scene}, {scaling}"

    def workload(self, n_rays: int, n_steps: int) -> Workload:
        """Make it."""
        return make_workload(
            self.rays,
            self.grid,
            n_rays,
            n_steps,
            scene=self.scene,
            scaled=self.scaled,
            model=self.model,
        )


@dataclass(frozen=True)
class FieldCase(Case):
    """One workload of a field that is no dense grid."""

    field: str = "vm"

    def __str__(self) -> str:
        """In words."""
        return f"{super().__str__()}, {self.field}"

    def workload(self, n_rays: int, n_steps: int) -> Workload:
        """Make it."""
        return made_field(self.field, super().workload(n_rays, n_steps))


EVERYTHING = [("dense", model) for model in DEFAULT_MODELS]
"""Models with a dense grid."""


def make_cases(grids: Sequence[int], wanted: Sequence[tuple[str, str]] = EVERYTHING) -> list[Case]:
    """Of rgb every grid once, and on the last everything else once; there the other models too.

    Args:
        grids: Nodes along each axis.
        wanted: Fields and models; with fields besides dense grids, random rays through all of the
            box of the last grid.
    """
    last = grids[-1]
    scenes: tuple[Scene, ...] = ("dense", "sphere")
    cases = [
        *(Case("random", grid) for grid in grids),
        Case("patches", last),
        Case("random", last, scene="sphere"),
        Case("random", last, scaled=False),
        *(
            Case("random", last, scene=scene, model=model)
            for model in DEFAULT_MODELS
            if model != "rgb"
            for scene in scenes
        ),
    ]
    return [
        *(case for case in cases if ("dense", case.model) in wanted),
        *(
            FieldCase("random", last, model=model, field=field)
            for field, model in wanted
            if field != "dense"
        ),
    ]
