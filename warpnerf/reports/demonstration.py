"""What distance scaling does, shown: builtin:room-sparse, trained without it and with it.

It is a comparison with a small budget. The model is rgb: colour that depends on the direction of
view can hide a floater from cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.checked import checked_arguments
from warpnerf.checks import cannot_write, require_whole
from warpnerf.config import LossConfig, Scaling, TrainConfig
from warpnerf.media.camera_path import backing_away
from warpnerf.media.pictures import (
    FAINT,
    INK,
    depth_legend,
    depth_picture,
    font,
    to_bytes,
    write_png,
)
from warpnerf.media.video import video_file
from warpnerf.model.models import Rgb
from warpnerf.rendering.field import Field, Rendering
from warpnerf.reports.compare import PAGE, RECORD, require_comparable, write_comparison
from warpnerf.reports.comparison import FIGURES, Row
from warpnerf.reports.comparison_film import FILM, FPS, film_path
from warpnerf.reports.experiment import Candidate, Capture, Experiment, require_free
from warpnerf.runtime.terminal import table_text
from warpnerf.scenes.builtin.room import photograph
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene

SOURCE = "builtin:room-sparse"

NAMES: dict[Scaling, str] = {"none": "without-scaling", "clamped": "with-scaling"}
"""What is compared, and what it is called."""

STEPS = 2500
"""Of each training, not seconds: both get the same, however busy the machine, and on the CPU the
same result on another day. About a minute on two cores."""

CAMERAS = ("train_27.png", "train_17.png", "train_16.png")
"""Training views that the film backs away from, chosen because there is room behind them and the
difference is easy to see; the picture shows the first. The table is of all views."""

BACK = 1.2
"""How far it backs away, metres."""

PICTURE_SIZE = (400, 300)
PICTURE = "floaters.png"
_LABELS = 210
_GAP = 8

Report = Callable[[str, float, str], None]
"""Told what is being done and why, the fraction of it that is done, and a few words."""


ELSEWHERE = "scaling keeps space before training cameras free, and test cameras stand elsewhere"

PASSES = "light that no longer ends in front may pass the surface as well"

SHOWN: dict[str, tuple[int, str | None]] = {
    "psnr": (1, None),
    "ssim": (1, None),
    "pulled_psnr": (1, None),
    "seen_psnr": (1, None),
    "coverage": (1, None),
    "seen_depth_error": (-1, "light that ends in front, on test rays, makes depths too short"),
    "front_train": (-1, None),
    "hit_train": (1, None),
    "behind_train": (-1, PASSES),
    "transmitted_train": (-1, PASSES),
    "front_test": (-1, ELSEWHERE),
    "hit_test": (1, "what ends in front, on test rays, does not reach surfaces"),
    "behind_test": (-1, PASSES),
    "transmitted_test": (-1, PASSES),
    "near_mass": (-1, None),
    "near_density": (-1, None),
}
"""Lines of the table: names in ``FIGURES``, whether more (1) or less (-1) is better in a closed
room, and why it may not be so with the scaling."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Demo:
    """What the demonstration found, and what it wrote."""

    rows: Sequence[Row]
    """Figures of each seed, without and with scaling."""
    fields: dict[Scaling, Field]
    """The fields trained with seed 0."""
    picture: Path
    """Truth, without and with scaling: colour and depth."""
    video: Path
    """A camera that backs away, without and with scaling side by side."""
    record: Path
    """The figures in JSON."""
    page: Path
    """The comparison's report in HTML."""

    @property
    def figures(self) -> dict[Scaling, dict[str, float]]:
        """Means over seeds by scaling and by name in ``FIGURES``, and ``seconds`` of training."""
        return {
            scaling: {name: float(np.mean(values)) for name, values in row.values.items()}
            | {"seconds": float(np.mean(row.seconds))}
            for scaling, row in zip(NAMES, self.rows, strict=True)
        }

    def __str__(self) -> str:
        """A table, and why figures are no better with the scaling."""
        without, scaled = self.figures.values()
        lines: list[list[str]] = []
        rest: dict[str | None, list[str]] = {}
        for name, (better, otherwise) in SHOWN.items():
            digits = FIGURES[name].digits
            values = without[name], scaled[name]
            gain = round(better * (values[1] - values[0]), digits)
            heading = FIGURES[name].heading
            if gain <= 0.0:
                rest.setdefault(otherwise, []).append(heading.partition(" [")[0])
            numbers = [f"{value:.{digits}f}" for value in values]
            lines.append([heading, *numbers, "better" if gain > 0.0 else "no better"])
        seconds = (f"{of['seconds']:.0f}" for of in (without, scaled))
        lines.append(["seconds of training", *seconds, ""])
        table = table_text(["", *map(_said, NAMES.values()), ""], lines)
        return "\n".join([table, *(_no_better(why, names) for why, names in rest.items())])


@checked_arguments
def demo(
    output: str | Path,
    *,
    steps: int = STEPS,
    seeds: int = 1,
    downscale: int = 1,
    device: str = "cpu",
    threads: int | None = None,
    report: Report = lambda *_: None,
) -> Demo:
    """Train builtin:room-sparse without and with distance scaling, and show what differs.

    Few views see each place, which is where floaters grow. Same photographs, seeds and steps for
    both, near plane 0. The folder is that of a comparison, with floaters.png besides; called again,
    it continues, and repeats no training.

    Args:
        output: Folder; made if it does not exist.
        steps: Of each training.
        seeds: How many trainings of each, with seeds 0, 1, ...
        downscale: Of the photographs.
        device: Where to train.
        threads: CPU threads; None: one per usable core.
        report: Told how far it is.

    Returns:
        Figures and fields by scaling, and where the files are.

    Raises:
        InputError: The folder cannot be written to or holds other files, or the device is missing.
        FloatingPointError: A training failed.
    """
    made = demonstration(
        output, steps=steps, seeds=seeds, downscale=downscale, device=device, threads=threads
    )
    for candidate, seed in made.trials:
        stage = f"training {_said(candidate.name)}, seed {seed}"
        made.train(candidate, seed, on_progress=partial(report, stage))
    return write_demonstration(made, partial(report, "showing both"))


def demonstration(
    output: str | Path,
    *,
    steps: int,
    seeds: int,
    downscale: int,
    device: str,
    threads: int | None,
) -> Experiment:
    """Begin the demonstration's experiment, or continue it; arguments as of ``demo``.

    Raises:
        InputError: As ``demo``.
    """
    require_whole("steps", steps, 1)
    require_whole("seeds", seeds, 1)
    folder = Path(output)
    require_free(folder)
    scene = load_scene(SOURCE, downscale=downscale)
    require_comparable(scene)
    candidates = [
        Candidate(
            name=name,
            config=TrainConfig(
                model=Rgb(),
                loss=LossConfig(),
                steps=steps,
                scaling=scaling,
                device=device,
                threads=threads,
            ),
            against=None if scaling == "none" else NAMES["none"],
        )
        for scaling, name in NAMES.items()
    ]
    capture = Capture(scene=scene, source=SOURCE, downscale=downscale)
    made = Experiment(folder, capture, candidates, seeds)
    made.begin()
    return made


def write_demonstration(
    made: Experiment, on_progress: Callable[[float, str], None] = lambda done, words: None
) -> Demo:
    """Write the report of a demonstration whose trainings have ended, and its picture.

    Args:
        made: By ``demonstration``.
        on_progress: Called with the share that is done, and a few words.

    Raises:
        InputError: The files cannot be written.
        FloatingPointError: A training failed.
    """
    for trial in made.trials:
        failure = made.failure(*trial)
        if failure is not None:
            raise FloatingPointError(failure)
    scene, folder = made.capture.scene, made.folder
    cameras = [_camera(scene, name) for name in CAMERAS]
    rows = write_comparison(made, on_progress, film_path(made, cameras, BACK))
    fields = {
        scaling: made.field(candidate, made.seeds[0])
        for scaling, candidate in zip(NAMES, made.candidates, strict=True)
    }
    result = Demo(
        rows=rows,
        fields=fields,
        picture=folder / PICTURE,
        video=video_file(folder / FILM, FPS)[0],
        record=folder / RECORD,
        page=folder / PAGE,
    )
    far = 2.0 * scene.content_distance
    try:
        write_png(result.picture, comparison_picture(scene, fields, result.figures, far))
    except OSError as error:
        raise cannot_write(f"--output {folder}", error) from error
    return result


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
    camera = backing_away(_resized(_camera(scene, CAMERAS[0]), PICTURE_SIZE), BACK, 2)[-1]
    rgb, depth = photograph(camera, samples=3)
    truth = Rendering(rgb=rgb / 255.0, depth=depth, opacity=np.ones_like(depth))
    rows = [("the truth", [f"{BACK:g} m behind", "a training camera"], truth)]
    for scaling, name in NAMES.items():
        row = figures[scaling]
        words = [
            "all test views:",
            f"PSNR {row['psnr']:.2f} dB",
            f"SSIM {row['ssim']:.3f}",
            f"pulled back {row['pulled_psnr']:.2f} dB",
            "rays of training views:",
            f"{row['front_train']:.1%} of light ends",
            "in front of surfaces",
        ]
        rows.append((_said(name), words, fields[scaling].render(camera)))

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


def _panels(rendering: Rendering, far: float) -> list[Image.Image]:
    """Colour and depth."""
    panels = rendering.rgb, depth_picture(rendering, 0.0, far)
    return [Image.fromarray(to_bytes(panel)) for panel in panels]


def _no_better(why: str | None, headings: Sequence[str]) -> str:
    """A sentence on figures that are no better with the scaling."""
    rest = "with these seeds and steps" if why is None else f"as {why}"
    return f"{'; '.join(headings)}: no better, {rest}."


def _said(name: str) -> str:
    """What a configuration is called in a picture or table."""
    return name.replace("-", " ")


def _camera(scene: Scene, name: str) -> Camera:
    """A training camera."""
    return next(view.camera for view in scene.views if view.name == name)


def _resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """A camera with another number of pixels."""
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
