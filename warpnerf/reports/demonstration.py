"""What distance scaling does, shown: builtin:room-sparse, trained without it and with it.

The model is rgb: colour that depends on the direction of view can hide a floater from cameras.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, cannot_write, require_whole
from warpnerf.config import LossConfig, Scaling, TrainConfig
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.evaluation.floater_metrics import near_density
from warpnerf.media.camera_path import backing_away
from warpnerf.media.pictures import FAINT, INK, depth_legend, depth_picture, font, write_png
from warpnerf.media.video import video_file, write_video
from warpnerf.model.models import Rgb
from warpnerf.rendering.field import Field, Rendering
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene
from warpnerf.training.state import Progress
from warpnerf.training.train import train
from warpnerf.writing import write_atomically

SCALINGS: dict[Scaling, str] = {"none": "without scaling", "clamped": "with scaling"}
"""What is compared, and what it is called."""

STEPS = 2500
"""Of each training, not seconds: both get the same, however busy the machine, and on the CPU the
same result on another day. About a minute on two cores."""

CAMERAS = ("train_27.png", "train_17.png", "train_16.png")
"""Training views that the film backs away from, chosen because there is room behind them and the
difference is easy to see; the picture shows the first. The table is of all views."""

BACK = 1.2
"""How far it backs away, metres."""

FRAMES_PER_CAMERA, FPS = 60, 24.0
FRAME_SIZE = (256, 192)
PICTURE_SIZE = (400, 300)
_LABELS = 210
_GAP = 8

OWN_FILES = {"floaters.png", "floaters.mp4", "floaters.gif", "figures.json"}
"""What an older demonstration may have left."""

Report = Callable[[str, float, str], None]
"""Told what is being done and why, the fraction of it that is done, and a few words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Demo:
    """What the demonstration found, and what it wrote."""

    figures: dict[Scaling, dict[str, float]]
    """psnr [dB], ssim, depth_error [m] of the test views, near_density, and seconds of training, by
    scaling."""
    fields: dict[Scaling, Field]
    """The trained fields."""
    picture: Path
    """Truth, without and with scaling: colour and depth."""
    video: Path
    """A camera that backs away, without and with scaling side by side."""
    record: Path
    """The figures in JSON."""

    def __str__(self) -> str:
        """A table."""
        lines = [f"{'':16}   PSNR    SSIM  depth error [m]  density near cameras  seconds"]
        for scaling, name in SCALINGS.items():
            row = self.figures[scaling]
            lines.append(
                f"{name:16}  {row['psnr']:5.2f}  {row['ssim']:.4f}  {row['depth_error']:15.3f}  "
                f"{row['near_density']:20.4f}  {row['seconds']:7.0f}"
            )
        return "\n".join(lines)


@checked_arguments
def demo(
    output: str | Path,
    *,
    steps: int = STEPS,
    downscale: int = 1,
    device: str = "cpu",
    threads: int | None = None,
    report: Report = lambda *_: None,
) -> Demo:
    """Train builtin:room-sparse without and with distance scaling, and show what differs.

    Few views see each place, which is where floaters grow. Same photographs, seed and steps for
    both, near plane 0. The folder receives floaters.png, floaters.mp4 (.gif where PyAV is missing)
    and figures.json; older ones are replaced.

    Args:
        output: Folder; made if it does not exist.
        steps: Of each training.
        downscale: Of the photographs.
        device: Where to train.
        threads: CPU threads; None: one per usable core.
        report: Told how far it is.

    Returns:
        Figures and fields by scaling, and where the files are.

    Raises:
        InputError: The folder cannot be written to or holds other files, or the device is missing.
    """
    require_whole("steps", steps, 1)
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        others = sorted({path.name for path in folder.iterdir()} - OWN_FILES)
    except OSError as error:
        raise cannot_write(f"--output {folder}", error) from error
    if others:
        raise InputError(f"--output {folder} holds other files ({others[0]}); name a new folder.")
    video, _ = video_file(folder / "floaters.mp4", FPS)
    report("tracing the photographs of the built-in room", 0.0, "")
    scene = load_scene("builtin:room-sparse", downscale=downscale)
    fields: dict[Scaling, Field] = {}
    figures: dict[Scaling, dict[str, float]] = {}
    for scaling in SCALINGS:
        config = TrainConfig(
            model=Rgb(),
            loss=LossConfig(),
            steps=steps,
            scaling=scaling,
            device=device,
            threads=threads,
        )
        field, seconds = _trained(scene, config, report)
        report(f"measuring the field {SCALINGS[scaling]}", 0.0, "")
        fields[scaling] = field
        figures[scaling] = evaluate(field, scene, "test").mean | {
            "near_density": near_density(field, scene.training_cameras, first_hit),
            "seconds": seconds,
        }
    far = 2.0 * scene.content_distance
    picture = folder / "floaters.png"
    write_png(picture, comparison_picture(scene, fields, figures, far))
    write_video(video, _film(scene, fields, far, report), FPS)
    record = {"steps": steps, "downscale": downscale, "figures": figures}
    write_atomically(folder / "figures.json", (json.dumps(record, indent=2) + "\n").encode())
    return Demo(
        figures=figures,
        fields=fields,
        picture=picture,
        video=video,
        record=folder / "figures.json",
    )


def comparison_picture(
    scene: Scene,
    fields: dict[Scaling, Field],
    figures: dict[Scaling, dict[str, float]],
    far: float,
) -> np.ndarray:
    """Rows: truth, without, with; columns: colour and depth, from ``BACK`` behind a camera.

    Args:
        scene: builtin:room-sparse.
        fields: By scaling.
        figures: As in ``Demo``; they stand beside the pictures.
        far: Depth of the last colour, metres.

    Returns:
        [H, W, 3] uint8.
    """
    camera = backing_away(_camera(scene, CAMERAS[0], PICTURE_SIZE), BACK, 2)[-1]
    rgb, depth = photograph(camera, samples=3)
    truth = Rendering(rgb=rgb / 255.0, depth=depth, opacity=np.ones_like(depth))
    rows = [("the truth", [f"{BACK:g} m behind", "a training camera"], truth)]
    for scaling, name in SCALINGS.items():
        row = figures[scaling]
        words = [
            "all test views:",
            f"PSNR {row['psnr']:.2f} dB",
            f"SSIM {row['ssim']:.3f}",
            f"depth error {row['depth_error']:.2f} m",
            "all training cameras:",
            f"density near them {row['near_density']:.3f}",
        ]
        rows.append((name, words, fields[scaling].render(camera)))

    width, height = PICTURE_SIZE
    legend = depth_legend(width, 0.0, far)
    sheet = Image.new(
        "RGB",
        (_LABELS + 2 * (width + _GAP), 3 * (height + _GAP) + _GAP + legend.shape[0]),
        "white",
    )
    draw = ImageDraw.Draw(sheet)
    for number, (name, words, rendering) in enumerate(rows):
        top = _GAP + number * (height + _GAP)
        draw.text((_GAP, top), name, INK, font(24))
        for line, text in enumerate(words):
            draw.text((_GAP, top + 40 + 24 * line), text, FAINT, font(17))
        for column, panel in enumerate(_panels(rendering, far)):
            sheet.paste(panel, (_LABELS + column * (width + _GAP), top))
    sheet.paste(Image.fromarray(legend), (_LABELS + width + _GAP, sheet.height - legend.shape[0]))
    return np.asarray(sheet)


def _trained(scene: Scene, config: TrainConfig, report: Report) -> tuple[Field, float]:
    """A field, and the seconds that it took."""
    stage = f"training {SCALINGS[config.scaling]}"
    report(stage, 0.0, "compiling kernels (once)")

    def on_progress(progress: Progress) -> None:
        text = f"step {progress.step} of {config.steps}  loss {progress.loss:.5f}"
        report(stage, progress.fraction, text)

    result = train(scene, config, on_progress=on_progress)
    return result.field, result.progress.seconds


def _film(
    scene: Scene, fields: dict[Scaling, Field], far: float, report: Report
) -> Iterator[np.ndarray]:
    """Frames: one column for each field, colour above depth."""
    cameras = [
        camera
        for name in CAMERAS
        for camera in backing_away(_camera(scene, name, FRAME_SIZE), BACK, FRAMES_PER_CAMERA)
    ]
    for number, camera in enumerate(cameras):
        yield _frame(fields, camera, far)
        done = number + 1
        text = f"frame {done} of {len(cameras)}"
        report("filming a camera that backs away", done / len(cameras), text)


def _frame(fields: dict[Scaling, Field], camera: Camera, far: float) -> np.ndarray:
    width, height = camera.width, camera.height
    legend = depth_legend(2 * width + _GAP, 0.0, far)
    title = 24
    frame = Image.new(
        "RGB", (legend.shape[1], title + 2 * height + _GAP + legend.shape[0]), "white"
    )
    draw = ImageDraw.Draw(frame)
    for column, (scaling, name) in enumerate(SCALINGS.items()):
        left = column * (width + _GAP)
        draw.text((left + width / 2, title / 2), name, INK, font(16), anchor="mm")
        for row, panel in enumerate(_panels(fields[scaling].render(camera), far)):
            frame.paste(panel, (left, title + row * (height + _GAP)))
    frame.paste(Image.fromarray(legend), (0, frame.height - legend.shape[0]))
    return np.asarray(frame)


def _panels(rendering: Rendering, far: float) -> list[Image.Image]:
    """Colour and depth."""
    panels = (np.clip(rendering.rgb, 0.0, 1.0), depth_picture(rendering, 0.0, far))
    return [Image.fromarray(np.round(255.0 * panel).astype(np.uint8)) for panel in panels]


def _camera(scene: Scene, name: str, size: tuple[int, int]) -> Camera:
    """A training camera with another number of pixels."""
    camera = next(view.camera for view in scene.views if view.name == name)
    scale = size[0] / camera.width
    return replace(
        camera,
        width=size[0],
        height=size[1],
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=0.5 * size[0],
        cy=0.5 * size[1],
    )
