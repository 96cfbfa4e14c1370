"""What a run's evaluation leaves in its folder: figures, pictures of views, a sheet of a few."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from warpnerf.evaluation.evaluate import Evaluation, evaluate
from warpnerf.evaluation.sight import SurfaceVisibility
from warpnerf.media.contact_sheet import SheetRow, contact_sheet, spread
from warpnerf.media.filming import depth_range, range_of
from warpnerf.media.pictures import comparison, picture_files, write_png
from warpnerf.rendering.field import Field, Rendering
from warpnerf.runs.files import SHEET
from warpnerf.scenes.scene import Scene, View, require_split
from warpnerf.writing import write_atomically


def evaluate_into(
    folder: Path,
    field: Field,
    scene: Scene,
    split: str,
    writing: Callable[[], AbstractContextManager[None]],
    on_progress: Callable[[float, str], None],
    measures: bool | SurfaceVisibility = False,
) -> Evaluation:
    """Measure a split, and write metrics.json, its pictures, and a sheet of a few of them.

    All show depths in the same colours, over the range of the true depths where they are known
    for all views, else of what their cameras see.

    Args:
        folder: Of the run.
        field: What it trained.
        scene: Its photographs.
        split: Which of them.
        writing: Is entered whenever files are written, and says what to do where they cannot be.
        on_progress: As of ``evaluate``.
        measures: As of ``evaluate``.
    """
    views = [scene.views[index] for index in require_split(scene, split)]
    files = picture_files([view.name for view in views])
    near, far = _depths(field, views)
    on_sheet = {views[index].name for index in spread(len(views))}
    seen: dict[str, tuple[View, np.ndarray, Rendering]] = {}

    def picture(view: View, target: np.ndarray, rendering: Rendering) -> None:
        path = folder / "test" / files[view.name]
        with writing():
            write_png(path, comparison(target, rendering, near, far, view.mask))
        if view.name in on_sheet:
            seen[view.name] = view, target, rendering

    with writing():
        (folder / "test").mkdir(exist_ok=True)
    result = evaluate(field, scene, split, picture, on_progress=on_progress, measures=measures)
    rows = [
        SheetRow(
            name=image.name,
            psnr=image.psnr,
            target=seen[image.name][1],
            rendering=seen[image.name][2],
            depth=seen[image.name][0].depth,
            mask=seen[image.name][0].mask,
        )
        for image in result.images
        if image.name in seen
    ]
    kind = "training" if split == "train" else split
    title = f"{scene.name}: {len(rows)} of {len(views)} {kind} views"
    if split == "train" and not scene.splits.get("test"):
        title += ", as there are no test views"
    with writing():
        write_png(folder / SHEET, contact_sheet(rows, title, near, far))
        write_atomically(folder / "metrics.json", result.to_json().encode())
    return result


def _depths(field: Field, views: list[View]) -> tuple[float, float]:
    """Nearest and furthest that pictures show: of true depths, or else of what cameras see."""
    depths = (view.depth for view in views)
    known = [depth[np.isfinite(depth)] for depth in depths if depth is not None]
    if len(known) == len(views) and any(depth.size for depth in known):
        return range_of(np.concatenate(known))
    return depth_range(field, [view.camera for view in views])
