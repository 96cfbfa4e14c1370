"""Interactive viewer of trained fields: one, or two beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpnerf.blocks.folder import open_trained
from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_extra
from warpnerf.media.filming import depth_range
from warpnerf.rendering.composite import AnyField, CompositeField
from warpnerf.rendering.field import Field
from warpnerf.runs.config import TrainedScene
from warpnerf.runs.scene import load_run_scene
from warpnerf.scenes.scene import Scene
from warpnerf.viewer.painter import Subject
from warpnerf.viewer.session import Session


@checked_arguments
def view(
    *shown: Field | CompositeField | str | Path,
    scene: Scene | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> None:
    """Serve an interactive viewer of fields in the browser, until interrupted; print its address.

    Args:
        shown: A field or the folder of a run or of blocks; or two, in the same coordinates, to be
            compared.
        scene: Its training cameras are shown; None: those of the first run's scene.
        host: Name or address of this machine to listen at. Any but 127.0.0.1 lets others in.
        port: None: 8080, or the next that is free; 0: any that is free.
        device: For runs: cpu, cuda, cuda:1, ...
        threads: For runs, CPU threads; None: one per usable core.

    Raises:
        InputError: viser is missing, a folder holds no field, the scene is none, or host and port
            cannot be listened at.
    """
    with open_view(
        shown, scene=scene, host=host, port=port, device=device, threads=threads
    ) as session:
        print(f"look at {session.address}; Ctrl-C ends it", flush=True)
        session.serve()


def open_view(
    shown: Sequence[AnyField | str | Path],
    *,
    scene: Scene | str | None,
    host: str,
    port: int | None,
    device: str,
    threads: int | None,
) -> Session:
    """The page of ``view``, not served yet. A scene may also be given by its folder or name.

    Photographs that are not where the run had them are no reason not to look at its field: a note
    is printed.
    """
    require_extra("viser", "viewer", "the viewer")
    if len(shown) not in (1, 2):
        raise InputError(f"name one field or run, or two to compare, not {len(shown)}.")
    subjects, distance = [], None
    for number, what in enumerate(shown, 1):
        if isinstance(what, Field | CompositeField):
            subjects.append(_subject(f"field {number}", what))
            continue
        run = open_trained(Path(what))
        config = run.read_config()
        field, notes = run.load_field(device, threads)
        for note in notes:
            print(f"note: {note}", flush=True)
        subjects.append(_subject(run.folder.resolve().name, field))
        if distance is None:
            distance = config.content_distance
            if not isinstance(scene, Scene):
                scene = _scene_of(config, scene, threads)
    if scene is not None and not isinstance(scene, Scene):  # without a run, nothing is read
        raise InputError(
            f"scene of the view must be a Scene, not {scene!r}; load_scene gives that of a folder."
        )
    first = subjects[0].field()
    if scene is not None:
        distance = distance or scene.content_distance
    depths = None if scene is None else depth_range(first, scene.training_cameras)
    low, high = first.surroundings
    half = 0.5 * float(np.linalg.norm(high - low))
    return Session(
        subjects,
        scene,
        content_distance=distance or half,
        depths=depths,
        host=host,
        port=port,
    )


def _subject(name: str, field: AnyField) -> Subject:
    return Subject(name=name, field=lambda: field)


def _scene_of(config: TrainedScene, moved: str | None, threads: int | None) -> Scene | None:
    print(f"reading {moved or config.scene}", flush=True)
    try:
        return load_run_scene(config, moved, threads)
    except InputError as error:
        if moved is not None:
            raise
        hint = "" if "--scene" in str(error) else " Name them by --scene."
        print(f"note: shown without its photographs: {error}{hint}", flush=True)
        return None
