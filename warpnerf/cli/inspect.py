"""`warpnerf inspect`: what was understood of a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from warpnerf.checks import InputError, cannot_write, require_at_least
from warpnerf.cli.arguments import SceneName, Settings
from warpnerf.cli.machine import require_writable, write_json
from warpnerf.cli.model_options import chosen_model
from warpnerf.presets import EVERYDAY, PRESETS
from warpnerf.runtime.memory import usable_cores


def inspect_command(
    scene: SceneName,
    /,
    output: Path | None = None,
    json: Path | None = None,
    downscale: int = 1,
    masks: Path | None = None,
    content_distance: float | None = None,
    near: float = 0.0,
    model: str | None = None,
    model_options: Settings = (),
    threads: int | None = None,
) -> int:
    """Say what was understood of a scene, what training will take, and what is odd.

    Args:
        scene: Folder of a scene (transforms.json, Blender, COLMAP, LLFF), an .npz file,
            builtin:room or builtin:room-sparse.
        output: FILE.png for a plan: cameras, box and content distance from above and the side.
        json: Also write all of it to this file.
        downscale: As training will be given.
        masks: As training will be given.
        content_distance: As training will be given; by default the estimate.
        near: As training will be given.
        model: As training will be given: deferred, features, sh, or rgb.
        model_options: As training will be given.
        threads: CPU threads that training would have; by default one per usable core.
    """
    from warpnerf.evaluation.inspection import inspect

    if output is not None:
        if output.suffix != ".png":
            raise InputError(f"--output {output}: the plan is a PNG; let its name end in .png.")
        if not output.parent.is_dir():
            raise InputError(f"--output {output}: its folder does not exist; make it first.")
    require_writable(json)
    if threads is not None:
        require_at_least("--threads", threads, 1)
    found = inspect(
        scene,
        downscale=downscale,
        masks=masks,
        content_distance=content_distance,
        near=near,
        configs={
            name: replace(
                PRESETS[name], model=chosen_model(PRESETS[name].model, model, model_options)
            )
            for name in EVERYDAY
        },
        threads=threads or usable_cores(),
    )
    print(found)
    if json is not None:
        write_json(json, found.to_json())
    if output is not None:
        from warpnerf.media.pictures import write_png
        from warpnerf.media.scene_plan import plan_picture

        try:
            write_png(output, plan_picture(found))
        except OSError as error:
            raise cannot_write(f"--output {output}", error) from error
        print(f"wrote {output}")
    return 0
