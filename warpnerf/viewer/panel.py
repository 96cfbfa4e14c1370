"""The panel beside the picture: what is shown, the crop box, cameras, the path, the share."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warpnerf.evaluation.near_field import NEAR_SHARE
from warpnerf.viewer.painter import KINDS, LAYOUTS, Settings, Subject
from warpnerf.viewer.recorder import FILE_NAME, Recorder, preview
from warpnerf.viewer.stage import Stage, stand_in
from warpnerf.viewer.viewpoint import Viewpoint, World

if TYPE_CHECKING:
    import viser

SHARE = 0.3
"""Of the time, that pictures get of a training while somebody looks, unless the slider is moved."""


class Panel:
    """What people set, for all pages together."""

    def __init__(
        self,
        server: viser.ViserServer,
        stage: Stage,
        world: World,
        settings: Settings,
        box: tuple[np.ndarray, np.ndarray],
        content_distance: float,
        subjects: Sequence[Subject],
        training: bool,
        viewpoint_of: Callable[[int], Viewpoint | None],
        changed: Callable[[], None],
    ) -> None:
        """Put it up.

        Args:
            server: Whose page it is on.
            stage: What it shows and hides.
            world: viser's.
            settings: To begin with.
            box: Corners that a crop box stays within, [3] each, scene units.
            content_distance: Scene units.
            subjects: One or two.
            training: Whether there is time to be shared with a training.
            viewpoint_of: Where the page of a client looks from.
            changed: Called when something was set.
        """
        self.settings = settings
        """What is shown now."""
        self.share = SHARE if training else 1.0
        """Of the time, for pictures."""
        self._server = server
        self._stage = stage
        self._world = world
        self._content_distance = content_distance
        self._viewpoint_of = viewpoint_of
        self._changed = changed
        self._recorder = Recorder()
        gui = server.gui
        gui.set_panel_label(f"warpnerf: {' | '.join(subject.name for subject in subjects)}")
        self._add_pictures(len(subjects))
        if training:
            slider = gui.add_slider(
                "Time for pictures", 0.05, 0.9, 0.05, SHARE, hint="share of it, from training"
            )
            slider.on_update(lambda _: setattr(self, "share", _kept(slider.value, 0.05, 0.9)))
        if stage.cameras:
            self._add_cameras()
        self._add_crop(box, any(subject.field().in_ndc for subject in subjects))
        self._add_path()

    def _set(self, **changes: Any) -> None:
        self.settings = replace(self.settings, **changes)
        self._changed()

    def _add_pictures(self, n_subjects: int) -> None:
        gui, settings = self._server.gui, self.settings
        kind = gui.add_dropdown("Picture", KINDS, initial_value=settings.kind)
        near = gui.add_number("Depth from", settings.near, min=0.0, hint="yellow, scene units")
        far = gui.add_number("Depth to", settings.far, min=0.0, hint="blue, scene units")
        within = gui.add_slider(
            "Near field",
            0.02,
            1.0,
            0.02,
            NEAR_SHARE,
            hint="what lies so near to the camera, in content distances; bright is dense",
        )

        def show_what_matters() -> None:
            near.visible = far.visible = kind.value == "depth"
            within.visible = kind.value == "near field"

        @kind.on_update
        def _(_: Any) -> None:
            if kind.value in KINDS:
                show_what_matters()
                self._set(kind=kind.value)

        def set_depths(_: Any) -> None:
            if 0.0 <= near.value < far.value < np.inf:
                self._set(near=near.value, far=far.value)

        near.on_update(set_depths)
        far.on_update(set_depths)

        @within.on_update
        def _(_: Any) -> None:
            self._set(within=_kept(within.value, 0.02, 1.0) * self._content_distance)

        show_what_matters()
        if n_subjects > 1:
            layout = gui.add_dropdown("Runs", LAYOUTS, initial_value=settings.layout)
            divider = gui.add_slider("Divider", 0.0, 1.0, 0.01, settings.divider)
            divider.visible = False

            @layout.on_update
            def _(_: Any) -> None:
                if layout.value not in LAYOUTS:
                    return
                divider.visible = layout.value == "divided"
                # What stands in the scene is drawn where one picture over all of the page has it.
                self._server.scene.set_global_visibility(layout.value != "side by side")
                self._set(layout=layout.value)

            divider.on_update(lambda _: self._set(divider=_kept(divider.value, 0.0, 1.0)))
            self._server.scene.set_global_visibility(settings.layout != "side by side")

    def _add_cameras(self) -> None:
        gui, cameras = self._server.gui, self._stage.cameras
        with gui.add_folder("Training cameras"):
            shown = gui.add_checkbox("Show", True, hint="click one to stand in it")
            size = gui.add_slider("Size", 0.2, 5.0, 0.1, 1.0)
            name = gui.add_dropdown("Stand in", list(cameras), initial_value=next(iter(cameras)))

        def show(_: Any) -> None:
            self._stage.show_cameras(shown.value, _kept(size.value, 0.2, 5.0))

        shown.on_update(show)
        size.on_update(show)

        @name.on_update
        def _(event: Any) -> None:
            if event.client is not None and name.value in cameras:
                stand_in(event.client, cameras[name.value], self._world)

    def _add_crop(self, box: tuple[np.ndarray, np.ndarray], in_ndc: bool) -> None:
        gui = self._server.gui
        with gui.add_folder("Crop box", expand_by_default=False):
            cropped = gui.add_checkbox("Crop", False, hint="to cells of two voxels")
            ranges = [
                gui.add_multi_slider(
                    axis,
                    float(low),
                    float(high),
                    float(high - low) / 200.0,
                    (float(low), float(high)),
                )
                for axis, low, high in zip("xyz", *box, strict=True)
            ]
            clip = gui.add_slider(
                "Clip before", 0.0, 2.0, 0.02, 0.0, hint="what is nearer, in content distances"
            )
            clip.visible = not in_ndc  # whose rays are not cut at distances

        @clip.on_update
        def _(_: Any) -> None:
            self._set(clip=_kept(clip.value, 0.0, 2.0) * self._content_distance)

        def crop(_: Any) -> None:
            ends = np.array([axis.value for axis in ranges]).reshape(3, 2)
            ends = np.clip(np.nan_to_num(ends), box[0][:, None], box[1][:, None])
            corners = (tuple(ends[:, 0]), tuple(ends[:, 1])) if cropped.value else None
            self._stage.show_box(corners)
            self._set(crop=corners)

        cropped.on_update(crop)
        for axis in ranges:
            axis.on_update(crop)

    def _add_path(self) -> None:
        gui, recorder, playing = self._server.gui, self._recorder, threading.Lock()
        with gui.add_folder("Camera path", expand_by_default=False):
            said = gui.add_markdown("")
            seconds = gui.add_slider(
                "Seconds", 0.5, 20.0, 0.5, 2.0, hint="from the last place to the next one"
            )
            add = gui.add_button("Pass here")
            drop = gui.add_button("Forget the last")
            clear = gui.add_button("Forget all")
            play = gui.add_button("Play")
            save = gui.add_button("Save", hint=f"{FILE_NAME}, for warpnerf render RUN --path FILE")

        def show() -> None:
            path = recorder.path
            length = path.seconds if path is not None else 0.0
            count = len(recorder)
            said.content = f"{count} place{'' if count == 1 else 's'}, {length:g} s"
            play.disabled, save.disabled = len(recorder) < 2, len(recorder) < 1
            self._stage.show_path(recorder.line())

        @add.on_click
        def _(event: Any) -> None:
            viewpoint = self._viewpoint_of(event.client_id)
            if viewpoint is not None:
                recorder.add(viewpoint, _kept(seconds.value, 0.5, 20.0))
                show()

        @drop.on_click
        def _(_: Any) -> None:
            recorder.drop()
            show()

        @clear.on_click
        def _(_: Any) -> None:
            recorder.clear()
            show()

        @play.on_click
        def _(event: Any) -> None:
            path = recorder.path
            if path is not None and len(recorder) > 1 and playing.acquire(blocking=False):
                try:
                    preview(event.client, path, self._world, self._server.get_clients)
                finally:
                    playing.release()

        @save.on_click
        def _(event: Any) -> None:
            path = recorder.path
            if path is not None:
                event.client.send_file_download(FILE_NAME, path.to_json(), save_immediately=True)

        show()


def _kept(value: float, low: float, high: float) -> float:
    """A slider's value, within its ends: a page can send any number."""
    return float(np.clip(np.nan_to_num(value, nan=low), low, high))
