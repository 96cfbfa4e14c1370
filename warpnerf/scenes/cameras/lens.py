"""Lenses as files give them: focal lengths or angles, centre and distortion, checked by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.foreign import ForeignLens, ImagePlane, fitted
from warpnerf.scenes.cameras.undistort import COEFFICIENTS, has_invertible_distortion

FISHEYE = "OPENCV_FISHEYE"
RATIONAL = "FULL_OPENCV"
"""The lens whose k4, k5 and k6 are those of a divisor. nerfstudio takes the k4 of other lenses for
another thing: the factor of r^8."""
CAMERA_MODELS = (
    *("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"),
    *(RATIONAL, FISHEYE),
)

OTHER_NAMES = {"PERSPECTIVE": "OPENCV"}
"""What nerfstudio's kinds of cameras are called here."""
FOCAL_KEYS = ("fl_x", "camera_angle_x", "fl_y", "camera_angle_y")

# The first of a group wins within one level of the file, so that a frame's own angle is not
# overruled by a focal length that the file gives for all frames.
KEY_GROUPS = (
    FOCAL_KEYS[:2],
    FOCAL_KEYS[2:],
    *((key,) for key in ("cx", "cy", "w", "h", *COEFFICIENTS)),
)

MIN_FOCAL = 0.02
"""Shortest focal length, in sizes of the image: a field of view of 178 degrees."""
MAX_FOCAL = 1e6
"""Longest focal length, in sizes of the image."""
MIN_RESIZED = 1.015
"""Least factor by which photographs are resized; by less, they rather are cropped or padded."""
MAX_DIFFERENCE = 0.01
"""Of a focal length and a field of view that mean the same, as a share."""
MIN_ANGLE = 1e-100
"""Smallest field of view whose focal length is a number at all, radians."""
MAX_OFF_CENTRE = 50.0
"""Largest distance of the principal point from the middle, in sizes of the image."""

UNSUPPORTED_LENSES = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
ADVICE = "undistort the images to a pinhole camera (colmap image_undistorter)"


class LensFields(msgspec.Struct):
    """The keys of instant-ngp and nerfstudio that describe a lens, for a file or for one frame."""

    camera_model: str | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None
    is_fisheye: bool | None = None
    ftheta_p0: object = None
    latlong: object = None
    equirectangular: object = None
    orthographic: object = None

    def __post_init__(self) -> None:
        """Names of models are one in upper and lower case."""
        if self.camera_model is not None:
            upper = self.camera_model.upper()
            known = upper in CAMERA_MODELS or upper in OTHER_NAMES
            self.camera_model = OTHER_NAMES.get(upper, upper) if known else self.camera_model


MAX_COEFFICIENT = 1e9
"""Of distortion: even of long telephoto lenses, k1 is some hundreds, and k3 some millions."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens whose missing values follow from the size of its image."""

    file: Path
    """The scene file, for messages."""
    values: Mapping[str, float]
    """What the file says, under its own names: pixels of the whole image, radians, coefficients."""
    fields: Mapping[str, str]
    """Where in the file each of ``values`` stands."""
    fisheye: bool = False
    """Whether it is OpenCV's fisheye lens."""
    foreign: ForeignLens | None = None
    """Where it is none of OpenCV's lenses: its distortion, which ``values`` then do not hold."""
    angles: Mapping[str, float] = field(default_factory=dict)
    """Fields of view that stand beside focal lengths, which are used in their place: radians, by
    their places in the file."""
    doubt: str = ""
    """What the file contradicts itself in, and which of it is used."""

    def camera(self, *, width: int, height: int, c2w: np.ndarray, image: str) -> Camera:
        """Complete the lens for an image of ``width`` by ``height`` pixels.

        fl = size / (2 tan(angle / 2)); without fl_y fl_y = fl_x; without cx, cy the middle.

        Raises:
            InputError: The file states another shape, or the distortion folds the image over.
        """
        values = self._values(width, height)
        for key, size in (("w", width), ("h", height)):
            if key in values and values[key] != size:
                stated = f"{values.get('w', width):g}x{values.get('h', height):g}"
                turned = (values.get("w"), values.get("h")) == (height, width)
                raise InputError(
                    f"{self.file}: {self.fields[key]}: the file is for images of {stated} pixels, "
                    f"but {image} has {width}x{height}"
                    + (
                        ": either it is stored turned, so save the images upright, without an EXIF "
                        "rotation, or width and height are exchanged in the file."
                        if turned
                        else "; use the original images, or change w, h, fl_x, fl_y, cx and cy "
                        "with them."
                    )
                )
        fx, fy = self._focal_lengths(width, height)
        camera = Camera(
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=values.get("cx", width / 2),
            cy=values.get("cy", height / 2),
            c2w=c2w,
            fisheye=self.fisheye,
            **{name: values.get(name, 0.0) for name in COEFFICIENTS},
        )
        self._check_proportions(camera, image)
        nearest = self.nearest(camera, image)
        if nearest is not None:
            return nearest[1]
        coefficients = {k: values[k] for k in COEFFICIENTS if values.get(k)}
        for name, value in coefficients.items():
            if abs(value) > MAX_COEFFICIENT:
                raise InputError(
                    f"{self.file}: {self.fields[name]} = {value:g} is the distortion of no lens; "
                    "calibrate again, or leave it out."
                )
        if coefficients and not has_invertible_distortion(camera):
            named = ", ".join(f"{self.fields[k]} = {v:g}" for k, v in coefficients.items())
            raise InputError(
                f"{self.file}: the distortion {named} folds over within the image {image}, so it "
                "cannot be undone; calibrate again, or crop or undistort the images."
            )
        return camera

    def nearest(self, camera: Camera, image: str) -> tuple[ImagePlane, Camera, float] | None:
        """The lens of OpenCV's that is nearest to that of another program.

        Args:
            camera: For an image, with its focal lengths and principal point.
            image: For messages.

        Returns:
            The image's plane; the camera with that lens; and the most that it is off, pixels. None
            where the lens is one of OpenCV's.

        Raises:
            InputError: The lens shows nearly nothing of the image.
        """
        if self.foreign is None:
            return None
        width, height = camera.width, camera.height
        fx, fy = self._focal_lengths(width, height)
        values = self._values(width, height)
        cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
        plane = ImagePlane(width, height, fx, fy, cx, cy)
        found = fitted(self.foreign, plane)
        if found is None:
            named = ", ".join(f"{value:g}" for value in self.foreign.parameters)
            raise InputError(
                f"{self.file}: {self.fields['fl_x']}: with it, and the parameters {named}, the "
                f"lens {self.foreign.model} shows nearly nothing of {image}, {width}x{height}; "
                "calibrate again, or undistort the images."
            )
        return plane, replace(found[0], c2w=camera.c2w), found[1]

    def contradiction(self, width: int, height: int) -> str:
        """In what the file contradicts itself, for an image of a size, and what is used; or ""."""
        values = self._values(width, height)
        for place, angle in sorted(self.angles.items()):
            axis, size = ("x", width) if place.endswith("x") else ("y", height)
            used, other = values[f"fl_{axis}"], _focal_length(angle, size)
            of_blender = _focal_length(angle, max(width, height)) if axis == "x" else other
            if min(abs(other - used), abs(of_blender - used)) > MAX_DIFFERENCE * used:
                return (
                    f"{self.fields[f'fl_{axis}']} is {used:.4g} pixels, which is used, but by "
                    f"{place}, {math.degrees(angle):.4g} degrees of {size} pixels, it is "
                    f"{other:.4g}; remove the wrong one"
                )
            if values.get("fl_y") == used:  # Blender's angle_y may be that of its sensor
                break
        return self.doubt

    def other_focal_length(self, width: int, height: int) -> float | None:
        """That of a portrait by the only angle, were it Blender's, of the longer side; else None.

        Blender's angle_x is that of the sensor's width, and its sensor fit Auto lays that along the
        longer side.
        """
        if height <= width or self.values.keys() & {"fl_x", "fl_y", "camera_angle_y"}:
            return None
        return _focal_length(self.values["camera_angle_x"], height)

    def was_for(self, width: int, height: int) -> tuple[float, float] | None:
        """The size that the file states, where an image is one of that size that was resized; else
        None.

        Both sides have then changed, by the same factor, to a pixel, and by more than what is
        cropped or padded; and the principal point tells that the lens is for the stated size: it is
        nearer to the middle of that.
        """
        w, h = self.values.get("w", 0.0), self.values.get("h", 0.0)
        if min(w, h) < 1.0 or abs(width * h - height * w) > max(w, h):
            return None
        if 1.0 / MIN_RESIZED < max(width, height) / max(w, h) < MIN_RESIZED:
            return None
        for name, stated, size in (("cx", w, width), ("cy", h, height)):
            centre = self.values.get(name, size / 2)
            if abs(centre - stated / 2) >= abs(centre - size / 2):
                return None
        return w, h

    def _values(self, width: int, height: int) -> Mapping[str, float]:
        """``values`` for an image of ``width`` by ``height`` pixels, which may be resized."""
        stated = self.was_for(width, height)
        if stated is None:
            return self.values
        across, along = width / stated[0], height / stated[1]
        factors = {"fl_x": across, "cx": across, "fl_y": along, "cy": along}
        scaled = {key: value * factors.get(key, 1.0) for key, value in self.values.items()}
        return {**scaled, "w": width, "h": height}

    def _focal_lengths(self, width: int, height: int) -> tuple[float, float]:
        """Focal lengths along u and v, pixels; one stands in for the other where it is missing."""
        values = self._values(width, height)
        lengths = {}
        for axis, size in (("x", width), ("y", height)):
            if f"fl_{axis}" in values:
                lengths[axis] = values[f"fl_{axis}"]
            elif f"camera_angle_{axis}" in values:
                lengths[axis] = _focal_length(values[f"camera_angle_{axis}"], size)
        (any_length, *_) = lengths.values()
        return lengths.get("x", any_length), lengths.get("y", any_length)

    def _check_proportions(self, camera: Camera, image: str) -> None:
        """Refuse numbers that cannot be pixels of this image, such as shares of its size."""
        sides = (
            ("x", camera.fx, camera.cx, camera.width),
            ("y", camera.fy, camera.cy, camera.height),
        )
        for axis, focal, centre, size in sides:
            if not MIN_FOCAL < focal / size < MAX_FOCAL:
                own = (f"fl_{axis}", f"camera_angle_{axis}")
                field = next(self.fields[key] for key in (*own, *FOCAL_KEYS) if key in self.fields)
                what = f"a focal length of {focal:g} pixels"
            elif abs(centre - 0.5 * size) > MAX_OFF_CENTRE * size:
                field, what = self.fields[f"c{axis}"], f"a principal point at {centre:g} pixels"
            else:
                continue
            raise InputError(
                f"{self.file}: {field}: means {what}, which cannot be for {image} of "
                f"{camera.width}x{camera.height}; give pixels of the whole image."
            )


def _focal_length(angle: float, size: int) -> float:
    """Of a field of view, radians, across so many pixels."""
    return 0.5 * size / math.tan(0.5 * angle)


def read_lens(file: Path, levels: Sequence[tuple[str, LensFields]]) -> Lens:
    """Gather a lens from the levels of a scene file.

    Args:
        file: The scene file, for messages.
        levels: (place in the file, its lens keys), nearest first: the frame, then the whole file.

    Raises:
        InputError: No focal length, a value out of its range, or a lens that is not modelled.
    """
    values: dict[str, float] = {}
    fields: dict[str, str] = {}
    angles: dict[str, float] = {}
    for place, level in levels:
        _refuse_unsupported(file, place, level)
    fisheye, doubt = _is_fisheye(levels)
    for group in KEY_GROUPS:
        for place, level in levels:
            key = next((key for key in group if getattr(level, key) is not None), None)
            if key is not None:
                values[key], fields[key] = getattr(level, key), f"{place}.{key}"
                others = {f"{place}.{name}": getattr(level, name) for name in group if name != key}
                angles |= {name: value for name, value in others.items() if value is not None}
                break
    for key, value in values.items():
        _check_value(file, fields[key], key, value)
    if not values.keys() & set(FOCAL_KEYS):
        raise InputError(
            f"{file}: {levels[0][0]}: has no focal length; add fl_x (pixels) or camera_angle_x "
            "(radians)."
        )
    if fisheye:
        _check_fisheye(file, values, fields)
    elif next((level.camera_model for _, level in levels if level.camera_model), "") != RATIONAL:
        _refuse_divisor(file, values, fields)
    return Lens(
        file=file,
        values=values,
        fields=fields,
        fisheye=fisheye,
        angles={} if fisheye else {k: v for k, v in angles.items() if MIN_ANGLE < v < math.pi},
        doubt=doubt,
    )


def _is_fisheye(levels: Sequence[tuple[str, LensFields]]) -> tuple[bool, str]:
    """Whether it is a fisheye lens, by the first level that says it; and what contradicts that."""
    for place, level in levels:
        if level.camera_model is not None:
            fisheye = level.camera_model == FISHEYE
            if level.is_fisheye in (None, fisheye):
                return fisheye, ""
            return fisheye, (
                f"{place}.camera_model is {level.camera_model}, which is used, but {place}."
                f"is_fisheye is {str(level.is_fisheye).lower()}; correct the wrong one"
            )
        if level.is_fisheye is not None:
            return level.is_fisheye, ""
    return False, ""


def _refuse_divisor(file: Path, values: Mapping[str, float], fields: Mapping[str, str]) -> None:
    for key in ("k4", "k5", "k6"):
        if values.get(key):
            raise InputError(
                f"{file}: {fields[key]}: is read as OpenCV's of a rational lens, and only where "
                f'camera_model is "{RATIONAL}"; write that if it is one, else {ADVICE}.'
            )


def _check_fisheye(file: Path, values: Mapping[str, float], fields: Mapping[str, str]) -> None:
    for key in ("p1", "p2", "k5", "k6"):
        if values.get(key):
            raise InputError(
                f"{file}: {fields[key]}: a fisheye lens has none; calibrate the lens as {FISHEYE}, "
                "with k1 to k4 only."
            )
    for key in ("camera_angle_x", "camera_angle_y"):
        if key in values:
            raise InputError(
                f"{file}: {fields[key]}: does not give a fisheye lens's focal length; add fl_x "
                "(pixels)."
            )


def _check_value(file: Path, field: str, key: str, value: float) -> None:
    if key.startswith("camera_angle"):
        if not MIN_ANGLE < value < math.pi:
            raise InputError(
                f"{file}: {field}: {value:g} is not a field of view; give radians between 0 and pi."
            )
    elif key.startswith("fl_"):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{file}: {field}: {value:g} is no focal length; give pixels above 0.")
    elif not math.isfinite(value):
        raise InputError(f"{file}: {field}: {value:g} is not a finite number; correct it.")


def _refuse_unsupported(file: Path, place: str, level: LensFields) -> None:
    for key in UNSUPPORTED_LENSES:
        if getattr(level, key):
            raise InputError(f"{file}: {place}.{key}: that lens is not modelled; {ADVICE}.")
    if level.camera_model is not None and level.camera_model not in CAMERA_MODELS:
        raise InputError(
            f"{file}: {place}.camera_model: {level.camera_model[:40]!r} is none of "
            f"{', '.join(CAMERA_MODELS)}; {ADVICE}."
        )
