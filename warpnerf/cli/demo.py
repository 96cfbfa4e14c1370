"""`warpnerf demo`: builtin:room-sparse, without and with distance scaling."""

from __future__ import annotations

from pathlib import Path

from warpnerf.runtime.progress import ProgressBar


def demo_command(
    output: Path,
    steps: int = 2500,
    downscale: int = 1,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """See what the scaling does: train builtin:room-sparse without it and with it, and compare.

    Args:
        output: Folder for a picture, a video and the figures.
        steps: Of each training.
        downscale: Of the room's photographs.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.media.video import video_file
    from warpnerf.reports.demonstration import FPS, demo

    print(
        "Space near a camera is crossed by many rays of that one camera. It gets more gradient\n"
        "than it should, and fills with floaters. Two fields are trained on the same photographs,\n"
        f"from the same seed, for {steps} steps each, with the near plane at 0: without and with\n"
        "each sample's gradient scaled by its distance from the camera.",
        flush=True,
    )
    with _Stages() as stages:
        result = demo(
            output,
            steps=steps,
            downscale=downscale,
            device=device,
            threads=threads,
            report=stages.report,
        )
    print(result)
    print("The truth has no density nearer to a camera than its nearest surface.")
    if result.video.suffix != ".mp4":
        _, note = video_file(output / "floaters.mp4", FPS)
        print(note)
    print(f"wrote {result.picture}, {result.video}, {result.record}")
    return 0


class _Stages:
    """A line for each stage, and a bar where one takes long."""

    def __enter__(self) -> _Stages:
        self._stage = ""
        self._bar: ProgressBar | None = None
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.__exit__(*error)

    def report(self, stage: str, fraction: float, text: str) -> None:
        if stage != self._stage:
            self.__exit__()
            self._stage, self._bar = stage, None
            print(stage, flush=True)
        if self._bar is None and text:
            self._bar = ProgressBar(text).__enter__()
        if self._bar is not None and fraction > 0.0:
            self._bar.report(fraction, text)
