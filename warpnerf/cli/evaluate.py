"""`warpnerf eval`: the figures of a trained run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from warpnerf.cli.arguments import RunFolder
from warpnerf.cli.machine import require_writable, write_json
from warpnerf.runtime.progress import ProgressBar


def eval_command(
    folder: RunFolder,
    /,
    scene: str | None = None,
    masks: Path | None = None,
    split: Literal["test", "train", "val", "all"] = "test",
    lpips: Path | None = None,
    measures: bool = False,
    json: Path | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Measure a trained run on a split of its scene, or of other photographs of the same place.

    Args:
        folder: Output folder of a training run, or of blocks.
        scene: Other photographs in the same coordinates, reduced as those of the training were.
        masks: Folder of masks for these photographs; without --scene by default as for training.
        split: Which views.
        lpips: Weights of LPIPS, to measure it as well; warpnerf/evaluation/lpips.py describes the
            file.
        measures: Also measure what takes longer: where light is absorbed before and behind the true
            surfaces, figures of what training views see, density near each camera. Those of a run's
            own test views are added to its metrics.json.
        json: Also write the figures to this file.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.blocks.folder import open_trained
    from warpnerf.evaluation.evaluate import evaluate, require_measurable
    from warpnerf.runs.lock import require_own
    from warpnerf.runs.run import Run
    from warpnerf.runs.scene import path_of
    from warpnerf.scenes.formats.load import load_scene

    require_writable(json, ("mean", "images", "floaters"), folder / "metrics.json")
    distance = None
    if lpips is not None:
        from warpnerf.evaluation.lpips import Lpips

        distance = Lpips(lpips)
    run = open_trained(folder)
    config = run.read_config()
    its_own = scene is None and masks is None and split == "test"
    kept = run if isinstance(run, Run) and its_own and measures else None
    if kept is not None:
        kept.read_metrics()  # refused now, if it is damaged
        require_own([kept.folder / "metrics.json"], "a run")
    field, notes = run.load_field(device, threads)
    for note in notes:
        print(f"warpnerf: note: {note}", file=sys.stderr)
    folder_of_masks = masks or (config.masks if scene is None else None)
    views = load_scene(
        path_of(config, scene),
        downscale=config.downscale,
        masks=folder_of_masks,
        images="files",
        threads=threads,
        split=config.split if scene is None else None,
    )
    views = config.as_trained(views)
    require_measurable(views, split)
    with ProgressBar("first view") as bar:
        result = evaluate(
            field, views, split, lpips=distance, on_progress=bar.report, measures=measures
        )
    print(result)
    if json is not None:
        write_json(json, result.to_json())
    if kept is not None and result.measures is not None:
        path = kept.add_measures(result.measures)
        if path is not None:
            print(f"added measures to {path}")
    return 0
