"""`warpnerf pose`: a scene from photographs without poses, or from a video."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import tyro

from warpnerf.runtime.progress import ProgressBar
from warpnerf.sfm.config import PoseConfig


def pose_command(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    config: PoseConfig,
    /,
    output: Path,
    overwrite: bool = False,
) -> int:
    """Estimate the poses of photographs, or of frames of a video, and make a scene of them.

    Args:
        source: Folder of photographs, or a video.
        config: How.
        output: The scene's folder; may be that of the photographs.
        overwrite: Replace the posed scene that the output folder holds.
    """
    _estimate(source, output, config, overwrite)
    named = shlex.quote(str(output))
    print(
        f"wrote {output}; continue with: warpnerf train {named} "
        f"--output runs/{output.resolve().name}"
    )
    return 0


def with_poses(source: str, run: Path, masks: Path | None, threads: int | None) -> str:
    """Estimate poses before a training, where a source has none and pycolmap is there.

    Args:
        source: What is to be trained on.
        run: The run's folder, which nobody else writes to. The scene waits in its next/ until
            the run begins; one that was made of the same before is taken as it is.
        masks: Folder of masks of the photographs.
        threads: CPU threads; None: one per usable core.

    Returns:
        The source, or the folder of the scene that was made of it.

    Raises:
        InputError: The poses cannot be estimated.
    """
    from warpnerf.scenes.formats.contents import is_unposed
    from warpnerf.sfm.pose import is_made_of
    from warpnerf.sfm.scene_files import IN_RUN, NEXT_IN_RUN
    from warpnerf.sfm.worker import is_installed

    if source.startswith("builtin:") or not is_unposed(Path(source)) or not is_installed():
        return source
    config = PoseConfig(masks=masks, threads=threads)
    for scene in (run / IN_RUN, run / NEXT_IN_RUN):
        if is_made_of(scene, Path(source), config):
            print(f"the poses of {source} are in {scene} already", flush=True)
            return str(scene)
    _estimate(Path(source), run / NEXT_IN_RUN, config, overwrite=True)
    return str(run / NEXT_IN_RUN)


def _estimate(source: Path, output: Path, config: PoseConfig, overwrite: bool) -> None:
    """Estimate poses with a bar in the terminal, and print what came of it."""
    from warpnerf.sfm.pose import pose

    print(f"estimating the poses of {source}", flush=True)
    with ProgressBar("looking at the files") as bar:
        posing = pose(source, output, config, overwrite=overwrite, on_progress=bar.report)
    print(posing, flush=True)
