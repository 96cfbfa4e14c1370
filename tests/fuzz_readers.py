"""Mutates the bytes of scene files, and asks that each reader loads them or refuses in a sentence.

    python tests/fuzz_readers.py --seconds 600 [--seed 0]

A mutant may raise nothing but InputError, take no longer than ``LIMIT``, and no more memory than
ten times the file besides what the whole scene takes. What fails is printed with its seed, by which
``--only FORMAT --seed SEED --seconds 0`` does it again.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "kernels"))

from tests.scenes.test_colmap import write_model
from tests.scenes.test_llff import write_llff
from tests.support.program_exports import (
    write_metashape,
    write_polycam,
    write_reality,
    write_record3d,
)
from tests.support.tiny_scenes import picture, ring, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.survey import survey

LIMIT = 10.0
"""Seconds for a mutant."""

TIMES = 10
"""As much memory as so many copies of the file, at most, besides ``SPARE``."""

SPARE = 4 * 2**20
"""Bytes: of messages, and of allocations that do not go with the file."""

EXTREMES = (b"\0", b"\xff", b"\x7f", b"\x80")
WORDS = (
    b"nan",
    b"-1",
    b"1e999",
    b"",
    b"[",
    b"}",
    b'"',
    b"\0",
    b"99999999999999999999",
    b"\xff\xfe",
)

Mutate = Callable[[random.Random, bytes], bytes]


# --- Scenes, each with the file that is mutated -------------------------------------------------


def colmap(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write_transforms(folder)
        (folder / "transforms.json").unlink()
        text = name.endswith(".txt")
        model = write_model(folder, text=text)
        if text:
            rows = [f"{k} 0.1 0.2 {0.1 * k} 9 9 9 0.5 1 0 2 0 3 1" for k in range(1, 40)]
            (model / "points3D.txt").write_text("# Points\n" + "\n".join(rows) + "\n")
        else:
            (model / "points3D.bin").write_bytes(points_of_colmap(39))
        return model / name

    return make


def points_of_colmap(n: int) -> bytes:
    """A points3D.bin: number, position, colour, error, and a track of two images each."""
    head = np.dtype("<u8, <3f8, 3u1, <f8, <u8")
    rows = np.zeros(n, np.dtype([("head", head), ("track", "<4u4")]))
    rows["head"]["f0"] = np.arange(1, n + 1)
    rows["head"]["f1"] = np.random.default_rng(0).normal(size=(n, 3))
    rows["head"]["f4"] = 2
    rows["track"] = (1, 0, 2, 1)
    return np.uint64(n).tobytes() + rows.tobytes()


def llff(folder: Path) -> Path:
    return write_llff(folder)


def transforms(folder: Path) -> Path:
    content = write_transforms(folder)
    extra = {"camera_model": "OPENCV", "k1": 0.01, "test_filenames": ["images/001.png"]}
    save(folder / "transforms.json", content | extra)
    return folder / "transforms.json"


def ply(order: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        content = write_transforms(folder)
        save(folder / "transforms.json", content | {"ply_file_path": "points.ply"})
        points = np.random.default_rng(0).normal(size=(60, 3)).astype("<f4")
        header = f"ply\nformat {order} 1.0\nelement vertex 60\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        lines = "\n".join(" ".join(map(str, row)) for row in points.tolist()).encode()
        body = lines if order == "ascii" else points.tobytes()
        (folder / "points.ply").write_bytes(header.encode() + body)
        return folder / "points.ply"

    return make


def npz(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    images = np.stack([picture(k) for k in range(4)]).astype(np.float32) / 255.0
    np.savez(folder / "scene.npz", images=images, poses=np.stack(ring(4)), focal=np.array(10.0))
    return folder / "scene.npz"


def other_lens(folder: Path) -> Path:
    """A COLMAP model whose lens is none of OpenCV's."""
    file = colmap("cameras.txt")(folder)
    numbers = "10 11 4.25 2.75 0.02 -0.01 0.003 -0.002 0.003 0.001 0.01 -0.005"
    file.write_text(f"7 THIN_PRISM_FISHEYE 8 6 {numbers}\n")
    return file


def polycam(folder: Path) -> Path:
    return write_polycam(folder) / "102.json"


def metashape(folder: Path) -> Path:
    turn = "<rotation>1 0 0 0 1 0 0 0 1</rotation><scale>2</scale>"
    rest = f'<components><component id="0"><transform>{turn}</transform></component></components>'
    return write_metashape(folder, rest=rest, component='component_id="0"')


def reality(folder: Path) -> Path:
    return write_reality(folder, lens="-0.05,0.02,-0.01,0.005,0.001,0")


FORMATS: dict[str, Callable[[Path], Path]] = {
    **{f"colmap-{n}": colmap(n) for n in ("cameras.bin", "images.bin", "points3D.bin")},
    **{f"colmap-{n}": colmap(n) for n in ("cameras.txt", "images.txt", "points3D.txt")},
    "llff": llff,
    "transforms": transforms,
    "ply-ascii": ply("ascii"),
    "ply-binary": ply("binary_little_endian"),
    "npz": npz,
    "colmap-other-lens": other_lens,
    "polycam": polycam,
    "record3d": write_record3d,
    "metashape": metashape,
    "reality": reality,
}


# --- Mutations ----------------------------------------------------------------------------------


def flip(rng: random.Random, raw: bytes) -> bytes:
    changed = bytearray(raw)
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwrite(rng: random.Random, raw: bytes) -> bytes:
    at, size = rng.randrange(len(raw)), rng.choice((1, 2, 4, 8, 8, 24))
    new = rng.choice((rng.randbytes(size), rng.choice(EXTREMES) * size))
    return raw[:at] + new + raw[at + size :]


def count(rng: random.Random, raw: bytes) -> bytes:
    """An eight-byte number somewhere, in the orders of size that counts have."""
    at = rng.choice((0, 8, rng.randrange(len(raw))))
    new = (rng.getrandbits(rng.choice((8, 16, 31, 32, 40, 63, 64)))).to_bytes(8, "little")
    return raw[:at] + new + raw[at + 8 :]


def cut(rng: random.Random, raw: bytes) -> bytes:
    return raw[: rng.randrange(len(raw))]


def remove(rng: random.Random, raw: bytes) -> bytes:
    at = rng.randrange(len(raw))
    return raw[:at] + raw[at + rng.choice((1, 2, 7, 30)) :]


def repeat(rng: random.Random, raw: bytes) -> bytes:
    begin, end = sorted((rng.randrange(len(raw)), rng.randrange(len(raw))))
    return raw[:end] + raw[begin:end] * rng.choice((1, 2, 20)) + raw[end:]


def word(rng: random.Random, raw: bytes) -> bytes:
    """Something else where a word of text stands."""
    at = rng.randrange(len(raw))
    begin = max(raw.rfind(mark, 0, at) for mark in (b" ", b",", b":", b"\n", b"["))
    ends = [end for mark in (b" ", b",", b"\n", b"]", b"}") if (end := raw.find(mark, at)) >= 0]
    return raw[: begin + 1] + rng.choice(WORDS) + raw[min(ends, default=len(raw)) :]


MUTATIONS: tuple[Mutate, ...] = (flip, overwrite, count, cut, remove, repeat, word)


# --- Trying -------------------------------------------------------------------------------------


class Hung(Exception):
    """A mutant took too long."""


@contextmanager
def limited() -> Iterator[None]:
    """Raise Hung after the time limit, where the system has alarms."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(*_: object) -> None:
        raise Hung(f"took longer than {LIMIT:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


class Target:
    """One format: a scene on disk, of which one file is mutated."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.folder = name, folder
        self.file = FORMATS[name](folder)
        self.raw = self.file.read_bytes()
        assert self.load(), f"the scene of {name} is refused"
        self.usual = self.peak()

    def load(self) -> bool:
        """Whether the scene loads; false where it is refused."""
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numpy's, of overflow and the like
            survey(self.folder)
            try:
                load_scene(self.folder)
            except InputError as error:
                assert str(error).rstrip().endswith((".", "`")), f"no sentence: {error}"
                assert str(error).isprintable(), f"would steer a terminal: {error!r}"
                return False
            return True

    def peak(self) -> int:
        """Most bytes that loading holds at a time."""
        tracemalloc.start()
        try:
            self.load()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    def mutant(self, seed: int) -> bytes:
        """The file's content after one to three mutations."""
        rng = random.Random(f"{self.name} {seed}")
        raw = self.raw
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            raw = rng.choice(MUTATIONS)(rng, raw) if raw else raw
        return raw

    def attempt(self, seed: int, *, memory: bool) -> None:
        """Load a mutant.

        Raises:
            Exception: Anything but InputError, or AssertionError where it takes too much memory.
        """
        raw = self.mutant(seed)
        self.file.write_bytes(raw)
        with limited():
            if not memory:
                self.load()
                return
            peak, most = self.peak(), self.usual + TIMES * len(raw) + SPARE
            if peak > most:  # perhaps by another thread, whose memory is traced, too
                peak = min(peak, self.peak())
            assert peak <= most, f"took {peak} bytes for a file of {len(raw)}, usually {self.usual}"


def main() -> int:
    """Try mutants of all formats in turn for as long as asked; 1 if one failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=FORMATS)
    options = parser.parse_args()
    failed: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as place:
        names = [options.only] if options.only else list(FORMATS)
        targets = [Target(name, Path(place) / name) for name in names]
        tried, end, seed = 0, time.monotonic() + options.seconds, options.seed
        while True:
            for target in targets:
                tried += 1
                try:
                    target.attempt(seed, memory=seed % 2 == 0 or options.seconds == 0)
                except Exception as error:
                    failed[target.name] = failed.get(target.name, 0) + 1
                    print(
                        f"{target.name}, seed {seed}: {type(error).__name__}: {error}", flush=True
                    )
                    if failed[target.name] == 1 or options.seconds == 0:
                        traceback.print_exc()
            seed += 1
            if time.monotonic() >= end:
                break
    print(
        f"{tried} mutants of {len(targets)} formats, {sum(failed.values())} failed {failed or ''}"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
