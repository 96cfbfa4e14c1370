"""Captures as scanning apps and photogrammetric programs export them: which a folder holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from warpnerf.scenes.files import printable
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.metashape import find_metashape, is_metashape, load_metashape
from warpnerf.scenes.formats.polycam import find_polycam, load_polycam
from warpnerf.scenes.formats.reality import find_reality, is_reality, load_reality
from warpnerf.scenes.formats.record3d import NAMES, find_record3d, load_record3d
from warpnerf.scenes.scene import Scene


@dataclass(frozen=True)
class Export:
    """What a program exported."""

    program: str
    """Its name."""
    path: Path
    """The file or folder that holds the cameras."""
    load: Callable[[Path, Reading], Scene]

    def described(self, folder: Path) -> str:
        """The program, and where in a folder the cameras are."""
        name = self.path.name if self.path.parent == folder else self.path.relative_to(folder)
        return f"{self.program} ({printable(Path(name).as_posix())})"


def exports_in(folder: Path) -> list[Export]:
    """All exports in a folder, or among photographs in its images/, the one to choose first."""
    found: list[Export] = []
    polycam, record3d = find_polycam(folder), find_record3d(folder)
    if polycam is not None:
        found.append(Export("Polycam", polycam, load_polycam))
    if record3d is not None:
        found.append(Export("Record3D", record3d, load_record3d))
    for place in (folder, folder / "images"):
        found += [Export("Metashape", path, load_metashape) for path in find_metashape(place)]
        found += [Export("RealityCapture", path, load_reality) for path in find_reality(place)]
    return found


def export_of(file: Path) -> Export | None:
    """The export that a file is; None where it is none."""
    if file.name in NAMES:
        found = find_record3d(file.parent)
        return Export("Record3D", file, load_record3d) if found == file else None
    if file.suffix.lower() == ".xml" and is_metashape(file):
        return Export("Metashape", file, load_metashape)
    if file.suffix.lower() == ".csv" and is_reality(file):
        return Export("RealityCapture", file, load_reality)
    return None
