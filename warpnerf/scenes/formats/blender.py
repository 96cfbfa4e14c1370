"""Blender / NeRF-synthetic: one file of frames per split, RGBA images with straight alpha.

``transforms_train.json``, and where they exist ``transforms_test.json`` and
``transforms_val.json``, take the same keys as a transforms.json; mostly there is only
``camera_angle_x``, and the image's extension is left out.
"""

from __future__ import annotations

from pathlib import Path

from warpnerf.scenes.files import beginning, exists
from warpnerf.scenes.formats.assemble import Reading, assemble
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.formats.transforms import read_frames
from warpnerf.scenes.scene import Scene

SPLITS = ("train", "val", "test")

LOOKED_AT = 65536
"""Bytes at the beginning of a file by which it is recognised."""
MOST = 64
"""Files of JSON of any names, at most, that are looked at."""


def split_file(split: str) -> str:
    """Return the file name that holds a split."""
    return f"transforms_{split}.json"


def is_split(file: Path) -> bool:
    """Whether a file is one of a Blender scene's, which has at least the one for training."""
    train = file.with_name(split_file("train"))
    return file.name in map(split_file, SPLITS) and (file == train or exists(train))


def other_transforms(folder: Path) -> list[Path]:
    """Files of frames in a folder, called transforms*.json or not, that are read only where they
    are named, by name."""
    names = {"transforms.json"}
    if exists(folder / split_file("train")):
        names.update(map(split_file, SPLITS))
    try:
        files = sorted(folder.glob("[!.]*.json"))
    except OSError:
        return []
    called = [path for path in files if path.name.startswith("transforms")]
    others = filter(is_frames, [path for path in files if path not in called][:MOST])
    return [path for path in [*called, *others] if path.name not in names]


def is_frames(file: Path) -> bool:
    """Whether a file of JSON, of whatever name, begins as one of posed frames."""
    head = beginning(file, LOOKED_AT)
    return b'"frames"' in head and b'"transform_matrix"' in head


def load_blender(folder: Path, reading: Reading) -> Scene:
    """Load a scene from transforms_train.json and its siblings.

    Without transforms_test.json, or without its images, every 8th training image is for testing.

    Args:
        folder: The scene's folder; image paths are relative to it and stay inside it.
        reading: How photographs are to be read.

    Raises:
        InputError: Something in the files or the images is wrong; the message names it.
    """
    frames: dict[str, Frame] = {}
    splits: dict[str, set[str]] = {}
    warnings: list[str] = []
    for split in SPLITS:
        file = folder / split_file(split)
        if split != "train" and not exists(file):
            continue
        taken = [frame.path for frame in frames.values()]
        _, found, found_warnings = read_frames(file, required=split == "train", taken=taken)
        # An image in two files keeps the first file's pose.
        for frame in found:
            frames.setdefault(frame.name, frame)
        splits[split] = {frame.name for frame in found}
        warnings += found_warnings
    return assemble(
        folder=folder,
        file=folder / split_file("train"),
        frames=list(frames.values()),
        splits=splits,
        warnings=warnings,
        reading=reading,
    )
