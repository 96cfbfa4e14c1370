"""Photographs compared with renderings from their places: pictures of the difference."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from warpnerf.checks import InputError
from warpnerf.evaluation.metrics import psnr, truth
from warpnerf.media.contact_sheet import spread
from warpnerf.media.pictures import dimmed, to_bytes
from warpnerf.scenes.scene import Scene, View
from warpnerf.viewer.painter import Painter

if TYPE_CHECKING:
    import viser

MAX_SIDE = 480
"""Pixels along the longer side of a photograph that is compared."""
MOST = 200
"""Photographs of a split that are in the list; of more, so many evenly spread ones."""
GAIN = 4.0
"""What differences are multiplied by."""


class Comparison:
    """Its part of the panel, for all pages."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: Scene,
        painter: Painter,
        request: Callable[[Callable[[], None]], None],
    ) -> None:
        """Put it up.

        Args:
            server: Whose page it is on.
            scene: Whose photographs are compared: those of training and of testing.
            painter: Renders.
            request: Has something done by the thread that renders.
        """
        self._painter = painter
        self._views: dict[str, View] = {}
        for split in ("test", "train"):
            indices = list(scene.splits.get(split, ()))
            for number in spread(len(indices), MOST) if indices else ():
                view = scene.views[indices[number]]
                self._views[f"{split}: {view.name}"] = view
        gui = server.gui
        with gui.add_folder("Compare with a photograph", expand_by_default=False):
            name = gui.add_dropdown("Photograph", list(self._views))
            show = gui.add_button("Show the difference")

        @show.on_click
        def _(event: Any) -> None:
            client, chosen = event.client, name.value
            if client is not None and chosen in self._views:
                request(lambda: self._show(client, chosen))

    def _show(self, client: viser.ClientHandle, name: str) -> None:
        """In a window of one page."""
        with client.gui.add_modal(name) as modal:
            try:
                picture, figures = compare(self._painter, self._views[name])
            except InputError as error:
                client.gui.add_markdown(str(error))
            else:
                client.gui.add_image(picture, format="jpeg", jpeg_quality=90)
                said = ", ".join(f"{value:.2f} dB" for value in figures)
                client.gui.add_markdown(
                    f"Photograph, rendering, and their difference times {GAIN:g}. PSNR: {said}."
                )
            client.gui.add_button("Close").on_click(lambda _: modal.close())
        client.flush()


def compare(painter: Painter, view: View) -> tuple[np.ndarray, list[float]]:
    """Photograph, rendering and absolute difference side by side, and PSNR in dB.

    They have at most MAX_SIDE pixels along the longer side: means of square blocks of the
    photograph's.

    Args:
        painter: Of one or two fields; each has its row.
        view: What is compared; where its mask is false it is pale, and does not count.

    Returns:
        [rows H, 3 W, 3] uint8, and a PSNR for each row.

    Raises:
        InputError: The photograph's file is not what it was.
    """
    factor = -(-max(view.camera.width, view.camera.height) // MAX_SIDE)
    factor = min(factor, view.camera.width, view.camera.height)
    camera = view.camera.downscaled(factor)
    mask = view.mask
    if mask is not None:
        mask = _blocks(mask[..., None].astype(float), factor)[..., 0] > 0.999
        mask = mask if mask.any() else None
    rows, figures = [], []
    for subject in painter.subjects:
        field = subject.field()
        target = _blocks(truth(view, field.background), factor)
        rgb = field.render(camera).rgb
        difference = np.clip(GAIN * np.abs(rgb - target), 0.0, 1.0)
        if mask is not None:
            difference[~mask] = 0.0
        panels = [dimmed(target, mask), rgb, difference]
        rows.append(np.concatenate([to_bytes(panel) for panel in panels], axis=1))
        figures.append(psnr(rgb, target, mask))
    return np.concatenate(rows), figures


def _blocks(values: np.ndarray, edge: int) -> np.ndarray:
    """Means of square blocks of an image [H, W, n]; what fills none is left out."""
    high, wide = (size // edge for size in values.shape[:2])
    parts = values[: high * edge, : wide * edge].reshape(high, edge, wide, edge, -1)
    return parts.mean(axis=(1, 3))
