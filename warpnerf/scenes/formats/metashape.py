"""Agisoft Metashape's cameras, exported as XML: lenses of sensors, poses of aligned cameras.

Poses are camera to chunk in OpenCV axes. The transform of a camera's component, else the chunk's,
leads on to the coordinates that the project has; those of the whole earth are turned to east, north
and up around the cameras' middle, because in metres from the centre of the earth nothing is exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.brown import brown_lens
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import MAX_JSON_BYTES, beginning, printable, require_regular_file
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.found_photographs import (
    Entry,
    Photographs,
    PosedCamera,
    scene_of,
)
from warpnerf.scenes.scene import Scene

LOOKED_AT = 4096
"""Bytes at the beginning of a file by which it is recognised."""

KINDS = {
    "frame": "BROWN",
    "fisheye": "BROWN_FISHEYE",
    "equidistant_fisheye": "BROWN_FISHEYE",
    "equisolid_fisheye": "BROWN_EQUISOLID",
}
"""Lenses by Metashape's types of sensors."""

GROUND = (-2e3, 2e4)
"""Metres above the ellipsoid within which cameras are taken to be geocentric: UTM has northings
as large, but hardly where its coordinates, taken for geocentric, are so near to the ellipsoid."""
LOCAL = "LOCAL_CS"
"""How a reference begins that is of no place on the earth, whatever its coordinates are."""
AXES = np.array([6378137.0, 6378137.0, 6356752.314245])
"""Half axes of WGS 84, metres."""


@dataclass(frozen=True)
class Transform:
    """From a chunk's coordinates to the project's: scale R x + t."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float


def find_metashape(folder: Path) -> list[Path]:
    """Files of cameras in a folder, by name, cameras.xml first."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() == ".xml"]
    except OSError:
        return []
    found = [path for path in sorted(files) if is_metashape(path)]
    return sorted(found, key=lambda path: path.name.lower() != "cameras.xml")


def is_metashape(file: Path) -> bool:
    """Whether a file begins as Metashape's do."""
    head = beginning(file, LOOKED_AT)
    return b"<document" in head and b"<chunk" in head


def load_metashape(file: Path, reading: Reading) -> Scene:
    """Load a scene from cameras of Metashape.

    Args:
        file: The XML.
        reading: How photographs are read.

    Returns:
        The scene, in the project's units: metres where it has scale.

    Raises:
        InputError: The file is damaged, a lens is not modelled, or no photograph is there.
    """
    chunk, notes = _chunk(file)
    aligned, more = _aligned(file, chunk)
    unread = _unread(file, chunk)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    poses, turned = _on_the_ground(_poses(file, chunk, aligned), chunk.findtext("reference", ""))

    def entry(camera: ElementTree.Element, pose: np.ndarray) -> Entry:
        place = f"{file}: {_place(camera)}"

        def read(path: Path) -> PosedCamera:
            sensor = sensors.get(camera.get("sensor_id", ""))
            if sensor is None:
                raise InputError(f"{place}: its sensor is not in the file; export it again.")
            c2w = check_pose(pose.tolist(), field=f"{place}: transform")
            return PosedCamera(c2w=c2w, lens=_lens(file, sensor))

        return Entry(name=camera.get("label", ""), place=place, read=read)

    entries = [entry(camera, pose) for camera, pose in zip(aligned, poses, strict=True)]
    photographs = Photographs(file.parent)
    return scene_of(file, entries, photographs, reading, lambda: ([*notes, *more, *turned], unread))


def _chunk(file: Path) -> tuple[ElementTree.Element, list[str]]:
    """The chunk of most aligned cameras, and a note of others."""
    require_regular_file(file)
    if file.stat().st_size > MAX_JSON_BYTES:
        raise InputError(f"{file}: is larger than {MAX_JSON_BYTES >> 20} MiB, so no cameras.")
    text = file.read_bytes()
    if b"<!" in text.replace(b"<!--", b"").replace(b"<![CDATA[", b""):
        raise InputError(f"{file}: declares entities or a document type; export it again.")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{file}: is no valid XML: {error}; export the cameras again.") from None
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    if not chunks:
        raise InputError(f"{file}: holds no chunk; export cameras in Agisoft XML.")
    counts = [sum(c.find("transform") is not None for c in _cameras(chunk)) for chunk in chunks]
    best = max(range(len(chunks)), key=lambda i: counts[i])
    if len(chunks) == 1:
        return chunks[0], []
    name = printable(chunks[best].get("label", "")[:40])
    return chunks[best], [
        f"{file.name}: of {len(chunks)} chunks {name!r} is read, that of most cameras "
        f"({counts[best]})"
    ]


def _cameras(chunk: ElementTree.Element) -> list[ElementTree.Element]:
    """Of a chunk, also those in groups."""
    cameras = chunk.find("cameras")
    return [] if cameras is None else list(cameras.iter("camera"))


def _aligned(file: Path, chunk: ElementTree.Element) -> tuple[list[ElementTree.Element], list[str]]:
    """The cameras that have a pose, in coordinates that are comparable; and notes of others."""
    cameras = _cameras(chunk)
    on = [camera for camera in cameras if camera.get("enabled", "1") not in ("0", "false")]
    aligned = [camera for camera in on if camera.find("transform") is not None]
    if not aligned and any(camera.find("transform") is not None for camera in cameras):
        n = sum(camera.find("transform") is not None for camera in cameras)
        raise InputError(
            f"{file}: its {n} cameras that are aligned are switched off; enable them, and export "
            "again."
        )
    if not aligned:
        raise InputError(
            f"{file}: none of its {len(cameras)} cameras is aligned; align them, and export again."
        )
    notes = []
    if len(on) < len(cameras):
        notes.append(
            f"{file.name}: left out {len(cameras) - len(on)} cameras that are switched off"
        )
    lost = [c for c in on if c.find("transform") is None and "master_id" not in c.attrib]
    if lost:
        notes.append(
            f"{file.name}: left out {len(lost)} of {len(on)} cameras that are not aligned (first: "
            f"{printable(lost[0].get('label', '')[:80])})"
        )
    parts: dict[str, list[ElementTree.Element]] = {}
    for camera in aligned:
        parts.setdefault(camera.get("component_id", ""), []).append(camera)
    placed = {c.get("id", "") for c in chunk.iterfind("components/component[transform]")}
    if len(parts) > 1 and not set(parts) <= placed:
        largest = max(parts.values(), key=len)
        notes.append(
            f"{file.name}: left out {len(aligned) - len(largest)} cameras of {len(parts) - 1} "
            "smaller components, which have no transform to the largest one"
        )
        aligned = largest
    return aligned, notes


def _unread(file: Path, chunk: ElementTree.Element) -> list[str]:
    """Warnings of what a chunk says of its cameras that is not read: rigs, rolling shutters."""
    cameras, warnings = _cameras(chunk), []
    rigged = [c for c in cameras if c.find("transform") is None and "master_id" in c.attrib]
    if rigged:
        warnings.append(
            f"{file.name}: left out {len(rigged)} of {len(cameras)} cameras (first: "
            f"{printable(rigged[0].get('label', '')[:80])}) that are placed by another one of their"
            " rig; export cameras for COLMAP, which has a pose for each"
        )
    rolling = [
        element.get("label", "")
        for element in (*chunk.iterfind("sensors/sensor"), *cameras)
        if any(map(_is_rolling, element.iter()))
    ]
    if rolling:
        warnings.append(
            f"{file.name}: rolling_shutter of {len(rolling)} sensors and cameras (first: "
            f"{printable(rolling[0][:80])}) is not used: each image is taken at one instant"
        )
    return warnings


def _is_rolling(element: ElementTree.Element) -> bool:
    """Whether an element, or the property that it is, says that a shutter rolled."""
    value = element.get("value", element.text or "").strip().lower()
    name = f"{element.tag} {element.get('name', '')}".lower()
    return "rolling" in name and value not in ("", "0", "false", "none", "disabled")


def _poses(
    file: Path, chunk: ElementTree.Element, cameras: Sequence[ElementTree.Element]
) -> np.ndarray:
    """Camera to world, [n, 3, 4], OpenGL axes."""
    own = _transform(file, "chunk", chunk.find("transform"))
    components = {
        part.get("id", ""): _transform(
            file, f"component {printable(part.get('id', '')[:20])}", part.find("transform")
        )
        for part in chunk.iterfind("components/component")
    }
    poses = []
    for camera in cameras:
        place = f"{_place(camera)}: transform"
        numbers = _numbers(file, place, camera.find("transform"), 16)
        pose = check_pose(numbers.reshape(4, 4).tolist(), field=f"{file}: {place}")
        to = components.get(camera.get("component_id", "")) or own
        if to is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # refused where they are checked
                position = to.scale * to.rotation @ pose[:, 3] + to.translation
            pose = np.concatenate([to.rotation @ pose[:, :3], position[:, None]], axis=1)
        poses.append(pose * [1.0, -1.0, -1.0, 1.0])
    return np.array(poses)


def _transform(file: Path, place: str, element: ElementTree.Element | None) -> Transform | None:
    """Of a chunk or a component; None where it has none."""
    if element is None or len(element) == 0:
        return None
    place = f"{place}: transform"
    parts = {
        name: _numbers(file, f"{place}: {name}", element.find(name), n)
        for name, n in (("rotation", 9), ("translation", 3), ("scale", 1))
        if element.find(name) is not None
    }
    scale = float(parts.get("scale", np.ones(1))[0])
    if not scale > 0.0:
        raise InputError(f"{file}: {place}: its scale is {scale:g}, not above 0; export it again.")
    rows = np.eye(3, 4)
    rows[:, :3] = parts.get("rotation", np.eye(3).ravel()).reshape(3, 3)
    rotation = check_pose(rows.tolist(), field=f"{file}: {place}: rotation")[:, :3]
    return Transform(rotation, parts.get("translation", np.zeros(3)), scale)


def _on_the_ground(poses: np.ndarray, reference: str) -> tuple[np.ndarray, list[str]]:
    """Poses in geocentric coordinates, turned to east, north and up around their middle."""
    middle = np.median(poses[:, :, 3], axis=0)
    height = (float(np.linalg.norm(middle / AXES)) - 1.0) * AXES[0]  # but for a hundredth of it
    if not GROUND[0] < height < GROUND[1] or reference.strip().startswith(LOCAL):
        return poses, []
    up = middle / AXES**2
    up /= np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    if np.linalg.norm(east) < 1e-6:
        east = np.array([0.0, 1.0, 0.0])
    east /= np.linalg.norm(east)
    turn = np.stack([east, np.cross(up, east), up])
    there = turn @ (poses - np.concatenate([np.zeros((3, 3)), middle[:, None]], axis=1))
    at = ", ".join(f"{value:.3f}" for value in middle)
    return there, [
        "geocentric coordinates are turned to east, north and up, in metres from the middle of the "
        f"cameras at ({at})"
    ]


def _lens(file: Path, sensor: ElementTree.Element) -> Lens:
    """The lens of a sensor."""
    place = f"sensor {printable(sensor.get('id', '')[:20])}"
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class") == "adjusted"]
    if not calibrations and sensor.get("type", "frame") in KINDS:
        raise InputError(
            f"{file}: {place}: has no calibration; align the cameras, and export again."
        )
    calibration = (adjusted or calibrations or [sensor])[-1]
    kind = calibration.get("type") or sensor.get("type", "frame")
    if kind not in KINDS:
        raise InputError(
            f"{file}: {place}: the lens {printable(str(kind)[:40])!r} is not modelled; export "
            "undistorted photographs from Metashape, with their cameras."
        )
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    sides = {} if resolution is None else resolution.attrib
    try:
        width, height = int(sides["width"]), int(sides["height"])
    except (KeyError, ValueError):
        width = height = 0
    if min(width, height) < 1:
        raise InputError(f"{file}: {place}: has no resolution in pixels; export it again.")
    names = ("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", *COEFFICIENTS)
    given = {
        name: float(_numbers(file, f"{place}: {name}", element, 1)[0])
        for name in names
        if (element := calibration.find(name)) is not None
    }
    if "fx" in given:  # PhotoScan's before 1.2: the principal point from the edges
        fx, fy = given["fx"], given.get("fy", given["fx"])
        cx, cy = given.get("cx", 0.5 * width), given.get("cy", 0.5 * height)
        slant, tangential = given.get("skew", 0.0), ("p2", "p1", "p3", "p4")
    else:
        if "f" not in given:
            raise InputError(f"{file}: {place}: has no focal length f; export it again.")
        fx, fy = given["f"] + given.get("b1", 0.0), given["f"]
        cx, cy = 0.5 * width + given.get("cx", 0.0), 0.5 * height + given.get("cy", 0.0)
        slant, tangential = given.get("b2", 0.0), ("p1", "p2", "p3", "p4")
    if min(fx, fy) <= 0.0:
        raise InputError(f"{file}: {place}: its focal length must be above 0; export it again.")
    return brown_lens(
        file,
        place,
        {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height},
        radial=[given.get(name, 0.0) for name in COEFFICIENTS[:4]],
        tangential=[given.get(name, 0.0) for name in tangential],
        skew=slant / fx,
        kind=KINDS[kind],
    )


COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def _numbers(file: Path, place: str, element: ElementTree.Element | None, n: int) -> np.ndarray:
    """The numbers of an element, [n]."""
    words = ("" if element is None else element.text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != n or not all(map(math.isfinite, numbers)):
        many = "a finite number" if n == 1 else f"{n} finite numbers"
        raise InputError(f"{file}: {place}: holds something else than {many}; export it again.")
    return np.array(numbers)


def _place(camera: ElementTree.Element) -> str:
    return f"camera {printable(camera.get('label', '')[:80])!r}"
