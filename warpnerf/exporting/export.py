"""The entry point of exports: ``export`` writes the format that the name of the file says."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError
from warpnerf.exporting import cameras as scenes
from warpnerf.exporting import mesh, page, splats, surface, volume
from warpnerf.exporting.visibility import visibility
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.focus import up_direction
from warpnerf.scenes.scene import Scene
from warpnerf.writing import write_atomically

SURFACES = (".glb", ".obj", ".ply", ".points.ply", "")
SPLATS = (".splat.ply", ".html")
VOLUMES = (".nvdb", ".npz")
FORMATS = {
    ".glb": "mesh",
    ".obj": "mesh",
    ".ply": "mesh",
    ".points.ply": "points",
    ".splat.ply": "splats",
    ".html": "page",
    ".nvdb": "volume",
    ".npz": "volume",
    "": "scene",
}
"""What files of these endings hold; without an ending it is a folder."""


@checked_arguments
def export(
    field: Field,
    path: str | Path,
    *,
    scene: Scene | None = None,
    unseen: bool = False,
    level: float | None = None,
    crop: surface.Crop | None = None,
    min_size: float | None = None,
    on_camera: Callable[[int], None] | None = None,
) -> Path:
    """Export a field as a mesh, point cloud, Gaussian splats, volume or page, as the ending of the
    name says.

    .glb, .obj, .ply: a mesh with colours at its vertices. .points.ply: its vertices, with normals
    and colours. .splat.ply: Gaussian splats. .html: a page that shows these without a network;
    needs the extra ``viewer``. .nvdb, .npz: density, and colour in .npz, on a grid. No ending: a
    folder with photographs, cameras for nerfstudio and COLMAP, and points.

    Args:
        field: What to write.
        path: Of the file, which is replaced, or of a new folder.
        scene: What the field was trained on: only what its training cameras see, where masks do not
            hide it, is written, in the colours that they see. None: all of the field is; for a page
            and a folder it is needed.
        unseen: Write what no training camera sees, too.
        level: Of a surface's density, 1 / scene unit; see ``extract_surface``.
        crop: Lower and upper corner of what is written, scene units; None: what cameras
            see, for splats all of space; volumes end at the box of the grid.
        min_size: Smaller parts of a surface are dropped, scene units; see ``extract_surface``.
        on_camera: Called with the number of training cameras that were looked through.

    Returns:
        Where it went.

    Raises:
        InputError: No field, another ending, a place that cannot be written to, options of another
            format, a missing scene or package, or nothing to write.
        OSError: It cannot be written; what was there before is left as it was.
    """
    path = Path(path)
    ending = checked_ending(path)
    for name, value in (("level", level), ("min_size", min_size)):
        if value is not None and ending not in SURFACES:
            raise InputError(
                f"{path}: {name} is of surfaces, and this file holds none; leave it out."
            )
    # Before what takes long:
    surface.check_options(field, level, crop, min_size)
    if ending in SURFACES:
        surface.require_crossed(field, level, crop)
    if scene is None and ending in ("", ".html"):
        raise InputError(f"{path}: a {FORMATS[ending]} needs the scene of the training; give it.")
    if ending in VOLUMES:
        volume.checked_block(field, crop)
    views = [] if scene is None else [scene.views[index] for index in scene.splits["train"]]
    visible = visibility(field, views, on_camera) if views else None
    up = None if scene is None else up_direction(scene.training_cameras)
    if ending in SPLATS:
        made = splats.splats_of(field, visible, unseen=unseen, crop=crop)
        if scene is not None and ending == ".html":
            pieces = page.splats_html(made, scene, field.background)
        else:
            pieces = splats.splats_ply(made, up)
    elif ending in VOLUMES:
        block = volume.volume_of(field, visible, unseen=unseen, crop=crop)
        pieces = volume.volume_nvdb(block) if ending == ".nvdb" else volume.volume_npz(block)
    else:
        found = surface.extract_surface(
            field, visible, unseen=unseen, level=level, crop=crop, min_size=min_size
        )
        if scene is not None and ending == "":
            scenes.write_scene(path, scene, found)
            return path
        if ending == ".glb":
            pieces = mesh.mesh_glb(found, up)
        else:
            write = {".obj": mesh.mesh_obj, ".ply": mesh.mesh_ply, ".points.ply": mesh.points_ply}
            pieces = write[ending](found)
    write_atomically(path, *pieces)
    return path


def checked_ending(path: str | Path) -> str:
    """The ending of a name that says what is written: a key of FORMATS.

    Raises:
        InputError: It is none of these, the place cannot be written to, or viser is missing.
    """
    path = Path(path)
    name = path.name.lower()
    known = sorted(filter(None, FORMATS), key=len, reverse=True)
    ending = next((ending for ending in known if name.endswith(ending)), path.suffix)
    if ending not in FORMATS:
        raise InputError(
            f"{path}: no such format; let the name end in {', '.join(known[::-1])}, or in nothing "
            "for a folder of photographs, cameras and points."
        )
    if not path.parent.is_dir():
        raise InputError(f"{path}: its folder does not exist; make it first.")
    if ending and path.is_dir():
        raise InputError(f"{path}: is a folder; choose another name.")
    if not ending and path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: exists already; name a new folder.")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its folder cannot be written to; choose another one.")
    if ending == ".html":
        page.require_viser()
    return ending
