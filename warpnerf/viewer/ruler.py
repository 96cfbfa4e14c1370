"""Measuring: the distance between two points on surfaces that were clicked."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from warpnerf.viewer.painter import Painter, Settings
from warpnerf.viewer.viewpoint import FARTHEST, World

if TYPE_CHECKING:
    import viser

COLOUR = (230, 60, 160)

HINT = "Switch it on, then click two points."


class Ruler:
    """One for all pages: its points, and what is shown of them."""

    def __init__(
        self,
        server: viser.ViserServer,
        world: World,
        painter: Painter,
        settings: Callable[[], Settings],
        request: Callable[[Callable[[], None]], None],
    ) -> None:
        """Put up its part of the panel.

        Args:
            server: Whose page it is on.
            world: viser's.
            painter: Finds what rays meet.
            settings: What is shown now.
            request: Has something done by the thread that renders.
        """
        self._server = server
        self._world = world
        self._painter = painter
        self._settings = settings
        self._request = request
        self.points: list[np.ndarray] = []
        """At most two, [3] each, scene units."""
        gui = server.gui
        with gui.add_folder("Distance", expand_by_default=False):
            self._on = gui.add_checkbox("Measure", False, hint="a third click begins again")
            self._unit = gui.add_number(
                "Scene unit", 1.0, min=0.0, hint="its length, in whatever you measure in"
            )
            self._said = gui.add_markdown(HINT)
        self._on.on_update(lambda _: self._switch())
        self._unit.on_update(lambda _: self._show())

    @property
    def length(self) -> float | None:
        """The distance between the points in scene units; None without two."""
        if len(self.points) < 2:
            return None
        return float(np.linalg.norm(self.points[1] - self.points[0]))

    def _switch(self) -> None:
        # While there is a callback, clicks go to it as well as to cameras.
        self._server.scene.remove_click_callback()
        if self._on.value:
            self._server.scene.on_click()(self._clicked)
        else:
            self.points = []
            self._show()

    def _clicked(self, event: Any) -> None:
        """A page says through which ray, in viser's world."""
        both = self._settings().layout in ("side by side", "divided")
        if both and len(self._painter.subjects) > 1:
            self._said.content = "Of two runs at once nothing is measured: show one of them."
            return
        origin = np.asarray(event.ray_origin, np.float64)
        direction = np.asarray(event.ray_direction, np.float64)
        length = np.linalg.norm(direction) if direction.shape == (3,) else np.nan
        if origin.shape != (3,) or not np.abs(origin).max() <= FARTHEST:
            return
        if not 1e-6 < length < 1e6:
            return
        self._request(lambda: self._add(origin / self._world.scale, direction / length))

    def _add(self, origin: np.ndarray, direction: np.ndarray) -> None:
        point = self._painter.surface(origin, direction, self._settings())
        if point is None:
            self._said.content = "Nothing is there."
            return
        self.points = [*self.points, point] if len(self.points) < 2 else [point]
        self._show()

    def _show(self) -> None:
        scene, length = self._server.scene, self.length
        places = [self._world.scale * point for point in self.points]
        for number in range(2):
            if number < len(places):
                scene.add_icosphere(
                    f"/measure/{number}", radius=0.012, color=COLOUR, position=places[number]
                )
            else:
                scene.remove_by_name(f"/measure/{number}")
        if length is None:
            scene.remove_by_name("/measure/line")
            scene.remove_by_name("/measure/length")
            self._said.content = HINT if not places else "Click the second point."
            return
        line = np.array([places], np.float32)
        scene.add_line_segments(
            "/measure/line", line, colors=COLOUR, thickness=3.0, thickness_units="screen"
        )
        unit = self._unit.value if 0.0 < self._unit.value < np.inf else 1.0
        said = f"{length * unit:.4g}"
        scene.add_label("/measure/length", said, position=0.5 * (places[0] + places[1]))
        a, b = (", ".join(f"{x:.4g}" for x in point) for point in self.points)
        self._said.content = f"**{said}**, {length:.4g} scene units, from ({a}) to ({b})"
