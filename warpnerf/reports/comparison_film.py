"""The film of a comparison: a camera that backs away, configurations side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.media.camera_path import BACK_SHARE, backing_away, path_lens
from warpnerf.media.pictures import INK, depth_legend, depth_picture, font, to_bytes
from warpnerf.rendering.field import Rendering
from warpnerf.reports.experiment import Experiment
from warpnerf.scenes.cameras.camera import Camera

FILM = "floaters.mp4"
"""Its file; see ``video_file``."""

FPS = 20.0
N_FRAMES = 40
"""From one camera."""

LONGER_SIDE = 320
"""Pixels of a rendering, where there is room for it."""

MAX_SHARE = 2.0
"""Of the photographs' sides: of small ones a rendering has no more detail."""

MAX_WIDTH = 1920
"""Pixels of all renderings side by side, about."""

_GAP, _TITLE = 6, 26


def film_path(experiment: Experiment, cameras: Sequence[Camera], distance: float) -> list[Camera]:
    """Each of some cameras as it backs away, one after the other.

    Args:
        experiment: Its configurations share the width of a frame.
        cameras: Where it begins.
        distance: How far it gets, scene units.
    """
    longer = min(LONGER_SIDE, MAX_WIDTH // len(experiment.candidates))
    share = min(MAX_SHARE, longer / max(cameras[0].width, cameras[0].height))
    size = max(1, round(share * cameras[0].width)), max(1, round(share * cameras[0].height))
    lenses = [path_lens([camera], size) for camera in cameras]
    return [moved for lens in lenses for moved in backing_away(lens, distance, N_FRAMES)]


def usual_path(experiment: Experiment) -> list[Camera]:
    """The middle one of the training cameras as it backs away, by BACK_SHARE content distances."""
    scene = experiment.capture.scene
    cameras = scene.training_cameras
    distance = BACK_SHARE * scene.content_distance
    return film_path(experiment, [cameras[len(cameras) // 2]], distance)


def film_frames(
    experiment: Experiment,
    cameras: Sequence[Camera],
    on_progress: Callable[[float, str], None] = lambda done, words: None,
) -> Iterator[np.ndarray]:
    """Frames: a column for each configuration, with colour above depth, of trainings with seed 0.

    Depths have one range of colours, from 0 to twice the content distance.

    Args:
        experiment: One of its trainings, at least, has a field.
        cameras: One for each frame, all of one size.
        on_progress: Called with the share that is done, and a few words.

    Returns:
        [H, W, 3] uint8 each.
    """
    far, seed = 2.0 * experiment.capture.scene.content_distance, experiment.seeds[0]
    there = [c for c in experiment.candidates if experiment.failure(c, seed) is None]
    columns: list[list[np.ndarray]] = []
    for candidate in there:
        field = experiment.field(candidate, seed)  # one at a time: they may be large
        column = []
        for camera in cameras:
            column.append(_above_each_other(field.render(camera), far))
            done = (len(columns) * len(cameras) + len(column)) / (len(there) * len(cameras))
            on_progress(done, f"filming {candidate.name}")
        columns.append(column)
        del field
    titles = [candidate.name for candidate in there]
    for panels in zip(*columns, strict=True):
        yield _frame(titles, panels, far)


def _above_each_other(rendering: Rendering, far: float) -> np.ndarray:
    """Colour above depth, [2 H + gap, W, 3] uint8."""
    colour, depth = to_bytes(rendering.rgb), to_bytes(depth_picture(rendering, 0.0, far))
    gap = np.full((_GAP, *colour.shape[1:]), 255, np.uint8)
    return np.concatenate([colour, gap, depth])


def _frame(titles: Sequence[str], panels: Sequence[np.ndarray], far: float) -> np.ndarray:
    height, width = panels[0].shape[:2]
    legend = depth_legend(len(panels) * (width + _GAP) - _GAP, 0.0, far)
    frame = Image.new("RGB", (legend.shape[1], _TITLE + height + legend.shape[0]), "white")
    draw = ImageDraw.Draw(frame)
    for column, (title, panel) in enumerate(zip(titles, panels, strict=True)):
        left = column * (width + _GAP)
        size = int(np.clip(1.7 * width / len(title), 6, 16))
        draw.text((left + width / 2, _TITLE / 2), title, INK, font(size), anchor="mm")
        frame.paste(Image.fromarray(panel), (left, _TITLE))
    frame.paste(Image.fromarray(legend), (0, _TITLE + height))
    return np.asarray(frame)
