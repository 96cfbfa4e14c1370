"""`warpnerf export`: a trained scene as a file for other programs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from warpnerf.checks import InputError
from warpnerf.cli.arguments import Corners, RunFolder
from warpnerf.runtime.progress import ProgressBar


def export_command(
    folder: RunFolder,
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    /,
    level: float | None = None,
    crop: Corners = None,
    min_size: float | None = None,
    unseen: bool = False,
    scene: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Write a trained run for other programs, as the ending of the file's name says.

    .glb, .ply, .obj: a mesh with colours. .points.ply: points with normals and colours.
    .splat.ply: Gaussian splats. .html: a page that shows splats in any browser, offline.
    .nvdb, .npz: density on a grid. A name without an ending: a folder with photographs, cameras as
    transforms.json and COLMAP text, and points.

    Args:
        folder: Output folder of a training run.
        file: Where to write; a file is replaced, a folder has to be new.
        level: Density of the surface, 1 / scene unit; by default that of which a voxel edge is
            20 % opaque.
        crop: Two corners of the box that is written, scene units; by default what the cameras see,
            for splats all of space.
        min_size: Parts of a surface are dropped whose box has a shorter diagonal, scene units; by
            default eight voxel edges.
        unseen: Also write what no training camera sees.
        scene: Where the run's photographs are now, if they have moved.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.exporting.cameras import camera_model
    from warpnerf.exporting.export import CENTRED, FORMATS, checked_ending, export
    from warpnerf.runs.run import Run
    from warpnerf.runs.scene import load_run_scene
    from warpnerf.scenes.formats.georeference import in_words

    run = Run(folder)
    config = run.read_config()
    ending = checked_ending(file)
    kind = FORMATS[ending]
    field, notes = run.load_field(device, threads)
    for note in notes:
        print(f"warpnerf: note: {note}", file=sys.stderr)
    views = load_run_scene(config, scene, threads)
    n_cameras = len(views.training_cameras)
    grid = " x ".join(map(str, field.lattice.size))
    what = kind if kind.endswith("s") else f"a {kind}"
    print(f"exporting a grid of {grid} nodes as {what}", flush=True)
    with ProgressBar("first training camera") as bar:

        def on_camera(done: int) -> None:
            text = f"looked through {done} of {n_cameras} training cameras"
            bar.report(done / n_cameras, text)

        try:
            export(
                field,
                file,
                scene=views,
                unseen=unseen,
                level=level,
                crop=None if crop is None else (crop[:3], crop[3:]),
                min_size=min_size,
                on_camera=on_camera,
            )
        except OSError as error:
            raise InputError(
                f"{file} cannot be written: {error.strerror or error}; name another place, or make "
                "room."
            ) from error
    print(f"wrote {file}")
    if views.offset is not None and ending in CENTRED:
        print(
            f"note: its coordinates are those of the capture's file less {in_words(views.offset)}, "
            "for single precision; .ply, .obj, .npz and a folder have the file's own"
        )
    if ending == "" and any(camera_model(camera) != "PINHOLE" for camera in views.cameras):
        print(
            "note: the lenses have distortion, as in the photographs; 3DGS reads PINHOLE only: "
            f"colmap image_undistorter --image_path {file}/images --input_path {file}/sparse/0 "
            "--output_path NEW makes such a folder of it"
        )
    return 0
