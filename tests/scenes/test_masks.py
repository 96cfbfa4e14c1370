"""Masks: which are found, how they are read, and that nothing is learnt of what they hide."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import warpnerf as wn
from tests.scenes.test_colmap import scene_with_model, write_model
from tests.support.cli_process import assert_refused, assert_trained, command, make_scene, train
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import (
    picture,
    ring,
    save,
    tiny_scene,
    write_blender,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.config import GridConfig
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.inspection.inspection import inspect
from warpnerf.scenes.builtin.room import room_scene
from warpnerf.scenes.formats.contents import photographs_in
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.images.masks import Mask, read_mask, without_masks
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.state import scene_digest

KEPT = picture(7)[:, :, 0] > 100
"""[6, 8], as large as the photographs of the tiny scenes."""


def white(kept: np.ndarray) -> np.ndarray:
    return np.where(kept, np.uint8(255), np.uint8(0))


def save_mask(path: Path, kept: np.ndarray = KEPT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(white(kept)).save(path)
    return path


def masks_of(scene: Scene) -> dict[str, Any]:
    return {view.name: view.mask for view in scene.views}


KINDS: dict[str, Callable[[], Image.Image]] = {
    "gray": lambda: Image.fromarray(white(KEPT)),
    "bits": lambda: Image.fromarray(white(KEPT)).convert("1"),
    "rgb": lambda: Image.fromarray(white(KEPT)).convert("RGB"),
    "palette": lambda: Image.fromarray(white(KEPT)).convert("P"),
    "zeros and ones": lambda: Image.fromarray(KEPT.astype(np.uint8)),
    "16 bits": lambda: Image.fromarray(np.where(KEPT, 65535, 0).astype(np.uint16)),
    "255 in 16 bits": lambda: Image.fromarray(white(KEPT).astype(np.uint16)),
    "opaque": lambda: Image.fromarray(np.dstack([white(KEPT)] * 3 + [np.full((6, 8), 255, "u1")])),
    "alpha": lambda: Image.fromarray(np.dstack([np.full((6, 8, 3), 255, "u1"), white(KEPT)])),
    "one channel of three": lambda: Image.fromarray(
        np.dstack([0 * white(KEPT), white(KEPT)] * 2)[..., :3]
    ),
    "shades": lambda: Image.fromarray(np.where(KEPT, 160, 90).astype(np.uint8)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_image_is_a_mask(tmp_path: Path, kind: str) -> None:
    KINDS[kind]().save(tmp_path / "mask.png")
    found = read_mask(Mask(tmp_path / "mask.png"), width=8, height=6, downscale=1)
    assert found.dtype == np.bool_ and np.array_equal(found, KEPT)


def test_white_is_ignored_where_instant_ngp_means_that(tmp_path: Path) -> None:
    Image.fromarray(np.where(KEPT, 0, 7).astype(np.uint8)).save(tmp_path / "mask.png")
    mask = Mask(tmp_path / "mask.png", white_counts=False)
    assert np.array_equal(read_mask(mask, width=8, height=6, downscale=1), KEPT)


def test_a_pixel_that_stands_for_several_counts_if_all_do(tmp_path: Path) -> None:
    fine = np.kron(KEPT, np.ones((3, 3), bool))
    fine[0, 0] = False
    expected = KEPT.copy()
    expected[0, 0] = False
    path = save_mask(tmp_path / "mask.png", np.pad(fine, ((0, 2), (0, 1))))  # of rows cut off
    assert np.array_equal(read_mask(Mask(path), width=8, height=6, downscale=1), expected)
    blocks = expected.reshape(3, 2, 4, 2).all(axis=(1, 3))
    assert np.array_equal(read_mask(Mask(path), width=8, height=6, downscale=2), blocks)
    path = save_mask(tmp_path / "small.png", blocks)
    assert np.array_equal(read_mask(Mask(path), width=8, height=6, downscale=2), blocks)


@pytest.mark.parametrize("size", [(6, 8), (8, 7), (9, 6), (12, 9), (16, 15), (4, 3)])
def test_another_size_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    Image.new("L", size, 255).save(tmp_path / "mask.png")
    says = rf"mask\.png: has {size[0]}x{size[1]} pixels, but its photograph 8x6; make"
    with pytest.raises(InputError, match=says):
        read_mask(Mask(tmp_path / "mask.png"), width=8, height=6, downscale=1)


# where masks are found


def test_frames_name_their_masks(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    save_mask(tmp_path / "masks" / "a.png")
    content["frames"][1]["mask_path"] = "masks/a"
    content["frames"][2]["mask_path"] = "masks/none.png"
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    found = masks_of(scene)
    assert np.array_equal(found.pop("images/001.png"), KEPT)
    assert list(found.values()) == [None] * 3
    (warning,) = scene.warnings
    assert "the mask_path of 1 of 4 frames leads to no file (first: masks/none.png)" in warning
    share = f"{1 - (~KEPT).sum() / (4 * 48):.1%}"
    assert f"1 of 4 images have pixels that are ignored; {share} of all pixels count" in scene.notes


def test_a_folder_of_masks_that_is_not_used_is_told(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    save_mask(tmp_path / "masks" / "001.png")
    (warning,) = load_scene(tmp_path).warnings
    assert warning.startswith(f"{tmp_path / 'masks'} is not used") and "--masks" in warning
    assert not load_scene(tmp_path, masks=tmp_path / "masks").warnings


def test_a_mask_may_be_that_of_all_frames(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    save_mask(tmp_path / "car.png")
    save(tmp_path / "transforms.json", {**content, "mask_path": "car.png"})
    assert all(np.array_equal(mask, KEPT) for mask in masks_of(load_scene(tmp_path)).values())


def test_a_mask_outside_the_scene_is_refused(tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "scene")
    content["frames"][1]["mask_path"] = str(save_mask(tmp_path / "mask.png"))
    save(tmp_path / "scene" / "transforms.json", content)
    with pytest.raises(
        InputError, match=r"\$\.frames\[1\]\.mask_path: .* leaves the scene's folder"
    ):
        load_scene(tmp_path / "scene")


def test_masks_of_instant_ngp_lie_beside_the_photographs(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    save_mask(tmp_path / "images" / "dynamic_mask_002.png", ~KEPT)
    found = masks_of(load_scene(tmp_path))
    assert np.array_equal(found["images/002.png"], KEPT)
    assert found["images/001.png"] is None


@pytest.mark.parametrize("name", ["001.png.mask.png", "001.mask.png", "001_mask.png"])
@pytest.mark.parametrize("colmap", [False, True])
def test_masks_that_lie_beside_photographs_are_used(
    tmp_path: Path, name: str, colmap: bool
) -> None:
    (scene_with_model if colmap else write_transforms)(tmp_path)
    save_mask(tmp_path / "images" / name)
    found = masks_of(load_scene(tmp_path))
    photograph = "001.png" if colmap else "images/001.png"
    assert np.array_equal(found.pop(photograph), KEPT)
    assert set(found.values()) == {None}
    assert [path.name for path in photographs_in(tmp_path)] == [f"{k:03}.png" for k in range(4)]
    save_mask(tmp_path / "given" / "003.png")
    given = masks_of(load_scene(tmp_path, masks=tmp_path / "given"))
    assert given[photograph] is None


@pytest.mark.parametrize("place", ["images/001_mask.png", "masks/001.png"])
def test_what_only_has_a_masks_name_and_does_not_fit_is_left_aside(
    tmp_path: Path, place: str
) -> None:
    write_transforms(tmp_path)
    if place.startswith("masks"):
        (tmp_path / "transforms.json").unlink()
        write_model(tmp_path)
        (tmp_path / "masks").mkdir()
    Image.new("L", (4, 3), 255).save(tmp_path / place)
    scene = load_scene(tmp_path)
    assert set(masks_of(scene).values()) == {None}
    (warning,) = scene.warnings
    assert warning.startswith("not used as masks: 1 images of another size")
    assert warning.endswith(f"(first: {Path(place).name})")
    assert not load_scene(tmp_path, downscale=2).warnings  # it is as large as photographs then are
    (tmp_path / place).write_text("no image")
    assert load_scene(tmp_path).warnings == (warning,)


def test_masks_among_images_are_told_by_their_names_alone() -> None:
    names = ("a/1.jpg", "a/1.jpg.mask.png", "a/2.png", "a/2_mask.jpg", "a/dynamic_mask_2.png")
    paths = [Path(name) for name in (*names, "b/1.mask.png", "b/2.png", "b/2_mask.png")]
    left = [path.as_posix() for path in without_masks(paths)]
    assert left == ["a/1.jpg", "a/2.png", "a/2_mask.jpg", "b/1.mask.png", "b/2.png"]


def test_a_photograph_may_be_called_a_mask(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    frame = content["frames"][3]
    (tmp_path / frame["file_path"]).rename(tmp_path / "images" / "002_mask.png")
    frame["file_path"] = "images/002_mask.png"
    save(tmp_path / "transforms.json", content)
    assert set(masks_of(load_scene(tmp_path)).values()) == {None}


@pytest.mark.parametrize("name", ["001.png.png", "001.png", "001.jpg"])
def test_masks_of_colmap_are_named_after_photographs(tmp_path: Path, name: str) -> None:
    scene_with_model(tmp_path)
    path = tmp_path / "masks" / name
    save_mask(path.with_suffix(".png")).rename(path)
    found = masks_of(load_scene(tmp_path))
    assert np.array_equal(found["001.png"], KEPT) and found["000.png"] is None


@pytest.mark.parametrize("name", ["images/001.png.png", "images/001.png", "001.png", "001.png.png"])
def test_a_folder_of_masks_takes_the_place_of_others(tmp_path: Path, name: str) -> None:
    content = write_transforms(tmp_path)
    save_mask(tmp_path / "all.png", ~KEPT)
    save(tmp_path / "transforms.json", {**content, "mask_path": "all.png"})
    save_mask(tmp_path / "given" / name)
    found = masks_of(load_scene(tmp_path, masks=tmp_path / "given"))
    assert np.array_equal(found.pop("images/001.png"), KEPT)
    assert list(found.values()) == [None] * 3
    assert "1 of 4 images have pixels" in str(inspect(tmp_path, masks=tmp_path / "given"))


def test_a_folder_of_masks_for_blender_and_llff(tmp_path: Path) -> None:
    write_blender(tmp_path / "scene", "train", ring(4), channels=3)
    write_blender(tmp_path / "scene", "test", ring(2), channels=3)
    save_mask(tmp_path / "masks" / "test" / "r_1.png")
    found = masks_of(load_scene(tmp_path / "scene", masks=tmp_path / "masks"))
    assert [name for name, mask in found.items() if mask is not None] == ["test/r_1.png"]


def test_a_folder_without_masks_of_the_scene_is_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    with pytest.raises(
        InputError, match=r"masks: holds no mask of 4 photographs .first: images/000"
    ):
        load_scene(tmp_path, masks=tmp_path / "masks")
    with pytest.raises(InputError, match=r"--masks .*nowhere: is no folder"):
        load_scene(tmp_path, masks=tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"builtin:room takes no masks"):
        load_scene("builtin:room", masks=tmp_path)


# what they leave


def around_masks(folder: Path, kept: np.ndarray, n: int = 9) -> str:
    """Warnings of masks of a scene whose cameras look at its middle, the first n of nine masked."""
    content = write_transforms(folder, 9)
    save_mask(folder / "mask.png", kept)
    for frame in content["frames"][:n]:
        frame["mask_path"] = "mask.png"
    save(folder / "transforms.json", content)
    return "; ".join(w for w in load_scene(folder).warnings if "mask" in w)


def test_masks_that_ignore_what_all_look_at_are_told_however_small_it_is(tmp_path: Path) -> None:
    middle = np.zeros((6, 8), bool)
    middle[2:5, 3:6] = True
    said = "masks leave 81.2% of the pixels, and in few images a point that most cameras look at"
    assert said in around_masks(tmp_path / "inverted", ~middle)
    assert around_masks(tmp_path / "right", middle) == ""
    assert around_masks(tmp_path / "some", ~middle, 7) == ""
    edge = np.ones((6, 8), bool)
    edge[:, :2] = False
    assert around_masks(tmp_path / "edge", edge) == ""


def test_masks_that_ignore_nothing_are_told(tmp_path: Path) -> None:
    said = around_masks(tmp_path / "all", KEPT | True)
    assert said.startswith("masks ignore no pixel: none of 9 has one that is black (first: mask.p")
    assert around_masks(tmp_path / "one", KEPT) == ""


def test_images_of_which_nothing_is_left_are_left_out(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 9)
    for number, kept in ((2, KEPT & False), (3, KEPT | True)):
        save_mask(tmp_path / f"{number}.png", kept)
        content["frames"][number]["mask_path"] = f"{number}.png"
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    assert "images/002.png" not in masks_of(scene) and len(scene.views) == 8
    assert [len(scene.splits[split]) for split in ("train", "test")] == [6, 2]
    assert masks_of(scene)["images/003.png"] is None  # all of it counts
    (warning,) = scene.warnings
    assert warning.startswith(
        "left out 1 of 9 images of which masks leave no pixel (first: images/0"
    )


def test_masks_that_leave_nothing_or_little_are_told(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    save_mask(tmp_path / "all.png", KEPT & False)
    save(tmp_path / "transforms.json", {**content, "mask_path": "all.png"})
    with pytest.raises(
        InputError, match=r"leave no pixel of any training image; white pixels count"
    ):
        load_scene(tmp_path)
    save_mask(tmp_path / "all.png", np.arange(48).reshape(6, 8) < 2)
    (warning,) = load_scene(tmp_path).warnings
    assert warning.startswith("masks leave 4.2% of the pixels: white ones count")


def test_masks_that_leave_less_than_half_are_told_but_where_they_leave_the_focus(
    tmp_path: Path,
) -> None:
    """Masks of an object leave little, and people who walk by are as large."""
    content = write_transforms(tmp_path)
    save(tmp_path / "transforms.json", {**content, "mask_path": "all.png"})

    def told(kept: slice) -> list[str]:
        save_mask(tmp_path / "all.png", np.broadcast_to(np.eye(8, dtype=bool)[kept].any(0), (6, 8)))
        return [text for text in load_scene(tmp_path).warnings if "masks leave" in text]

    assert told(slice(3, 6)) == []
    assert told(slice(0, 4)) == []
    said = "masks leave 37.5% of the pixels, and in few images a point that most cameras look at: "
    assert [text.startswith(said) for text in told(slice(0, 3))] == [True]
    for i, frame in enumerate(content["frames"]):  # behind each other, to look at no point
        frame["transform_matrix"] = np.eye(4).tolist()
        frame["transform_matrix"][2][3] = -1.0 * i
    save(tmp_path / "transforms.json", {**content, "mask_path": "all.png"})
    assert told(slice(0, 3)) == []


def test_views_refuse_masks_that_are_not_theirs() -> None:
    view = tiny_scene(ring(3)).views[0]
    for mask, says in (
        (KEPT[:-1], r"must be bool \[6, 8\]"),
        (white(KEPT), r"must be bool"),
        (KEPT & False, "leaves no pixel"),
    ):
        with pytest.raises(InputError, match=says):
            replace(view, mask=mask)


def test_pixels_that_a_fisheye_does_not_see_are_masked(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, scale=4)
    lens = {"fl_x": 4.5, "fl_y": 4.5, "cx": 16.0, "cy": 12.0, "camera_model": "OPENCV_FISHEYE"}
    save(tmp_path / "transforms.json", content | lens)
    v, u = np.indices((24, 32)) + 0.5
    seen = np.hypot(u - 16.0, v - 12.0) <= 4.5 * np.pi
    for mask in masks_of(load_scene(tmp_path)).values():
        assert np.array_equal(mask, seen)
    half = masks_of(load_scene(tmp_path, downscale=2))["images/000.png"]
    v, u = np.indices((12, 16)) + 0.5
    assert np.array_equal(half, np.hypot(u - 8.0, v - 6.0) <= 2.25 * np.pi)


def test_masks_are_kept_as_bits(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    save_mask(tmp_path / "all.png")
    save(tmp_path / "transforms.json", {**content, "mask_path": "all.png"})
    view = load_scene(tmp_path).views[1]
    assert view.__dict__["mask"].bits.nbytes == 6
    assert np.array_equal(view.mask, KEPT) and view.mask.dtype == np.bool_
    again = replace(view, name="again")
    assert np.array_equal(again.mask, KEPT) and again.depth is None


def test_a_training_knows_its_masks() -> None:
    scene = tiny_scene(ring(4))
    masked = replace(scene, views=[replace(view, mask=KEPT) for view in scene.views])
    other = replace(scene, views=[replace(view, mask=~KEPT) for view in scene.views])
    assert len({scene_digest(one) for one in (scene, masked, other)}) == 3


# training


@pytest.mark.usefixtures("compiled_kernels")
def test_the_command_remembers_the_folder_of_masks(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    kept = np.kron(KEPT, np.ones((2, 2), bool))
    for number in range(4):
        save_mask(tmp_path / "masks" / f"{number:03}.png", kept)
    done = train(scene, "--masks", "masks", "--keep", "checkpoint", folder=tmp_path)
    assert_trained(done)
    assert "4 of 4 images have pixels that are ignored" in done.out
    assert json.loads((done.run / "config.json").read_text())["masks"] == str(tmp_path / "masks")
    psnr = json.loads((done.run / "metrics.json").read_text())["mean"]["psnr"]
    again = command("eval", done.run, "--json", done.run / "e.json", folder=tmp_path)
    assert json.loads((done.run / "e.json").read_text())["mean"]["psnr"] == psnr, again.err
    command("eval", done.run, "--scene", scene, "--json", done.run / "e.json", folder=tmp_path)
    assert json.loads((done.run / "e.json").read_text())["mean"]["psnr"] != psnr
    shown = np.asarray(Image.open(done.run / "test" / "images_000.png"))[:12, :16]
    truth = np.asarray(Image.open(scene / "images" / "000.png"))
    assert np.array_equal(shown[kept], truth[kept])
    np.testing.assert_allclose(shown[~kept], 0.25 * truth[~kept] + 0.7 * 255, atol=0.51)

    assert train("--resume", done.run, folder=tmp_path).code == 2  # with --output
    gone = command("train", "--resume", done.run, "--masks", scene / "images", folder=tmp_path)
    assert gone.code == 2 and "its photographs, masks, cameras or split have changed" in gone.err
    (tmp_path / "masks").rename(tmp_path / "moved")
    gone = command("train", "--resume", done.run, folder=tmp_path)
    assert gone.code == 2 and "masks: the masks that the run was trained with are gone" in gone.err
    moved = command("train", "--resume", done.run, "--masks", "moved", folder=tmp_path)
    assert moved.code == 0, moved.err


@pytest.mark.parametrize("size", [(8, 8), (24, 18)])
def test_the_command_refuses_masks_of_another_size(tmp_path: Path, size: tuple[int, int]) -> None:
    scene = make_scene(tmp_path, lambda c: c["frames"][1].update(mask_path="mask.png"))
    Image.new("L", size, 255).save(scene / "mask.png")
    assert_refused(train(scene, folder=tmp_path), "mask.png", "its photograph 16x12", "as large as")


def with_person(view: View, rng: np.random.Generator, masked: bool) -> View:
    """A photograph in which somebody in plain colours stands before an eighth of what it shows."""
    height, width = view.image.shape[:2]
    top, left = rng.integers(0, height // 2), rng.integers(0, 3 * width // 4)
    where = np.zeros((height, width), bool)
    where[top : top + height // 2, left : left + width // 4] = True
    image = np.where(where[..., None], rng.integers(0, 256, 3, np.uint8), view.image)
    return replace(view, image=image, mask=~where if masked else None)


@pytest.mark.slow  # three trainings of seconds
def test_what_masks_hide_is_not_learnt(device: str) -> None:
    """With masks photographs with people in them are worth nearly as much as clean ones."""
    clean = room_scene(4)
    train = clean.splits["train"]
    psnr = {}
    for kind in ("clean", "person", "masked"):
        rng = np.random.default_rng(0)
        views = list(clean.views)
        for index in train if kind != "clean" else ():
            views[index] = with_person(views[index], rng, kind == "masked")
        grid = GridConfig(voxels=32**3)
        config = wn.TrainConfig(
            model="rgb",
            loss=SQUARED,
            steps=300,
            rays_per_step=2048,
            grid=grid,
            device=device,
        )
        result = wn.train(replace(clean, views=views), config)
        psnr[kind] = evaluate(result.field, clean).mean["psnr"]
    assert psnr["person"] < psnr["clean"] - 1.0, psnr
    assert psnr["clean"] - psnr["masked"] < 0.5 * (psnr["clean"] - psnr["person"]), psnr


@pytest.mark.parametrize(("rows", "columns"), [(12, 16), (11, 15), (13, 17), (11, 17)])
def test_a_mask_of_the_whole_picture_fits_a_reduced_one(
    tmp_path: Path, rows: int, columns: int
) -> None:
    """Whoever reduces rounds: to 8 x 6 from 15 x 11, and from 17 x 13."""
    kept = np.ones((rows, columns), bool)
    kept[3, 4] = kept[-1, -1] = False
    Image.fromarray(kept).save(tmp_path / "mask.png")
    found = read_mask(Mask(tmp_path / "mask.png"), width=8, height=6, downscale=1)
    expected = np.ones((6, 8), bool)
    expected[1, 2] = expected[5, 7] = False
    if rows == 13:  # the last row and column are left over
        expected[5, 7] = True
    if (rows, columns) == (11, 17):
        expected[5, 7] = True
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("size", [(18, 12), (16, 14), (7, 6), (8, 8)])
def test_a_mask_of_another_size_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    Image.new("L", size, 255).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match="make the mask as large as the photograph"):
        read_mask(Mask(tmp_path / "mask.png"), width=8, height=6, downscale=1)
