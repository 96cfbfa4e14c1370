"""images.txt of COLMAP as programs other than COLMAP write it, and people edit it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scenes.test_colmap import posed, scene_with_model
from warpnerf.checks import InputError
from warpnerf.scenes.formats.colmap_files import images_of_text
from warpnerf.scenes.formats.load import load_scene

POSES = [
    f"{number + 1} {' '.join(map(repr, map(float, (*q, *t))))} 7 {name}"
    for number, (q, t, name) in enumerate(posed(4))
]
KEYPOINTS = "1.5 2.5 -1 3.0 4.0 17"
NAMES = [f"{number:03d}.png" for number in range(4)]


def read(folder: Path, text: str) -> list[str]:
    (folder / "images.txt").write_bytes(text.encode())
    return [image.name for image in images_of_text(folder / "images.txt")]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    "text",
    [
        "# a\n\n" + "".join(f"{pose}\n\n" for pose in POSES),
        "\n \n# a\n\n" + "".join(f"{pose}\n{KEYPOINTS}\n" for pose in POSES),
        "".join(f"{pose}\n{KEYPOINTS}\n\n" for pose in POSES),
        "".join(f"{pose}\n\n\n\n" for pose in POSES),
        "".join(f"{pose}\n{KEYPOINTS}\n# next\n\n# one\n" for pose in POSES),
        f"{POSES[0]}\n\n{POSES[1]}\n{KEYPOINTS}\n\n{POSES[2]}\n\n\n{POSES[3]}",
        "\ufeff# a\n" + "".join(f"{pose}\n{KEYPOINTS}\n" for pose in POSES),
        "\ufeff" + "".join(f"{pose}\n\n" for pose in POSES),
    ],
)
def test_blank_lines_and_comments_are_skipped_before_an_image(
    tmp_path: Path, text: str, end: str
) -> None:
    assert read(tmp_path, text.replace("\n", end)) == NAMES
    assert all(image.keypoints for image in images_of_text(tmp_path / "images.txt"))


@pytest.mark.parametrize(
    ("text", "bare"),
    [
        ("\n".join(POSES), [0, 1, 2, 3]),
        ("# a\n" + "\n".join(POSES[:3]) + "\n", [0, 1, 2]),  # an odd number of lines
        ("\n".join([POSES[0], "", *POSES[1:], KEYPOINTS]), [1, 2]),
        ("\n".join([*POSES[:2], KEYPOINTS, *POSES[2:], ""]) + "\n", [0, 2]),
        ("".join(f"{pose}\n# next\n" for pose in POSES), [0, 1, 2, 3]),
    ],
)
def test_an_image_in_place_of_keypoints_is_read(tmp_path: Path, text: str, bare: list[int]) -> None:
    assert read(tmp_path, text) == NAMES[: text.count("png")]
    images = images_of_text(tmp_path / "images.txt")
    assert [index for index, image in enumerate(images) if not image.keypoints] == bare


def test_names_with_spaces_and_folders_are_images_too(tmp_path: Path) -> None:
    poses = [pose.replace(".png", " of 12/a 1 2.png") for pose in POSES]
    assert read(tmp_path, "\n".join(poses)) == [pose.split(maxsplit=9)[9] for pose in poses]


def test_images_without_keypoints_are_all_of_the_scene_and_named(tmp_path: Path) -> None:
    file = scene_with_model(tmp_path, text=True) / "images.txt"
    whole = load_scene(tmp_path)
    assert not any("keypoints" in text for text in whole.warnings)
    file.write_text("\n".join(POSES) + "\n")
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == NAMES
    assert "4 of 4 images have no line for their keypoints (first: 000.png)" in scene.warnings[0]


@pytest.mark.parametrize(
    "line",
    [
        "1.5 x -1",
        POSES[2].rpartition(" ")[0],  # a pose without a name is no three keypoints
        POSES[1].replace("001.png", "001"),  # may be keypoints, cut short
        POSES[1].replace("2 ", "two ", 1),
    ],
)
def test_what_is_neither_keypoints_nor_an_image_is_refused(tmp_path: Path, line: str) -> None:
    text = "\n".join(["# a", POSES[0], line, *POSES[2:]])
    with pytest.raises(InputError, match=r"images.txt: line 3: is neither .* '?\"?000.png.* empty"):
        read(tmp_path, text)


def test_keypoints_may_be_written_as_other_programs_do(tmp_path: Path) -> None:
    for keypoints in ("1 2 -1", "1e2\t-2.5 -1.0", "nan inf 3", " ".join([KEYPOINTS] * 1000)):
        assert read(tmp_path, "".join(f"{pose}\n{keypoints}\n" for pose in POSES)) == NAMES


@pytest.mark.parametrize(
    "line", ["0 0", "0", "1.5 2.5 -1 3.0", "-nan(ind) 2 -1", "-1.#IND 1 -1", "1 2 0.5"]
)
def test_other_numbers_stand_for_keypoints_with_a_warning(tmp_path: Path, line: str) -> None:
    file = scene_with_model(tmp_path, text=True) / "images.txt"
    file.write_text("".join(f"{pose}\n{line}\n" for pose in POSES))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == NAMES
    (warning,) = scene.warnings
    assert "images.txt: the keypoints of 4 of 4 images are no X Y POINT3D_ID" in warning
