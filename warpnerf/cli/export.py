"""`warpnerf export`: a trained scene as files for other programs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from warpnerf.checks import InputError
from warpnerf.cli.arguments import Corners, RunFolder
from warpnerf.runtime.progress import ProgressBar

if TYPE_CHECKING:
    from warpnerf.blocks.folder import BlockFolder as Blocks


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is exported of a run, and how."""

    level: float | None = None
    """Density of the surface, 1 / scene unit; by default that of which a voxel edge is 20 %
    opaque."""
    crop: Corners = None
    """Two corners of the box that is written, scene units; by default what the cameras see, for
    splats all of space."""
    min_size: float | None = None
    """Parts of a surface are dropped whose box has a shorter diagonal, scene units; by default
    eight voxel edges."""
    fill: float | None = None
    """Holes of a surface are closed whose box has a diagonal of at most this, scene units; by
    default eight voxel edges; 0: none."""
    faces: int | None = None
    """Triangles of the mesh, about; by default two for each voxel that it crosses."""
    texture: bool = False
    """Give a .glb texture coordinates and a texture, which more programs show than vertex
    colours."""
    pinhole: bool = False
    """Undistort the photographs of a folder, for programs that read no other lenses."""
    unseen: bool = False
    """Also write what no training camera sees."""


def export_command(
    folder: RunFolder,
    files: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE [FILE ...]")
    ],
    options: Options,
    /,
    scene: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Write a trained run for other programs, as the endings of the files' names say.

    .glb, .ply, .obj: a mesh with colours. .points.ply: points with normals and colours.
    .splat.ply, .spz: Gaussian splats. .html: a page that shows splats in any browser, offline.
    .nvdb, .npz: density on a grid. A name without an ending: a folder with photographs, cameras as
    transforms.json and COLMAP text, and points.

    Args:
        folder: Output folder of a training run, or of blocks.
        files: Where to write; a file is replaced, a folder has to be new. Several take little
            longer than one, and either all are written or none is.
        options: What, and how.
        scene: Where the run's photographs are now, if they have moved.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.blocks.folder import BlockFolder, open_trained
    from warpnerf.exporting.cameras import camera_model
    from warpnerf.exporting.export import (
        CENTRED,
        FORMATS,
        ExportOptions,
        checked_ending,
        export_all,
    )
    from warpnerf.runs.scene import load_run_scene
    from warpnerf.scenes.formats.georeference import in_words

    if not files:
        raise InputError("export: name at least one file to write, such as scene.glb.")
    run = open_trained(folder)
    if isinstance(run, BlockFolder):
        return _export_blocks(run, files, options, scene, device, threads)
    config = run.read_config()
    crop = options.crop
    endings = [checked_ending(file) for file in files]
    field, notes = run.load_field(device, threads)
    for note in notes:
        print(f"warpnerf: note: {note}", file=sys.stderr)
    views = load_run_scene(config, scene, threads)
    n_cameras = len(views.training_cameras)
    grid = " x ".join(map(str, field.lattice.size))
    kinds = dict.fromkeys(FORMATS[ending] for ending in endings)
    *most, last = (kind if kind.endswith("s") else f"a {kind}" for kind in kinds)
    what = f"{', '.join(most)} and {last}" if most else last
    print(f"exporting a grid of {grid} nodes as {what}", flush=True)
    with ProgressBar("first training camera") as bar:

        def on_camera(done: int) -> None:
            text = f"looked through {done} of {n_cameras} training cameras"
            bar.report(done / n_cameras, text)

        try:
            export_all(
                field,
                files,
                scene=views,
                unseen=options.unseen,
                level=options.level,
                crop=None if crop is None else (crop[:3], crop[3:]),
                min_size=options.min_size,
                options=ExportOptions(
                    fill=options.fill,
                    n_faces=options.faces,
                    texture=options.texture,
                    pinhole=options.pinhole,
                ),
                on_camera=on_camera,
                cache=run.visibility_file,
            )
        except OSError as error:
            raise InputError(
                f"{error.filename or files[0]} cannot be written: {error.strerror or error}; name "
                "another place, or make room."
            ) from error
    for file in files:
        print(f"wrote {file}")
    centred = ", ".join(ending for ending in CENTRED if ending in endings)
    turned = ", in .spz turned so that y points up" if ".spz" in endings else ""
    if views.offset is not None and centred:
        print(
            f"note: coordinates in {centred} are those of the capture's file less "
            f"{in_words(views.offset)}, for single precision{turned}; .ply, .obj, .npz and a "
            "folder have the file's own"
        )
    bent = any(camera_model(camera) != "PINHOLE" for camera in views.cameras)
    if "" in endings and bent and not options.pinhole:
        print(
            "note: the lenses have distortion, as in the photographs; 3DGS reads PINHOLE only: "
            "--pinhole writes such a folder, with the photographs undistorted"
        )
    return 0


def _export_blocks(
    blocks: Blocks,
    files: tuple[Path, ...],
    options: Options,
    scene: str | None,
    device: str,
    threads: int | None,
) -> int:
    """Write a scene in blocks, of which not all can be written that can of a run."""
    from warpnerf.exporting.blocks import OfCores, export_blocks

    for name, given in (
        ("--scene", scene is not None),
        ("--crop", options.crop is not None),
        ("--faces", options.faces is not None),
        ("--texture", options.texture),
        ("--pinhole", options.pinhole),
    ):
        if given:
            raise InputError(
                f"{name} is for the export of one run, and {blocks.folder} has {len(blocks)}; "
                f"leave it out, or export one of them, such as {blocks.run(0).folder}."
            )
    how = OfCores(
        unseen=options.unseen, level=options.level, min_size=options.min_size, fill=options.fill
    )
    with ProgressBar("first block") as bar:

        def on_block(done: int) -> None:
            bar.report(done / len(blocks), f"{done} of {len(blocks)} blocks")

        try:
            empty = export_blocks(blocks, files, how, device, threads, on_block)
        except OSError as error:
            raise InputError(
                f"{error.filename or files[0]} cannot be written: {error.strerror or error}; name "
                "another place, or make room."
            ) from error
    for sentence in empty:
        print(f"note: {sentence}")
    for file in files:
        print(f"wrote {file}")
    return 0
