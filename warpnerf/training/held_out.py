"""Validation during training: the PSNR of a few test views, every so many steps."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.checks import InputError, require_whole
from warpnerf.evaluation.metrics import psnr, truth
from warpnerf.scenes.scene import Scene
from warpnerf.training.state import Progress

if TYPE_CHECKING:
    from warpnerf.training.trainer import Trainer

VIEWS = 4
"""Test views that are rendered, at most, spread."""


class HeldOut:
    """Mean PSNR of a few test views during a training, which that does not change by a bit."""

    def __init__(self, trainer: Trainer, every: int) -> None:
        """Choose the views.

        Args:
            trainer: Of the training; ``after_update`` is its ``between``.
            every: Steps from one look to the next, at least: looks come after updates.

        Raises:
            InputError: There are no test views.
        """
        require_eval(trainer.scene, every)
        indices = trainer.scene.splits["test"]
        chosen = np.unique(np.linspace(0, len(indices) - 1, min(VIEWS, len(indices))).round())
        self._views = [trainer.scene.views[indices[int(k)]] for k in chosen]
        self._trainer, self._every, self._at = trainer, every, trainer.steps_done
        self._new = False
        self.psnr: float | None = None
        """The last one, dB; None: there was no look yet."""

    def after_update(self) -> None:
        """Render the views where it is time to, and at the end."""
        step = self._trainer.steps_done
        if step // self._every == self._at // self._every and self._trainer.fraction < 1.0:
            return
        self._at, field = step, self._trainer.field()
        figures = [
            psnr(field.render(view.camera).rgb, truth(view, field.background), view.mask)
            for view in self._views
        ]
        self.psnr, self._new = float(np.mean(figures)), True

    def added_to(self, progress: Progress) -> Progress:
        """A report with what was found since the last one."""
        if not self._new:
            return progress
        self._new = False
        return replace(progress, test_psnr=self.psnr)


def require_eval(scene: Scene, every: int) -> None:
    """Raise InputError unless test views of a scene can be rendered every so many steps."""
    require_whole("eval_every", every, 1)
    if not scene.splits.get("test"):
        raise InputError(
            f"eval_every is {every}, but {scene.name} has no test views; withhold some photographs "
            "(split), or leave eval_every out."
        )
