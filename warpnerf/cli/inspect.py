"""`warpnerf inspect`: what was understood of a scene."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from warpnerf.checks import InputError, cannot_write, said
from warpnerf.cli.arguments import SceneName, Settings, Usual
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given
from warpnerf.cli.machine import require_writable, write_json
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.runtime.memory import usable_cores

if TYPE_CHECKING:
    from warpnerf.scenes.scene import Scene


@dataclass(frozen=True, kw_only=True)
class InspectOptions:
    """What `warpnerf inspect` is given besides a configuration."""

    scene: SceneName
    """Folder of a scene (transforms.json, Blender, COLMAP, LLFF), an .npz file, builtin:room or
    builtin:room-sparse."""
    output: Path | None = None
    """FILE.png for a plan: cameras, box and content distance from above and the side."""
    plots: Path | None = None
    """Folder for two plots: how many cameras see a point, and how densely it is sampled, by its
    distance from a camera."""
    json: Path | None = None
    """Also write all of it to this file."""
    downscale: int = 1
    """As training will be given."""
    masks: Path | None = None
    """As training will be given."""
    model_options: Settings = ()
    """As training will be given."""
    loss: Settings = ()
    """As training will be given."""


USUAL = Usual(
    (
        "model",
        "time_limit",
        "content_distance",
        "grid.voxels",
        "box",
        "grid.border",
        "grid.contraction",
        "march.near",
        "threads",
    )
)


def inspect_command(options: InspectOptions, given: Annotated[Given, USUAL] = NOTHING) -> int:
    """Summarise a scene: what was understood, diagnostics, what training will take.

    Options that train has as well replace the values of both fast and quality.

    --help-all shows one for each field of the configuration.
    """
    from warpnerf.inspection.inspection import inspect

    output, json = options.output, options.json
    if output is not None:
        if output.suffix != ".png":
            raise InputError(f"--output {output}: the plan is a PNG; let its name end in .png.")
        if not output.parent.is_dir():
            raise InputError(f"--output {output}: its folder does not exist; make it first.")
    require_writable(json, ("costs", "plans"))
    if options.plots is not None and options.plots.exists() and not options.plots.is_dir():
        raise InputError(f"--plots {options.plots} is a file; name a folder.")
    configs = {
        name: begun_with(
            configured(PRESETS[name], given, options.model_options, options.loss), given
        )
        for name in DEFAULT_PRESETS
    }
    first = configs[DEFAULT_PRESETS[0]]
    if not re.fullmatch(r"cpu|cuda(:\d+)?", first.device):
        raise InputError(f"--device must be cpu, cuda, or cuda:1, ..., not {said(first.device)}.")
    distance = first.content_distance
    found = inspect(
        options.scene,
        downscale=options.downscale,
        masks=options.masks,
        content_distance=None if isinstance(distance, str) else distance,
        near=first.march.near,
        configs=configs,
        threads=first.threads or usable_cores(),
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
    if options.plots is not None:
        _write_plots(found.scene, options.plots)
    return 0


def _write_plots(scene: Scene, folder: Path) -> None:
    """Write plots of how cameras share what they see.

    Raises:
        InputError: They cannot be written, or one of them is a link.
    """
    from warpnerf.media.overlap_plots import overlap_plots
    from warpnerf.media.pictures import write_png
    from warpnerf.runs.lock import require_own

    try:
        folder.mkdir(parents=True, exist_ok=True)
        plots = overlap_plots(scene)
        require_own((folder / name for name in plots), "inspect")
        for name, picture in plots.items():
            write_png(folder / name, picture)
            print(f"wrote {folder / name}")
    except OSError as error:
        raise cannot_write(f"--plots {folder}", error) from error
