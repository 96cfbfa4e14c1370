"""`warpnerf demo`: builtin:room-sparse, without and with distance scaling."""

from __future__ import annotations

from pathlib import Path

from warpnerf.checks import InputError, require_whole
from warpnerf.cli.compare import MAX_SEEDS, train_all
from warpnerf.runtime.progress import ProgressBar
from warpnerf.runtime.signals import Stopped


def demo_command(
    output: Path,
    steps: int = 2500,
    seeds: int = 1,
    downscale: int = 1,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """See what the scaling does: train builtin:room-sparse without it and with it, and compare.

    Stopped, it continues with the same command; no training is repeated.

    Args:
        output: Folder for a picture, a video, the figures, a report and the runs.
        steps: Of each training.
        seeds: How many trainings of each, with seeds 0, 1, ...
        downscale: Of the room's photographs.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    require_whole("--seeds", seeds, 1)
    if seeds > MAX_SEEDS:
        raise InputError(f"--seeds must be at most {MAX_SEEDS}, not {seeds}.")

    from warpnerf.media.video import video_file
    from warpnerf.reports.comparison_film import FILM, FPS
    from warpnerf.reports.demonstration import demonstration, write_demonstration

    print(
        "Space near a camera is crossed by many rays of that one camera. It gets more gradient\n"
        "than it should, and fills with floaters. Two fields are trained on the same photographs,\n"
        f"from the same seed, for {steps} steps each, with the near plane at 0: without and with\n"
        "each sample's gradient scaled by its distance from the camera.",
        flush=True,
    )
    made = demonstration(
        output, steps=steps, seeds=seeds, downscale=downscale, device=device, threads=threads
    )
    try:
        code = train_all(made)
        if code is not None:
            return code
        with ProgressBar("reading fields") as bar:
            result = write_demonstration(made, bar.report)
    except Stopped as stopped:
        print("stopped; the same command continues", flush=True)
        return stopped.exit_code
    print(result)
    print(
        "Of a training ray's light, all should end at the surface; near cameras there is nothing."
    )
    _, note = video_file(output / FILM, FPS)
    if note is not None:
        print(note)
    print(f"wrote {result.picture}, {result.video}, {result.record}, {result.page}")
    return 0
