"""The entry point of exports: the name of a file says its format; several are written together."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpnerf.checked import checked, checked_arguments
from warpnerf.checks import InputError
from warpnerf.exporting import atlas, mesh, page, splats, spz, surface, volume
from warpnerf.exporting import cameras as scenes
from warpnerf.exporting.colour import colours
from warpnerf.exporting.first_view import widest_view
from warpnerf.exporting.pinhole import pinhole_scene
from warpnerf.exporting.surface import Surface
from warpnerf.exporting.visibility import Visibility
from warpnerf.exporting.visibility_file import cached_visibility
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.focus import up_direction
from warpnerf.scenes.scene import Scene
from warpnerf.writing import StagedWrites

log = logging.getLogger(__name__)

TEXELS = 3
"""Of a texture, along a voxel edge: the field has no finer detail."""

LARGEST_TEXTURE = 8192
"""Texels: what browsers on all devices take."""

MESHES = (".glb", ".obj", ".ply")
SURFACES = (".glb", ".obj", ".ply", ".points.ply", "")
SPLATS = (".splat.ply", ".spz", ".html")
VOLUMES = (".nvdb", ".npz")
FORMATS = {
    ".glb": "mesh",
    ".obj": "mesh",
    ".ply": "mesh",
    ".points.ply": "points",
    ".splat.ply": "splats",
    ".spz": "splats",
    ".html": "page",
    ".nvdb": "volume",
    ".npz": "volume",
    "": "scene",
}
"""What files of these endings hold; without an ending it is a folder."""

CENTRED = (".glb", ".splat.ply", ".spz", ".html", ".nvdb")
"""Files whose programs read positions in single precision: of a georeferenced scene they keep the
coordinates of the training, less its offset, and the others have those of its file."""


@checked("options")
@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Export options of meshes, and of a folder's photographs."""

    fill: float | None = None
    """Holes up to this size are closed, scene units; see ``extract_surface``."""
    n_faces: int | None = None
    """Triangles of a mesh, about; None: as many as there are."""
    texture: bool = False
    """Give a .glb texture coordinates and a texture instead of vertex colours."""
    pinhole: bool = False
    """Undistort the photographs of a folder; see ``pinhole_scene``."""

    def __post_init__(self) -> None:
        """Types are checked; numbers, where they are used."""


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
    options: ExportOptions | None = None,
    on_camera: Callable[[int], None] | None = None,
) -> Path:
    """Export a field as a mesh, point cloud, Gaussian splats, volume or page, as the ending of the
    name says.

    .glb, .obj, .ply: a mesh with colours at its vertices. .points.ply: its vertices, with normals
    and colours. .splat.ply, .spz: Gaussian splats. .html: a page that shows these without a
    network; needs the extra ``viewer``. .nvdb, .npz: density, and colour in .npz, on a grid. No
    ending: a folder with photographs, cameras for nerfstudio and COLMAP, and points.

    Coordinates are those of the scene's file, also where ``Scene.offset`` was subtracted from them;
    only .glb, .splat.ply, .spz, .html and .nvdb, which are read in single precision, stay without
    it. A .glb has it in its extras, a .splat.ply as a comment.

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
        options: Holes, decimation and texture of meshes, and undistortion of photographs.
        on_camera: Called with the number of training cameras that were looked through.

    Returns:
        Where it went.

    Raises:
        InputError: No field, another ending, a place that cannot be written to, options of another
            format, a missing scene or package, or nothing to write.
        OSError: It cannot be written; what was there before is left as it was.
    """
    (written,) = export_all(
        field,
        [path],
        scene=scene,
        unseen=unseen,
        level=level,
        crop=crop,
        min_size=min_size,
        options=options,
        on_camera=on_camera,
    )
    return written


@checked_arguments
def export_all(
    field: Field,
    paths: Sequence[str | Path],
    *,
    scene: Scene | None = None,
    unseen: bool = False,
    level: float | None = None,
    crop: surface.Crop | None = None,
    min_size: float | None = None,
    options: ExportOptions | None = None,
    on_camera: Callable[[int], None] | None = None,
    cache: Path | None = None,
) -> list[Path]:
    """Export a field in several formats at once: each as the ending of its name says.

    What the cameras see, the surface and the splats are computed once. All files are written, or
    none is.

    Args:
        field: What to write.
        paths: Of the files, which are replaced, and of new folders; at least one, all different.
        scene: As for ``export``.
        unseen: As for ``export``.
        level: Of surfaces, where there is one among the files.
        crop: As for ``export``.
        min_size: Of surfaces, where there is one among the files.
        options: Of the files that they concern; there must be one for each that is given.
        on_camera: As for ``export``.
        cache: A file that keeps the visibility for the next export; see ``cached_visibility``.

    Returns:
        Where they went.

    Raises:
        InputError: As ``export``, or no path, or one that is given twice.
        OSError: One cannot be written; what was there before is left as it was.
    """
    given = ExportOptions() if options is None else options
    targets = [Path(path) for path in paths]
    if not targets:
        raise InputError("export wants at least one file to write; name one.")
    if len({os.path.realpath(path) for path in targets}) < len(targets):
        raise InputError("a file to export is named twice; name each once.")
    endings = [checked_ending(path) for path in targets]
    for name, value, what, those in (
        ("a texture", given.texture or None, ".glb files", (".glb",)),
        ("undistortion", given.pinhole or None, "folders", ("",)),
        ("level", level, "surfaces", SURFACES),
        ("min_size", min_size, "surfaces", SURFACES),
        ("fill", given.fill, "surfaces", SURFACES),
        ("the number of faces", given.n_faces, "meshes", MESHES),
    ):
        if value is not None and not {*endings} & {*those}:
            raise InputError(f"{targets[0]}: {name} is of {what}, and there is none; leave it out.")
    # Before what takes long:
    surface.check_options(field, level, crop, min_size, given.fill, given.n_faces)
    for path, ending in zip(targets, endings, strict=True):
        if scene is None and ending in ("", ".html"):
            raise InputError(
                f"{path}: a {FORMATS[ending]} needs the scene of the training; give it."
            )
        if ending in SURFACES:
            surface.require_crossed(field, level, crop)
        if ending in VOLUMES:
            volume.checked_block(field, crop)
    views = [] if scene is None else [scene.views[index] for index in scene.splits["train"]]
    products = _Products(
        field=field,
        scene=scene,
        visible=cached_visibility(field, views, cache, on_camera) if views else None,
        unseen=unseen,
        level=level,
        crop=crop,
        min_size=min_size,
        options=given,
    )
    with StagedWrites() as staged:
        if {*endings} & {*MESHES}:
            _say_borders(products.mesh)
        for path, ending in zip(targets, endings, strict=True):
            if scene is not None and ending == "":
                shown = pinhole_scene(scene) if given.pinhole else scene
                found = products.in_the_files_coordinates(products.surface)
                shown = shown.at_offset(None)
                write = functools.partial(scenes.write_scene, scene=shown, surface=found)
                staged.add_folder(path, write)
            else:
                staged.add(path, *products.pieces(ending))
    return targets


def _say_borders(made: Surface) -> None:
    """Log where a mesh is open."""
    if made.borders:
        n, widest = len(made.borders), ", ".join(f"{width:.3g}" for width in made.borders[:3])
        log.info(
            f"the mesh has {n} open border{'s' * (n > 1)}, the widest {widest} scene units across: "
            "where the cameras' view or the crop ends, or the surface is too faint for its level"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Products:
    """What files are made of, each computed once, when the first file needs it."""

    field: Field
    scene: Scene | None
    visible: Visibility | None
    unseen: bool
    level: float | None
    crop: surface.Crop | None
    min_size: float | None
    options: ExportOptions

    @functools.cached_property
    def mesh(self) -> Surface:
        return self.surface if self.options.n_faces is None else self._surface(self.options.n_faces)

    @functools.cached_property
    def surface(self) -> Surface:
        return self._surface(None)

    def _surface(self, n_faces: int | None) -> Surface:
        return surface.extract_surface(
            self.field,
            self.visible,
            unseen=self.unseen,
            level=self.level,
            crop=self.crop,
            min_size=self.min_size,
            fill=self.options.fill,
            n_faces=n_faces,
        )

    @property
    def offset(self) -> np.ndarray | None:
        return None if self.scene is None else self.scene.offset

    def in_the_files_coordinates(self, made: Surface) -> Surface:
        """A surface where the scene's file has it."""
        return made if self.offset is None else replace(made, points=made.points + self.offset)

    @property
    def textured(self) -> atlas.Textured:
        texel = float(self.field.lattice.voxel_size.mean()) / TEXELS
        bake = functools.partial(colours, self.field, self.visible)
        return atlas.textured(self.mesh, texel, LARGEST_TEXTURE, bake)

    @functools.cached_property
    def splats(self) -> splats.Splats:
        return splats.splats_of(self.field, self.visible, unseen=self.unseen, crop=self.crop)

    @functools.cached_property
    def volume(self) -> volume.Volume:
        return volume.volume_of(self.field, self.visible, unseen=self.unseen, crop=self.crop)

    def pieces(self, ending: str) -> list[bytes]:
        """The pieces of the file of a format."""
        up = None if self.scene is None else up_direction(self.scene.training_cameras)
        if ending == ".html" and self.scene is not None:
            begin = widest_view(self.field, self.scene.training_cameras)
            return page.splats_html(self.splats, self.scene, self.field.background, begin)
        if ending == ".splat.ply":
            return splats.splats_ply(self.splats, up, self.offset)
        if ending == ".spz":
            return spz.splats_spz(self.splats, up)
        if ending == ".nvdb":
            return volume.volume_nvdb(self.volume)
        if ending == ".npz":
            block = self.volume if self.offset is None else self.volume.moved(self.offset)
            return volume.volume_npz(block)
        if ending == ".glb":
            made = self.textured if self.options.texture else self.mesh
            return mesh.mesh_glb(made, up, self.offset)
        if ending == ".points.ply":
            return mesh.points_ply(self.in_the_files_coordinates(self.surface))
        write = {".obj": mesh.mesh_obj, ".ply": mesh.mesh_ply}[ending]
        return write(self.in_the_files_coordinates(self.mesh))


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
    if not ending and path.exists() and not path.is_dir():
        raise InputError(
            f"{path}: its name has no ending, which says what to write, and it is no folder; let "
            f"it end in {', '.join(known[::-1])}."
        )
    if not ending and path.exists() and any(path.iterdir()):
        raise InputError(f"{path}: exists already; name a new folder.")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its folder cannot be written to; choose another one.")
    if ending == ".html":
        page.require_viser()
    return ending
