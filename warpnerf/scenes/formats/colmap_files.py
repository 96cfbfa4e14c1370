"""Cameras and images of COLMAP's sparse models, as their binary and text files have them.

Counts in the files are believed only as far as the file is long.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from warpnerf.checks import InputError
from warpnerf.scenes.files import printable

PARAMETERS = {
    "SIMPLE_PINHOLE": ("fl", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("fl", "cx", "cy", "k1"),
    "RADIAL": ("fl", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("fl", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("fl", "cx", "cy", "k1", "k2"),
    "SIMPLE_FISHEYE": ("fl", "cx", "cy"),
    "FISHEYE": ("fl_x", "fl_y", "cx", "cy"),
    "FOV": ("fl_x", "fl_y", "cx", "cy", "omega"),
    "THIN_PRISM_FISHEYE": (
        *("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fl_x", "fl_y", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5"),
        *("p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": ("fl", "cx", "cy", "k"),
    "DIVISION": ("fl_x", "fl_y", "cx", "cy", "k"),
    "EUCM": ("fl_x", "fl_y", "cx", "cy", "alpha", "beta"),
}
"""Of the lenses that are read, in the order of the files."""

MODEL_NAMES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE"),
    *("EUCM", "EQUIRECTANGULAR"),
)
"""By their numbers in cameras.bin."""

HEAD = 4096
"""Characters at the beginning of images.txt among which its comments are."""

DIGITS = "0123456789+-.eE"
NUMERIC = DIGITS + " \tnaif"
"""Of lines of numbers, which may be nan or inf."""
WHOLE = re.compile(r"[-+]?\d+")
ODD_NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE
)
"""Of keypoints; those that are no numbers as the compiler of a program on Windows writes them."""


@dataclass(frozen=True)
class ModelCamera:
    """A lens of a model."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A posed photograph of a model."""

    number: int
    name: str
    camera: int
    rotation: tuple[float, float, float, float]
    """World to camera, quaternion w, x, y, z."""
    translation: tuple[float, float, float]
    keypoints: bool = True
    """Whether a line for its keypoints, empty or not, follows that of its pose in images.txt."""
    odd_keypoints: bool = False
    """Whether that line has numbers other than X, Y and POINT3D_ID of each keypoint."""


class _Bytes:
    """A binary file, read from its beginning; what is beyond its end is refused."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._data = file.read_bytes()
        self._at = 0

    def take(self, format: str) -> tuple[Any, ...]:
        """Numbers, by a format of ``struct`` without the order of bytes."""
        size = struct.calcsize("<" + format)
        self._require(size)
        values = struct.unpack_from("<" + format, self._data, self._at)
        self._at += size
        return values

    def count(self, least: int, what: str) -> int:
        """A number of things that take at least so many bytes each."""
        (n,) = self.take("Q")
        if n * least > len(self._data) - self._at:
            raise InputError(
                f"{self._file}: is damaged: it counts {n} {what}, but ends before; export it again."
            )
        return int(n)

    def text(self) -> str:
        """Up to the next zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            self._require(len(self._data))
        text = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return text

    def skip(self, size: int) -> None:
        """Leave out so many bytes."""
        self._require(size)
        self._at += size

    def _require(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise InputError(
                f"{self._file}: is damaged: it ends after {len(self._data)} bytes, within an "
                "entry; export it again."
            )


def _require_new(file: Path, number: int, cameras: Mapping[int, ModelCamera]) -> None:
    """Raise InputError where a camera's number is one of these already."""
    if number in cameras:
        raise InputError(
            f"{file}: two cameras have the number {number}; remove one of them, or export it again."
        )


def cameras_of_bytes(file: Path) -> dict[int, ModelCamera]:
    """Cameras of cameras.bin by their numbers; InputError where it is damaged."""
    data = _Bytes(file)
    cameras: dict[int, ModelCamera] = {}
    for _ in range(data.count(24, "cameras")):
        number, model, width, height = data.take("IiQQ")
        if not 0 <= model < len(MODEL_NAMES):
            raise InputError(f"{file}: camera {number}: its lens has the unknown number {model}.")
        name = MODEL_NAMES[model]
        parameters = PARAMETERS.get(name)
        if parameters is None:
            raise InputError(
                f"{file}: camera {number}: the lens {name} is not modelled; undistort the images "
                "to a pinhole camera (colmap image_undistorter)."
            )
        _require_new(file, number, cameras)
        cameras[number] = ModelCamera(name, width, height, data.take(f"{len(parameters)}d"))
    return cameras


def images_of_bytes(file: Path) -> list[ModelImage]:
    """Images of images.bin, in its order; InputError where it is damaged."""
    data = _Bytes(file)
    images = []
    for _ in range(data.count(4 + 7 * 8 + 4 + 1 + 8, "images")):
        (number,) = data.take("I")
        values = data.take("7d")
        (camera,) = data.take("I")
        name = data.text()
        data.skip(24 * data.count(24, "points of an image"))
        images.append(ModelImage(number, name, camera, values[:4], values[4:]))
    return images


def _lines(file: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments; empty lines stay: they may be of no keypoints."""
    try:
        text = file.read_text(encoding="utf-8-sig")  # editors of Windows begin it with a mark
    except UnicodeDecodeError:
        raise InputError(f"{file}: is no text in UTF-8; export it again.") from None
    lines = enumerate(text.splitlines(), 1)
    return [(number, line.strip()) for number, line in lines if not line.lstrip().startswith("#")]


def _parsed(file: Path, number: int, what: str, parse: Callable[[], Any]) -> Any:
    try:
        return parse()
    except (ValueError, IndexError):
        raise InputError(f"{file}: line {number}: is no {what} as COLMAP writes it.") from None


def cameras_of_text(file: Path) -> dict[int, ModelCamera]:
    """Cameras of cameras.txt by their numbers; InputError where a line is none."""
    cameras: dict[int, ModelCamera] = {}
    for number, line in _lines(file):
        if not line:
            continue
        words = line.split()

        def parse(words: list[str] = words) -> tuple[int, ModelCamera]:
            camera = ModelCamera(
                words[1], int(words[2]), int(words[3]), tuple(map(float, words[4:]))
            )
            return int(words[0]), camera

        key, camera = _parsed(file, number, "camera", parse)
        _require_new(file, key, cameras)
        cameras[key] = camera
    return cameras


def stated_images(file: Path) -> int:
    """How many images a comment of COLMAP's says there are; 0 where there is none."""
    with file.open(encoding="utf-8") as opened:
        head = opened.read(HEAD)
    comment = re.search(r"^# Number of images: (\d{1,9})\b", head, re.MULTILINE)
    return int(comment[1]) if comment else 0


def first_of_text(file: Path) -> ModelImage | None:
    """The first image of images.txt; None where it is none. No more than its head is read."""
    try:
        if not file.is_file():
            return None
        with file.open(encoding="utf-8-sig") as opened:
            lines = opened.read(HEAD).splitlines()
        return _image(next(line for line in lines if line.strip() and line.lstrip()[0] != "#"))
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def images_of_text(file: Path) -> list[ModelImage]:
    """Images of images.txt, in its order: a line of the pose each, and one of its keypoints.

    As in COLMAP's reader, empty lines are skipped before the line of a pose. The line after it is
    that of the keypoints, unless it is another pose: some programs leave keypoints out, and some
    write other numbers.

    Raises:
        InputError: A line is neither.
    """
    images: list[ModelImage] = []
    posed = False  # the line before was that of a pose
    for number, line in _lines(file):
        if posed and _are_keypoints(line):
            posed = False
            continue
        if not line:
            continue
        image: ModelImage | None = None
        if not posed:
            image = _parsed(file, number, "image", partial(_image, line))
        else:
            with suppress(ValueError, IndexError):
                image = _image(line)
            if image is None and _are_odd_keypoints(line):
                images[-1] = replace(images[-1], odd_keypoints=True)
                posed = False
                continue
            if image is None or not image.name.strip(DIGITS):
                raise InputError(
                    f"{file}: line {number}: is neither the keypoints of image "
                    f"{printable(images[-1].name[:80])!r}, X Y POINT3D_ID of each, nor another "
                    "image; give each image two lines, of which the second may be empty."
                )
            images[-1] = replace(images[-1], keypoints=False)
        images.append(image)
        posed = True
    if posed and not all(image.keypoints for image in images):
        images[-1] = replace(images[-1], keypoints=False)
    return images


def _image(line: str) -> ModelImage:
    """A line of IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; ValueError or IndexError if not."""
    words = line.split(maxsplit=9)
    w, x, y, z, *translation = map(float, words[1:8])
    a, b, c = translation
    return ModelImage(int(words[0]), words[9], int(words[8]), (w, x, y, z), (a, b, c))


def _are_odd_keypoints(line: str) -> bool:
    """Whether a line has numbers only, and not those of a pose whose name is missing."""
    words = line.split()
    if not all(ODD_NUMBER.fullmatch(word) for word in words):
        return False
    return not (len(words) >= 9 and WHOLE.fullmatch(words[0]) and WHOLE.fullmatch(words[8]))


def _are_keypoints(line: str) -> bool:
    """Whether a line has three numbers each of any number of keypoints, the third of them whole."""
    if line.strip(NUMERIC):
        return False
    words = line.split()
    if len(words) % 3:
        return False
    try:
        return all(float(word).is_integer() for word in words[2:3])
    except ValueError:
        return False
