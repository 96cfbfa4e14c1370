"""Frames of a video: the sharpest of each part, upright."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from warpnerf.checks import InputError
from warpnerf.sfm.frames import sharp_frames, sharpness

av = pytest.importorskip("av", reason='needs PyAV: pip install "warpnerf[sfm]"')

WIDTH, HEIGHT = 64, 48


def checked(number: int, blurred: bool) -> np.ndarray:
    """Squares whose gray tells the frame's number; blurred ones have no edges."""
    squares = np.add.outer(np.arange(HEIGHT) // 8, np.arange(WIDTH) // 8) % 2
    gray = np.full((HEIGHT, WIDTH), 60 + 4 * number) + (0 if blurred else 60) * squares
    gray[:8, :8] = 255  # a corner, so that a turn shows
    return np.repeat(gray.astype(np.uint8)[:, :, None], 3, axis=2)


def write(path: Path, n: int = 12, sharp: tuple[int, ...] = (), codec: str = "h264") -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k in range(n):
            pixels = checked(k, blurred=k not in sharp)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def frames(path: Path, n: int) -> list[np.ndarray]:
    pictures = sharp_frames(path, path.parent / "frames", n, lambda share: None)
    assert [p.name for p in pictures] == [f"frame_{k + 1:05}.jpg" for k in range(len(pictures))]
    return [np.asarray(Image.open(p)).astype(int) for p in pictures]


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    found = frames(write(tmp_path / "a.mp4", sharp=(1, 7, 8)), 3)
    assert len(found) == 3
    # Their darkest gray tells which they are.
    assert [round((np.percentile(f, 5) - 60) / 4) for f in found] == [1, 7, 8]


def test_all_frames_of_a_short_video_are_taken(tmp_path: Path) -> None:
    assert len(frames(write(tmp_path / "a.mp4", 5), 100)) == 5


def test_a_video_that_does_not_say_how_long_it_is(tmp_path: Path) -> None:
    """As browsers record them: without a duration, which then comes from the packets."""
    path = write(tmp_path / "a.mkv", 12, sharp=(2, 6, 10))
    raw = path.read_bytes()
    place = raw.index(b"\x44\x89\x88")  # Duration, an eight-byte number, becomes a void element
    path.write_bytes(raw[:place] + b"\xec\x89" + b"\0" * 9 + raw[place + 11 :])
    with av.open(str(path)) as container:
        assert container.duration is None and container.streams.video[0].duration is None
    found = frames(path, 3)
    assert [round((np.percentile(f, 5) - 60) / 4) for f in found] == [2, 6, 10]


@pytest.mark.parametrize(("degrees", "corner"), [(90, (0, -1)), (180, (-1, -1)), (270, (-1, 0))])
def test_frames_are_turned_as_the_video_says(
    tmp_path: Path, degrees: int, corner: tuple[int, int]
) -> None:
    """A phone stores frames as its sensor lies, and by how much to turn them clockwise."""
    path = write(tmp_path / "a.mp4", 3)
    raw = bytearray(path.read_bytes())
    c, s = round(np.cos(np.radians(degrees))), round(np.sin(np.radians(degrees)))
    place = raw.index(b"tkhd") + 4 + 40  # of a box of version 0: the matrix that displays it
    matrix = (c << 16, s << 16, 0, -s << 16, c << 16, 0, 0, 0, 1 << 30)
    raw[place : place + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(raw)
    found = frames(path, 3)[0]
    assert found.shape[:2] == ((WIDTH, HEIGHT) if degrees % 180 else (HEIGHT, WIDTH))
    rows, columns = (slice(0, 6) if k == 0 else slice(-6, None) for k in corner)
    assert found[rows, columns].mean() > 200
    assert found.mean() < 120


def test_progress_goes_to_the_end(tmp_path: Path) -> None:
    shares: list[float] = []
    sharp_frames(write(tmp_path / "a.mp4"), tmp_path / "frames", 4, shares.append)
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] > 0.85


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video\n" * 100)
    with pytest.raises(InputError, match=r"text\.mp4: is not readable as a video .*convert"):
        frames(tmp_path / "text.mp4", 3)
    whole = write(tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.mp4: is not readable as a video"):
        frames(tmp_path / "cut.mp4", 3)
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((2, 4096), np.float32), format="fltp")
        sound.sample_rate = 44100
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match=r"sound\.mp4: holds no pictures"):
        frames(tmp_path / "sound.mp4", 3)
    with pytest.raises(InputError, match=r"two\.mp4: has 2 frames, and poses need at least 3"):
        frames(write(tmp_path / "two.mp4", 2), 3)


def test_without_pyav_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install "warpnerf\[sfm\]"'):
        sharp_frames(tmp_path / "a.mp4", tmp_path / "frames", 3, lambda share: None)


def test_sharpness_falls_with_blur() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 40)).astype(np.uint8)
    soft = (noise[:-1, :-1].astype(int) + noise[1:, 1:]) // 2
    assert sharpness(noise) > 1.5 * sharpness(soft.astype(np.uint8)) > 0.0
    assert sharpness(np.full((9, 9), 7, np.uint8)) == 0.0
