"""The images that a scene file's frames name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import find_image


def find_images(
    folder: Path, file: Path, file_paths: Sequence[str], required: bool = True
) -> tuple[dict[int, Path], list[str]]:
    """Find the images of a scene file's frames; leave out the missing ones and the repeated ones.

    Args:
        folder: That paths are relative to, and must not leave.
        file: The scene file, for messages.
        file_paths: Of each frame, as the file has it.
        required: Whether one image at least must be there.

    Returns:
        The image of each frame that is kept, by the frame's index, and warnings of the others.

    Raises:
        InputError: A path leaves the folder, or no image is there though one is required.
    """
    found: dict[int, Path] = {}
    seen: set[Path] = set()
    missing: list[str] = []
    repeated: list[str] = []
    for index, file_path in enumerate(file_paths):
        path = find_image(folder, file_path, field=f"{file}: $.frames[{index}].file_path")
        if path is None:
            missing.append(file_path)
        elif path in seen:
            repeated.append(file_path)
        else:
            found[index] = path
            seen.add(path)
    if not found and not required:
        first = f" (first: {missing[0]})" if missing else ""
        return {}, [
            f"{file.name} is not used: none of the {len(file_paths)} images that it names is in "
            f"the folder{first}"
        ]
    if not file_paths:
        raise InputError(f"{file}: $.frames: is empty; a scene needs posed images.")
    if not found:
        raise InputError(
            f"{file}: $.frames[0].file_path: no image of {len(missing)} frames is in the folder "
            f"(first: {missing[0]}); put the images next to the file."
        )
    warnings = []
    if missing:
        warnings.append(
            f"{file.name}: left out {len(missing)} of {len(file_paths)} frames for want of an "
            f"image (first: {missing[0]})"
        )
    if repeated:
        warnings.append(
            f"{file.name}: left out {len(repeated)} of {len(file_paths)} frames for naming an "
            f"image again (first: {repeated[0]})"
        )
    return found, warnings
