"""The scene of ``tiny_scenes.write_transforms`` as other programs would have exported it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.scenes.test_colmap import quaternion
from tests.support.tiny_scenes import picture, ring

LENS = {"fl_x": 10.0, "fl_y": 11.0, "cx": 4.25, "cy": 2.75, "w": 8, "h": 6}


def write_pictures(folder: Path, names: Sequence[str], scale: int = 1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        Image.fromarray(picture(k, width=8 * scale, height=6 * scale)).save(folder / name)


def write_polycam(folder: Path, n: int = 4, corrected: bool = True) -> Path:
    """Returns the folder of cameras."""
    keyframes = folder / "keyframes"
    prefix = "corrected_" if corrected else ""
    write_pictures(keyframes / f"{prefix}images", [f"{100 + k}.png" for k in range(n)])
    cameras = keyframes / f"{prefix}cameras"
    cameras.mkdir()
    (keyframes / "depth").mkdir()
    for k, pose in enumerate(ring(n)):
        content: dict[str, Any] = {"fx": 10.0, "fy": 11.0, "cx": 4.25, "cy": 2.75}
        content |= {"width": 8, "height": 6, "blur_score": 90.0, "timestamp": k}
        content |= {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        (cameras / f"{100 + k}.json").write_text(json.dumps(content))
        depth = np.full((3, 4), 1000 + k, np.uint16)
        Image.fromarray(depth).save(keyframes / f"depth/{100 + k}.png")
    return cameras


def write_record3d(folder: Path, n: int = 4, scale: int = 1, **changes: Any) -> Path:
    """Returns the file; photographs are scale times as large as it says."""
    write_pictures(folder / "rgbd", [f"{k}.png" for k in range(n)], scale)
    poses = []
    for pose in ring(n):
        w, x, y, z = quaternion(pose[:3, :3])
        poses.append([x, y, z, w, *pose[:3, 3].tolist()])
    content: dict[str, Any] = {"w": 8, "h": 6, "fps": 60, "dw": 4, "dh": 3, "poses": poses}
    content["K"] = [10.0, 0.0, 0.0, 0.0, 11.0, 0.0, 4.25, 2.75, 1.0]
    (folder / "metadata.json").write_text(json.dumps(content | changes))
    return folder / "metadata.json"


def metashape_pose(pose: np.ndarray) -> str:
    """A camera's transform: OpenCV axes, sixteen numbers."""
    matrix = np.eye(4)
    matrix[:3] = pose[:3] * [1.0, -1.0, -1.0, 1.0]
    return " ".join(map(repr, matrix.ravel().tolist()))


SENSOR = """<sensor id="3" label="lens" type="frame">
<resolution width="8" height="6"/>
<calibration type="frame" class="initial"><f>99</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="8" height="6"/>
<f>11</f><cx>0.25</cx><cy>-0.25</cy><b1>-1</b1></calibration>
</sensor>"""


def write_metashape(
    folder: Path,
    n: int = 4,
    sensor: str = SENSOR,
    rest: str = "",
    component: str = "",
    poses: Sequence[np.ndarray] | None = None,
) -> Path:
    """Returns the file; one camera more is not aligned."""
    write_pictures(folder / "images", [f"{k:03d}.png" for k in range(n)])
    rows = [
        f'<camera id="{k}" sensor_id="3" {component} label="{k:03d}">'
        f"<transform>{metashape_pose(pose)}</transform></camera>"
        for k, pose in enumerate(ring(n) if poses is None else poses)
    ]
    rows.append(f'<camera id="{n}" sensor_id="3" label="lost"/>')
    group = f'<group id="0" label="g">{rows[0]}</group>'
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">\n'
        f'<chunk label="Chunk 1" enabled="true"><sensors next_id="4">{sensor}</sensors>{rest}'
        f"<cameras>{group}{''.join(rows[1:])}</cameras></chunk></document>\n"
    )
    return folder / "cameras.xml"


HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def angles(pose: np.ndarray) -> tuple[float, float, float]:
    """Heading, pitch and roll of a pose in OpenGL axes, degrees: R = Rz(-h) Rx(p) Ry(r)."""
    r = pose[:3, :3]
    pitch = math.asin(max(-1.0, min(1.0, r[2, 1])))
    heading = math.atan2(r[0, 1], r[1, 1])
    roll = math.atan2(-r[2, 0], r[2, 2])
    return math.degrees(heading), math.degrees(pitch), math.degrees(roll)


def write_reality(folder: Path, n: int = 4, lens: str = "0,0,0,0,0,0") -> Path:
    """Returns the file; the lens is of 10 pixels, its principal point at (4.25, 2.75)."""
    write_pictures(folder / "images", [f"{k:03d}.png" for k in range(n)])
    rows = [HEADER]
    for k, pose in enumerate(ring(n)):
        numbers = [*pose[:3, 3].tolist(), *angles(pose), 10.0 * 36.0 / 8.0, 0.25 / 8, -0.25 / 8]
        rows.append(f"{k:03d}.png,{','.join(map(repr, map(float, numbers)))},{lens}")
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n")
    return folder / "cameras.csv"
