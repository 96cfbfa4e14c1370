"""Photographs without poses, and an answer that COLMAP might give for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image

from tests.support.tiny_scenes import picture, ring

N = 12
PLY = """ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 0 0
"""


class Colmap:
    """Stands for ``sfm.worker.estimate``: places photographs on a ring."""

    def __init__(self) -> None:
        self.job: dict[str, Any] = {}
        self.changes: dict[str, Any] = {}
        self.lost: tuple[str, ...] = ()
        self.lens: dict[str, Any] = {"model": "SIMPLE_RADIAL"}

    def __call__(self, job: dict[str, Any], on_report: Any) -> dict[str, Any]:
        self.job = job
        names = [p["name"] for p in job["photographs"]]
        for name in names:
            assert (Path(job["images"]) / name).is_file()
        on_report("features", len(names), len(names))
        placed = [name for name in names if name not in self.lost]
        Path(job["model"]).mkdir(parents=True)
        (Path(job["model"]) / "points.bin").touch()
        Path(job["points"]).write_text(PLY)
        poses = zip(placed, ring(len(placed)), strict=True)
        lens = {"w": 8, "h": 6, "fl_x": 10.0, "fl_y": 10.0, "cx": 4.0, "cy": 3.0, "k1": 0.01}
        return {
            "registered": {name: p[:3].tolist() for name, p in poses},
            "cameras": dict.fromkeys(placed, lens | self.lens),
            "points": 321,
            "error": 0.5,
            "groups": [placed],
            "features": dict.fromkeys(names, 1000),
            "links": {},
        } | self.changes


def photographs(folder: Path, n: int = N, times: int = 1) -> Path:
    folder.mkdir(parents=True)
    for k in range(n):
        Image.fromarray(picture(k, width=8 * times, height=6 * times)).save(folder / f"{k:02}.png")
    return folder


def listing(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
