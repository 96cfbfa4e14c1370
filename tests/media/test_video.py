"""Videos hold the frames they are given, and are written whole or not at all."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from warpnerf.checks import InputError
from warpnerf.media.video import video_file, write_video

NAMES = ("film.mp4", "film.gif", "film")
COLOURS = ((220, 30, 30), (30, 200, 40), (40, 60, 210))


def frames(height: int = 33, width: int = 47) -> Iterator[np.ndarray]:
    """One of each colour, and a white corner at the top left."""
    for colour in COLOURS:
        pixels = np.full((height, width, 3), colour, np.uint8)
        pixels[:12, :12] = 255
        yield pixels


def read(path: Path) -> list[np.ndarray]:
    if path.is_dir():
        return [np.asarray(Image.open(file)) for file in sorted(path.iterdir())]
    if path.suffix == ".gif":
        with Image.open(path) as image:
            shown = []
            for number in range(image.n_frames):
                image.seek(number)
                shown.append(np.asarray(image.convert("RGB")))
            return shown
    import av

    with av.open(path) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("name", NAMES)
def test_frames_come_back(tmp_path: Path, name: str) -> None:
    assert write_video(tmp_path / name, frames(), 25.0) == tmp_path / name
    shown = read(tmp_path / name)
    size = (34, 48, 3) if name.endswith("mp4") else (33, 47, 3)  # H.264 wants even sizes
    assert [pixels.shape for pixels in shown] == [size] * len(COLOURS)
    for pixels, colour in zip(shown, COLOURS, strict=True):
        np.testing.assert_allclose(pixels[20:, 20:].mean(axis=(0, 1)), colour, atol=12)
        np.testing.assert_allclose(pixels[:8, :8], 255, atol=12)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_mp4_is_h264_at_the_asked_rate(tmp_path: Path) -> None:
    import av

    write_video(tmp_path / "film.mp4", frames(), 30000 / 1001)
    with av.open(tmp_path / "film.mp4") as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.pix_fmt == "yuv420p"
        assert float(stream.average_rate) == pytest.approx(30000 / 1001)


@pytest.mark.parametrize("fps", [24.0, 30.0, 49.0])
def test_a_gif_lasts_as_long_as_it_should(tmp_path: Path, fps: float) -> None:
    pictures = [np.full((4, 4, 3), 10 * number, np.uint8) for number in range(24)]
    write_video(tmp_path / "film.gif", iter([*pictures, pictures[-1]]), fps)
    with Image.open(tmp_path / "film.gif") as image:
        pauses = []
        for number in range(image.n_frames):
            image.seek(number)
            pauses.append(image.info["duration"])
    assert sum(pauses) == 10 * round(100 * 25 / fps)


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("name", NAMES)
def test_interrupted_it_leaves_what_was_there(
    tmp_path: Path, name: str, error: type[BaseException]
) -> None:
    if "." in name:
        (tmp_path / name).write_bytes(b"older")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*")}

    def cut_off() -> Iterator[np.ndarray]:
        yield from frames()
        raise error

    with pytest.raises(error):
        write_video(tmp_path / name, cut_off(), 25.0)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_without_pyav_it_is_a_gif_and_said_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    path, note = video_file(tmp_path / "film.mp4", 25.0)
    assert path == tmp_path / "film.gif"
    assert note is not None and 'pip install "warpnerf[video]"' in note and "film.gif" in note
    assert write_video(tmp_path / "film.mp4", frames(), 25.0) == path
    assert len(read(path)) == len(COLOURS)


@pytest.mark.parametrize(
    ("name", "fps", "says"),
    [
        ("film.avi", 25.0, r"\.mp4 or \.gif"),
        ("film.mp4", 0.0, "frame rate"),
        ("film.mp4", float("nan"), "frame rate"),
        ("film.mp4", 1e5, "at most 1000"),
        ("film.gif", 60.0, "at most 50"),
        ("nowhere/film.mp4", 25.0, "folder does not exist"),
        ("full", 25.0, "exists already"),
        ("folder.mp4", 25.0, "is a folder"),
    ],
)
def test_what_cannot_be_written_is_refused(
    tmp_path: Path, name: str, fps: float, says: str
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    (tmp_path / "folder.mp4").mkdir()
    before = sorted(tmp_path.rglob("*"))
    taken: list[Any] = []

    def never() -> Iterator[np.ndarray]:
        taken.append(1)
        yield from frames()

    with pytest.raises(InputError, match=says):
        write_video(tmp_path / name, never(), fps)
    assert taken == []
    assert sorted(tmp_path.rglob("*")) == before
