"""Compare configurations on a capture: trainings with equal seeds, then a report."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from warpnerf.checks import InputError, cannot_write
from warpnerf.evaluation.evaluate import require_measurable
from warpnerf.media.overlap_plots import overlap_plots
from warpnerf.media.pictures import picture_files, png
from warpnerf.media.video import video_file, write_video
from warpnerf.reports.comparison import Row, compare_figures, figures_to_json
from warpnerf.reports.comparison_film import FILM, FPS, film_frames, usual_path
from warpnerf.reports.comparison_page import comparison_page
from warpnerf.reports.comparison_pictures import (
    curves_picture,
    moments_picture,
    near_plans_picture,
    views_of,
)
from warpnerf.reports.experiment import Experiment
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene
from warpnerf.writing import write_atomically

PAGE, RECORD = "report.html", "figures.json"


def require_comparable(scene: Scene) -> None:
    """Raise InputError unless configurations can be compared on a scene's test views.

    Raises:
        InputError: There are fewer than two, or they are too small.
    """
    n = len(scene.splits.get("test", ()))
    if n < 2:
        held = "no test views" if n == 0 else "one test view"
        raise InputError(
            f"{scene.name} has {held}, and a comparison needs two or more; withhold more "
            "photographs by --split."
        )
    require_measurable(scene, "test")


def write_comparison(
    experiment: Experiment,
    on_progress: Callable[[float, str], None] = lambda done, words: None,
    path: Sequence[Camera] | None = None,
) -> list[Row]:
    """Write the report of an experiment that has finished.

    report.html holds all of it in one file; figures.json the figures; beside them moments.png,
    near.png, curves.png, cameras.png, sampling.png, floaters.mp4 (.gif where PyAV is missing), and
    views/ with renderings and photographs. Pictures are of trainings with seed 0 that have not
    failed.

    Args:
        experiment: All of its trainings have ended.
        on_progress: Called with the share that is done, and a few words.
        path: Cameras of the film; None: ``usual_path``.

    Returns:
        Figures and differences.

    Raises:
        InputError: The files cannot be written.
    """
    folder, scene = experiment.folder, experiment.capture.scene
    rows = compare_figures(experiment)
    on_progress(0.05, "rendering views")
    views = views_of(experiment)
    film = None
    if any(experiment.failure(c, experiment.seeds[0]) is None for c in experiment.candidates):
        film, _ = video_file(folder / FILM, FPS)
        frames = film_frames(
            experiment,
            usual_path(experiment) if path is None else path,
            lambda done, words: on_progress(0.2 + 0.7 * done, words),
        )
        try:
            write_video(film, frames, FPS)
        except OSError as error:
            raise cannot_write(f"--output {folder}", error) from error
    on_progress(0.9, "drawing")
    plots = {name.removesuffix(".png"): plot for name, plot in overlap_plots(scene).items()}
    pictures = plots | {"curves": curves_picture(experiment)}
    drawn = {"moments": moments_picture(experiment), "near": near_plans_picture(experiment)}
    pictures |= {name: picture for name, picture in drawn.items() if picture is not None}
    files = {f"{name}.png": png(picture) for name, picture in pictures.items()}
    stems = picture_files(list(views), stems=True)
    for view, of_view in views.items():
        for name, picture in of_view.items():
            files[f"views/{Path(stems[view]).stem}-{name}.png"] = png(picture)
    record = figures_to_json(experiment, rows)
    files[RECORD] = (json.dumps(record, indent=2) + "\n").encode()
    title = f"{scene.name}: {len(rows)} configurations compared"
    files[PAGE] = comparison_page(
        title, _what(experiment), rows, views, pictures, film, experiment.seeds[0]
    )
    try:
        (folder / "views").mkdir(exist_ok=True)
        for name, content in files.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise cannot_write(f"--output {folder}", error) from error
    on_progress(1.0, "written")
    return rows


def _what(experiment: Experiment) -> str:
    """A sentence on what was trained."""
    scene, n = experiment.capture.scene, len(experiment.seeds)
    lengths = {
        f"{c.config.time_limit:g} s" if c.config.time_limit else f"{c.config.steps} steps"
        for c in experiment.candidates
    }
    each = lengths.pop() if len(lengths) == 1 else "as long as its preset says"
    return (
        f"{len(scene.splits['train'])} training and {len(scene.splits['test'])} test views. Each "
        f"configuration was trained with {n} {'seed' if n == 1 else 'seeds'}, each training "
        f"{each}. The runs are in runs/: warpnerf view shows two of them side by side."
    )
