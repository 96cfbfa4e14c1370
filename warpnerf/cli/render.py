"""`warpnerf render`: a trained scene as a video, or as pictures of a split."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import tyro

from warpnerf.checks import InputError, cannot_write, require_positive
from warpnerf.cli.arguments import RunFolder
from warpnerf.runtime.progress import ProgressBar

if TYPE_CHECKING:
    from warpnerf.media.recorded_path import RecordedPath
    from warpnerf.scenes.cameras.camera import Camera
    from warpnerf.scenes.scene import Scene

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
    thing, else through. FILE.json: a path recorded in the viewer."""
    stills: Literal["test", "train", "val", "all"] | None = None
    """Render the views of this split as PNG pictures instead of a video."""
    output: Path | None = None
    """FILE.mp4, FILE.gif, or a new folder for PNG frames; for stills a folder. By default PATH.mp4
    (video.mp4 for auto, and for a recorded path its file's name) or stills/ in the run's folder."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Of the colour picture, pixels; by default as the photographs, or as recorded."""
    fps: float | None = None
    """Frames per second, by default 30."""
    seconds: float | None = None
    """Length of the video; by default 8, or as recorded."""
    distance: float | None = None
    """How far `back` backs away, scene units; by default half the content distance."""
    depths: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAR FAR")] = None
    """What gets the first and the last colour, scene units; by default what is seen."""

    def recorded(self, scene: str | None) -> RecordedPath | None:
        """The path that was recorded; None: it is of another kind.

        Args:
            scene: What --scene names.

        Raises:
            InputError: Options do not go together.
        """
        from warpnerf.media.filming import checked_depths

        if self.depths is not None:
            checked_depths(self.depths)
        stills, path = self.stills is not None, self.path
        if self.distance is not None and (stills or path != "back"):
            raise InputError("--distance is how far --path back backs away; give both or neither.")
        if stills and path != "auto":
            raise InputError(
                "--stills renders the views of a split, along no path; give one of them."
            )
        if stills and not (self.fps is None and self.seconds is None):
            raise InputError("--fps and --seconds are of a video, not of --stills; leave them out.")
        recorded = _recorded(path)
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
    """Render a trained run: colour and depth side by side, along a path, or a split's views.

    Args:
        folder: Output folder of a training run.
        options: What, and how.
        scene: Where the run's photographs are now, if they have moved.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.media.filming import depth_range, render_stills, render_video
    from warpnerf.media.video import video_file
    from warpnerf.runs.run import Run
    from warpnerf.runs.scene import load_run_scene

    recorded = options.recorded(scene)
    path, stills, output = options.path, options.stills, options.output
    fps = FPS if options.fps is None else options.fps
    run = Run(folder)
    config = run.read_config()
    if stills is None:
        name = "video" if path == "auto" else path if recorded is None else Path(path).stem
        target, note = video_file(output or folder / f"{name}.mp4", fps)
        if note:
            print(note, flush=True)
    else:
        target = output or folder / "stills"
        _require_folder(target)
    field, notes = run.load_field(device, threads)
    for note in notes:
        print(f"warpnerf: note: {note}", file=sys.stderr)

    cameras: list[Camera]
    if recorded is not None:
        length = recorded.seconds or SECONDS  # one place only takes no time
        n_frames = _n_frames(fps, length if options.seconds is None else options.seconds)
        cameras = recorded.cameras(n_frames, options.size)
        what = f"{n_frames} frames, path {path}"
    elif stills is None:
        from warpnerf.media.camera_path import PathKind, camera_path, natural_path

        views = load_run_scene(config, scene, threads)
        kind = natural_path(views) if path == "auto" else cast(PathKind, path)
        n_frames = _n_frames(fps, SECONDS if options.seconds is None else options.seconds)
        cameras = camera_path(views, kind, n_frames, size=options.size, distance=options.distance)
        what = f"{n_frames} frames, path {kind!r}"
    else:
        views = load_run_scene(config, scene, threads)
        named = _still_cameras(views, stills, options.size)
        cameras = list(named.values())
        what = f"{len(cameras)} views"
    width, height = cameras[0].width, cameras[0].height
    shown = options.depths or depth_range(field, cameras)
    print(
        f"rendering {what}, colour and depth of {width} x {height} pixels each, "
        f"depth from {shown[0]:g} yellow to {shown[1]:g} blue, scene units",
        flush=True,
    )
    with ProgressBar("first frame") as bar:

        def on_frame(done: int) -> None:
            bar.report(done / len(cameras), f"frame {done} of {len(cameras)}")

        try:
            if stills is None:
                render_video(field, cameras, target, fps=fps, depths=shown, on_frame=on_frame)
            else:
                render_stills(field, named, target, depths=shown, on_frame=on_frame)
        except OSError as error:
            raise cannot_write(f"--output {target}", error) from error
    print(f"wrote {target}")
    return 0


def _recorded(path: str) -> RecordedPath | None:
    """The path in a file; None where the name of a kind of path is given."""
    from warpnerf.media.camera_path import PathKind
    from warpnerf.media.recorded_path import read_path

    kinds = ("auto", *get_args(PathKind))
    if path in kinds:
        return None
    if not path.endswith(".json"):
        raise InputError(
            f"--path {path} is none of {', '.join(kinds)}, and no FILE.json that the viewer saved."
        )
    return read_path(path)


def _n_frames(fps: float, seconds: float) -> int:
    require_positive("--seconds", seconds)
    n_frames = max(1, round(fps * seconds))
    if n_frames > MAX_FRAMES:
        raise InputError(
            f"--seconds {seconds:g} at --fps {fps:g} are {n_frames} frames, more than "
            f"{MAX_FRAMES}; make the video shorter."
        )
    return n_frames


def _still_cameras(scene: Scene, split: str, size: tuple[int, int] | None) -> dict[str, Camera]:
    """The cameras of a split's views by the file names of their pictures."""
    from warpnerf.media.camera_path import path_lens
    from warpnerf.media.pictures import picture_files
    from warpnerf.scenes.scene import require_split

    views = [scene.views[index] for index in require_split(scene, split)]
    files = picture_files([view.name for view in views], stems=True)
    return {
        files[view.name]: view.camera if size is None else path_lens([view.camera], size)
        for view in views
    }


def _require_folder(folder: Path) -> None:
    if folder.suffix in (".mp4", ".gif"):
        raise InputError(f"--output {folder} is a video's name; stills go into a folder.")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--output {folder} is a file; stills go into a folder.")
    if not folder.parent.is_dir():
        raise InputError(f"--output {folder}: the folder above does not exist; make it first.")
    if not os.access(folder if folder.is_dir() else folder.parent, os.W_OK):
        raise InputError(f"--output {folder} cannot be written to; choose another one.")
