"""Pictures of a comparison: views, moments of the trainings, and curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.evaluation.metrics import truth
from warpnerf.evaluation.near_field import PULLED_SHARE
from warpnerf.evaluation.near_plan import near_plan
from warpnerf.media.curves import running_mean
from warpnerf.media.pictures import INK, depth_legend, depth_picture, drawable, font, to_bytes
from warpnerf.media.plots import line_plot
from warpnerf.media.scene_plan import near_picture
from warpnerf.rendering.field import Rendering
from warpnerf.reports.experiment import MOMENTS, Candidate, Experiment
from warpnerf.runs.logs import read_points
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import View

PHOTOGRAPH = "photograph"
"""What the truth is called beside names of configurations."""

PULLED_BACK = "training view, pulled back"

MAX_PIXELS = 640 * 480
"""Of a view, about."""

_GAP, _TITLE, _LABEL = 6, 26, 24

Views = dict[str, dict[str, np.ndarray]]
"""Pictures, [H, W, 3] uint8, by view and then by PHOTOGRAPH or configuration."""


def views_of(experiment: Experiment) -> Views:
    """Two test views and one that is pulled back, by the trainings with seed 0, and their truth.

    A view that is pulled back has a truth where the scene can be photographed again.
    """
    scene, seed = experiment.capture.scene, experiment.seeds[0]
    test = scene.splits["test"]
    views = [scene.views[index] for index in dict.fromkeys((test[0], test[len(test) // 2]))]
    cameras = {view.name: view.camera for view in views}
    cameras[PULLED_BACK] = scene.training_cameras[len(scene.training_cameras) // 2]
    for name, camera in cameras.items():
        cameras[name] = camera.downscaled(camera.block_for(MAX_PIXELS))
    back = PULLED_SHARE * scene.content_distance
    cameras[PULLED_BACK] = cameras[PULLED_BACK].moved_back(back)
    found: Views = {}
    for candidate in experiment.candidates:
        if experiment.failure(candidate, seed) is not None:
            continue
        field = experiment.field(candidate, seed)  # one at a time: they may be large
        if not found:
            found = {v.name: {PHOTOGRAPH: _reduced(truth(v, field.background), v)} for v in views}
            found[PULLED_BACK] = _photographed(experiment, cameras[PULLED_BACK])
        for name, camera in cameras.items():
            found[name][candidate.name] = to_bytes(field.render(camera).rgb)
        del field
    return found


def near_plans_picture(experiment: Experiment) -> np.ndarray | None:
    """Where floaters are, from above: see ``near_plan``; of trainings with seed 0.

    Returns:
        [H, W, 3] uint8; None in normalised device coordinates.
    """
    scene, seed = experiment.capture.scene, experiment.seeds[0]
    plans = {}
    for candidate in experiment.candidates:
        if experiment.failure(candidate, seed) is not None:
            continue
        trained = experiment.run(candidate, seed).read_config().as_trained(scene)
        plan = near_plan(experiment.field(candidate, seed), trained)
        if plan is not None:
            plans[candidate.name] = plan
    return near_picture(scene, plans) if plans else None


def moments_picture(experiment: Experiment) -> np.ndarray | None:
    """Rows: configurations; columns: depth at moments of the training, and the last rendering.

    After Philip & Deschaintre 2023, figure 6. Depths have one range of colours, from 0 to twice the
    content distance.

    Returns:
        [H, W, 3] uint8; None where nothing was rendered.
    """
    far = 2.0 * experiment.capture.scene.content_distance
    rows = [(c, experiment.moments(c)) for c in experiment.candidates]
    rows = [(c, seen) for c, seen in rows if len(seen) == len(MOMENTS)]
    if not rows:
        return None
    height, width = rows[0][1][0].depth.shape
    scale = max(1, round(240 / width))
    height, width = scale * height, scale * width
    n = len(MOMENTS) + 1
    legend = depth_legend(n * (width + _GAP) - _GAP, 0.0, far)
    total = _TITLE + len(rows) * (height + _LABEL + _GAP) + legend.shape[0]
    sheet = Image.new("RGB", (n * (width + _GAP) - _GAP, total), "white")
    draw = ImageDraw.Draw(sheet)
    titles = [f"depth, {100.0 * share:.3g} % of the training" for share in MOMENTS]
    for k, title in enumerate([*titles, "rendering at the end"]):
        draw.text((k * (width + _GAP), 4), title, INK, font(15))
    for number, (candidate, seen) in enumerate(rows):
        top = _TITLE + number * (height + _LABEL + _GAP)
        draw.text((0, top), drawable(candidate.name), INK, font(17))
        for k, panel in enumerate(_panels(seen, far)):
            image = Image.fromarray(panel).resize((width, height), Image.Resampling.NEAREST)
            sheet.paste(image, (k * (width + _GAP), top + _LABEL))
    sheet.paste(Image.fromarray(legend), (0, total - legend.shape[0]))
    return np.asarray(sheet)


def curves_picture(experiment: Experiment) -> np.ndarray:
    """PSNR of the training rays over steps, of each configuration with seed 0, running means."""
    lines = {c.name: _curve(experiment, c) for c in experiment.candidates}
    title = f"training with seed {experiment.seeds[0]}"
    return line_plot(lines, title, ("steps", "PSNR of training rays [dB]"))


def _curve(experiment: Experiment, candidate: Candidate) -> tuple[np.ndarray, np.ndarray]:
    points = read_points(experiment.run(candidate, experiment.seeds[0]).folder / "log.jsonl")
    steps = np.array([point.step for point in points], float)
    psnr = np.array([point.psnr for point in points], float)
    return steps, running_mean(psnr) if points else psnr


def _panels(seen: Sequence[Rendering], far: float) -> list[np.ndarray]:
    depths = [to_bytes(depth_picture(rendering, 0.0, far)) for rendering in seen]
    return [*depths, to_bytes(seen[-1].rgb)]


def _photographed(experiment: Experiment, camera: Camera) -> dict[str, np.ndarray]:
    """The truth of a camera that took no photograph, where there is one."""
    scene = experiment.capture.scene
    image = None if scene.photograph is None else scene.photograph(camera)
    return {} if image is None else {PHOTOGRAPH: image}


def _reduced(rgb: np.ndarray, view: View) -> np.ndarray:
    """A photograph, blocks of its pixels averaged as ``Camera.downscaled`` has it, uint8."""
    edge = view.camera.block_for(MAX_PIXELS)
    h, w = rgb.shape[0] // edge, rgb.shape[1] // edge
    blocks = rgb[: h * edge, : w * edge].reshape(h, edge, w, edge, 3)
    return to_bytes(blocks.mean(axis=(1, 3)))
