"""`warpnerf render`: a trained scene as a video, or as pictures of a split."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import tyro
from msgspec import UNSET

from warpnerf.checks import InputError, cannot_write, require_positive
from warpnerf.cli.arguments import Corners, RunFolder
from warpnerf.runtime.progress import ProgressBar

if TYPE_CHECKING:
    from warpnerf.media.recorded_path import RecordedPath
    from warpnerf.runs.config import TrainedScene
    from warpnerf.scenes.cameras.camera import Camera
    from warpnerf.scenes.scene import Scene, View

FPS = 30.0
"""Frames per second, unless requested."""

SECONDS = 8.0
"""Length of a video along a path that has no length of its own."""

MAX_FRAMES = 100_000
"""An hour at 25 frames per second, and a little more."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """What is rendered of a run, and how."""

    path: Annotated[str, tyro.conf.arg(metavar="{auto,orbit,through,back}|FILE.json")] = "auto"
    """orbit: around what the cameras look at. through: through the training cameras. back: the
    same, backing away from them, where floaters show. auto: orbit where the cameras look at one
    thing, else through. FILE.json: a path recorded in the viewer, or nerfstudio's
    camera_path.json."""
    path_transforms: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """The dataparser_transforms.json of the nerfstudio run that a path belongs to; by default the
    one beside the path, else the path is taken to be in the scene's coordinates."""
    stills: Literal["test", "train", "val", "all"] | None = None
    """Render the views of this split as PNG pictures instead of a video."""
    photographs: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME [NAME ...]")] = None
    """Render from the places of these photographs, as PNG pictures instead of a video."""
    show: Annotated[
        tuple[Literal["colour", "depth", "opacity", "normals"], ...],
        tyro.conf.arg(metavar="{colour,depth,opacity,normals} ..."),
    ] = ("colour", "depth")
    """What is shown, from left to right. Normals are in the camera's axes."""
    crop: Corners = None
    """Two corners of the box that is shown, scene units, to cells of two voxels."""
    transparent: bool = False
    """Without background, with an alpha channel: PNG files, or FILE.mov (ProRes 4444)."""
    output: Path | None = None
    """FILE.mp4, FILE.gif, FILE.mov, or a new folder for PNG frames; for stills a folder. By default
    PATH.mp4 (video.mp4 for auto, and for a path of a file its name; .mov where transparent) or
    stills/ in the run's folder."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Of the colour picture, pixels; by default as the photographs, or as recorded."""
    fps: float | None = None
    """Frames per second, by default 30, or those of nerfstudio's path."""
    seconds: float | None = None
    """Length of the video; by default 8, or as recorded."""
    distance: float | None = None
    """How far `back` backs away, scene units; by default half the content distance."""
    depths: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAR FAR")] = None
    """What gets the first and the last colour, scene units; by default what is seen."""

    @property
    def only_stills(self) -> bool:
        """Whether pictures are rendered, and no video."""
        return self.stills is not None or self.photographs is not None

    def recorded(self, scene: str | None, config: TrainedScene) -> RecordedPath | None:
        """The path that was recorded; None: it is of another kind.

        Args:
            scene: What --scene names.
            config: Of the run.

        Raises:
            InputError: Options do not go together.
        """
        from warpnerf.media.filming import checked_depths

        if self.depths is not None:
            checked_depths(self.depths)
        if self.stills is not None and self.photographs is not None:
            raise InputError("--stills is a split, --photographs are named; give one of them.")
        if self.photographs == ():
            raise InputError("--photographs names no photograph; name one, or leave it out.")
        stills, path = self.only_stills, self.path
        if self.distance is not None and (stills or path != "back"):
            raise InputError("--distance is how far --path back backs away; give both or neither.")
        if stills and path != "auto":
            raise InputError(
                "--stills and --photographs render from photographs, along no path; give one of "
                "them."
            )
        if stills and not (self.fps is None and self.seconds is None):
            raise InputError("--fps and --seconds are of a video, not of --stills; leave them out.")
        recorded = _recorded(path, self.path_transforms, config)
        if recorded is not None and scene is not None:
            raise InputError(f"--scene is not needed for the cameras of {path}; leave it out.")
        return recorded


def render_command(
    folder: RunFolder,
    options: RenderOptions,
    /,
    scene: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Render a trained run, along a path or from photographs: colour, depth, opacity, normals.

    Args:
        folder: Output folder of a training run, or of blocks.
        options: What, and how.
        scene: Where the run's photographs are now, if they have moved.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.blocks.folder import open_trained
    from warpnerf.media.filming import depth_range, render_stills, render_video, sees_anything
    from warpnerf.media.panels import Panels
    from warpnerf.media.video import require_alpha, video_file
    from warpnerf.rendering.field import between
    from warpnerf.runs.scene import load_run_scene

    run = open_trained(folder)
    config = run.read_config()
    recorded = options.recorded(scene, config)
    path, stills, output = options.path, options.only_stills, options.output
    fps = options.fps
    if fps is None:
        fps = FPS if recorded is None or recorded.fps is UNSET else recorded.fps
    if not stills:
        name = "video" if path == "auto" else path if recorded is None else Path(path).stem
        ending = "mov" if options.transparent else "mp4"
        target, note = video_file(output or folder / f"{name}.{ending}", fps)
        require_alpha(target, options.transparent)
        if note:
            print(note, flush=True)
    else:
        target = output or folder / "stills"
        _require_folder(target)
    field, notes = run.load_field(device, threads)
    for note in notes:
        print(f"warpnerf: note: {note}", file=sys.stderr)
    Panels(field=field, outputs=options.show)  # refuses what cannot be shown
    if options.crop is not None:
        field = field.cropped(options.crop[:3], options.crop[3:])

    cameras: list[Camera]
    if recorded is not None:
        length = recorded.seconds or SECONDS  # one place only takes no time
        if recorded.fps is not UNSET and options.fps is None and options.seconds is None:
            n_frames = len(recorded.keys)
        else:
            n_frames = _n_frames(fps, length if options.seconds is None else options.seconds)
        cameras = recorded.cameras(n_frames, options.size)
        what = f"{_frames(n_frames)}, path {path}"
    elif not stills:
        from warpnerf.media.camera_path import PathKind, camera_path, natural_path

        views = load_run_scene(config, scene, threads)
        kind = natural_path(views) if path == "auto" else cast(PathKind, path)
        n_frames = _n_frames(fps, SECONDS if options.seconds is None else options.seconds)
        cameras = camera_path(views, kind, n_frames, size=options.size, distance=options.distance)
        what = f"{_frames(n_frames)}, path {kind!r}"
    else:
        views = load_run_scene(config, scene, threads)
        named = _still_cameras(views, options)
        cameras = list(named.values())
        what = f"{len(cameras)} view{'s' if len(cameras) > 1 else ''}"
    width, height = cameras[0].width, cameras[0].height
    shown, said = None, ""
    if "depth" in options.show:
        shown = options.depths or depth_range(field, cameras)
        said = f", depth from {shown[0]:g} yellow to {shown[1]:g} blue, scene units"
    if options.crop is not None and not sees_anything(field, cameras):
        around = between(field.surroundings)
        print(f"note: nothing is seen of the crop from there; what the field holds lies {around}")
    outputs = " and ".join(options.show)
    each = " each" if len(options.show) > 1 else ""
    print(f"rendering {what}, {outputs} of {width} x {height} pixels{each}{said}", flush=True)
    how: dict[str, Any] = {
        "depths": shown,
        "show": options.show,
        "transparent": options.transparent,
    }
    with ProgressBar("first frame") as bar:

        def on_frame(done: int) -> None:
            bar.report(done / len(cameras), f"frame {done} of {len(cameras)}")

        try:
            if not stills:
                render_video(field, cameras, target, fps=fps, on_frame=on_frame, **how)
            else:
                render_stills(field, named, target, on_frame=on_frame, **how)
        except OSError as error:
            raise cannot_write(f"--output {target}", error) from error
    print(f"wrote {target}")
    return 0


def _recorded(path: str, transforms: Path | None, config: TrainedScene) -> RecordedPath | None:
    """The path in a file; None where the name of a kind of path is given."""
    from warpnerf.media.camera_path import PathKind
    from warpnerf.media.nerfstudio_path import TRANSFORMS, read_nerfstudio_path
    from warpnerf.media.recorded_path import read_path
    from warpnerf.scenes.files import read_json

    kinds = ("auto", *get_args(PathKind))
    if path in kinds:
        if transforms is not None:
            raise InputError("--path-transforms is of a path of nerfstudio; leave it out.")
        return None
    if not path.endswith(".json"):
        raise InputError(
            f"--path {path} is none of {', '.join(kinds)}, and no FILE.json that the viewer or "
            "nerfstudio saved."
        )
    if "camera_path" not in read_json(Path(path), dict):
        if transforms is not None:
            raise InputError("--path-transforms is of a path of nerfstudio; leave it out.")
        return read_path(path)
    if transforms is None and (Path(path).parent / TRANSFORMS).exists():
        transforms = Path(path).parent / TRANSFORMS
    if transforms is None:
        print(
            f"note: no {TRANSFORMS} beside {path}: it is taken to be in the scene's coordinates; "
            "--path-transforms names that of its nerfstudio run"
        )
    return read_nerfstudio_path(Path(path), transforms, Path(config.scene), config.offset)


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"


def _n_frames(fps: float, seconds: float) -> int:
    require_positive("--seconds", seconds)
    n_frames = max(1, round(fps * seconds))
    if n_frames > MAX_FRAMES:
        raise InputError(
            f"--seconds {seconds:g} at --fps {fps:g} are {n_frames} frames, more than "
            f"{MAX_FRAMES}; make the video shorter."
        )
    return n_frames


def _still_cameras(scene: Scene, options: RenderOptions) -> dict[str, Camera]:
    """The cameras of a split's views, or of named ones, by the file names of their pictures."""
    from warpnerf.media.camera_path import path_lens
    from warpnerf.media.pictures import picture_files
    from warpnerf.scenes.scene import require_split

    if options.photographs is not None:
        views = [_named_view(scene, name) for name in dict.fromkeys(options.photographs)]
    else:
        chosen = require_split(scene, options.stills or "test")
        views = [scene.views[index] for index in chosen]
    files = picture_files([view.name for view in views], stems=True)
    size = options.size
    return {
        files[view.name]: view.camera if size is None else path_lens([view.camera], size)
        for view in views
    }


def _named_view(scene: Scene, name: str) -> View:
    """The view of a name: as it is, its end, or its end without the ending of the file."""
    for shortened in (
        lambda known: known,
        lambda known: PurePosixPath(known).name,
        lambda known: PurePosixPath(known).stem,
    ):
        found = [view for view in scene.views if shortened(view.name) == name]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"--photographs {name} is {found[0].name} or {found[1].name}; give the whole name."
            )
    names = [view.name for view in scene.views]
    nearest = get_close_matches(name, names, n=1, cutoff=0.0)[0]
    raise InputError(
        f"--photographs {name} is none of the {len(names)} photographs; the nearest is {nearest}."
    )


def _require_folder(folder: Path) -> None:
    if folder.suffix in (".mp4", ".gif", ".mov"):
        raise InputError(f"--output {folder} is a video's name; stills go into a folder.")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--output {folder} is a file; stills go into a folder.")
    if not folder.parent.is_dir():
        raise InputError(f"--output {folder}: the folder above does not exist; make it first.")
    if not os.access(folder if folder.is_dir() else folder.parent, os.W_OK):
        raise InputError(f"--output {folder} cannot be written to; choose another one.")
