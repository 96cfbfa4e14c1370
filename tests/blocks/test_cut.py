"""Cutting scenes into blocks: cells fill space, photographs go where they look."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.cli_process import make_scene
from tests.support.tiny_scenes import look_at, ring, tiny_scene
from warpnerf.blocks.cut import cut, fills, seen_by
from warpnerf.blocks.folder import BlockFolder, stored_source, write_blocks
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene


def long_scene() -> Scene:
    """Four clusters of cameras along x, each of which looks at a place of its own close by."""
    middles = (-6.0, -2.0, 2.0, 6.0)
    poses = []
    for x in middles:
        for k in range(4):
            eye = (x + 0.3 * k - 0.45, -1.0, 0.2 * k)
            poses.append(look_at(eye, (x, 0.0, 0.0)))
    scene = tiny_scene([*poses, look_at((6.0, -1.0, 0.3), (6.0, 0.0, 0.0))])
    box = np.array([[-8.0, -2.0, -1.0], [8.0, 2.0, 1.0]])
    return replace(scene, box_min=box[0], box_max=box[1], content_distance=1.0)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_every_place_is_in_one_cell(count: int) -> None:
    blocks = cut(long_scene(), count)
    places = np.random.default_rng(0).normal(size=(500, 3)) * (9.0, 3.0, 3.0)
    inside = [((b.cell[0] <= places) & (places < b.cell[1])).all(axis=1) for b in blocks]
    assert len(blocks) == count and (np.sum(inside, axis=0) == 1).all()
    for block in blocks:
        assert (block.box[0] < block.core[0]).all() and (block.core[1] < block.box[1]).all()


def test_what_fills_a_box() -> None:
    cores = np.stack([block.core for block in cut(long_scene(), 5)])
    box = np.array([cores[:, 0].min(axis=0), cores[:, 1].max(axis=0)])
    assert (
        fills(cores, box) and not fills(cores, box[::-1]) and not fills(cores, np.sign(box) * 1e308)
    )
    for number, end, axis in np.ndindex(cores.shape):
        for change in (-0.1, 0.1):
            moved = cores.copy()
            moved[number, end, axis] += change
            assert not fills(moved, box)
    assert not fills(cores[1:], box) and not fills(np.concatenate([cores, cores[:1]]), box)
    twice = np.stack([box, box])  # the lower half: as large as the box in all
    twice[:, 1, 0] = box[:, 0].mean()
    assert not fills(twice, box)
    assert not fills(box[None] + 1.0, box)


def test_photographs_train_the_blocks_that_they_see() -> None:
    blocks = cut(long_scene(), 4)
    assert [block.views for block in blocks] == [
        tuple(range(4 * k, 4 * k + 4 + (k == 3))) for k in range(4)
    ]
    np.testing.assert_allclose([b.core[0, 0] for b in blocks], [-8.0, -4.0, 0.0, 4.0], atol=1.0)


def test_depth_and_points_tell_what_is_seen() -> None:
    scene = tiny_scene(ring(4))
    camera = scene.views[0].camera
    views = [replace_depth(scene, 2.0), *scene.views[1:]]
    away = np.linalg.norm(seen_by(replace(scene, views=views), 0) - camera.position, axis=1)
    np.testing.assert_allclose(away, 2.0)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    points = np.concatenate([points, camera.position + 90.0 * camera.forward[None]])
    seen = seen_by(replace(scene, points=points), 0)
    assert len(seen) >= 8 and np.abs(seen).max() <= 0.2


def replace_depth(scene: Scene, depth: float) -> object:
    view = scene.views[0]
    size = (view.camera.height, view.camera.width)
    return replace(view, depth=np.full(size, depth, np.float32))


def test_more_blocks_than_photographs_are_refused() -> None:
    with pytest.raises(InputError, match=r"--count 99 .* has 16 training photographs"):
        cut(long_scene(), 99)


def test_the_scene_of_a_block_has_its_photographs_and_box(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    whole = load_scene(path, images="files", split=2)
    source = stored_source(str(path), 1, None, 2)
    blocks = cut(whole, 2)
    made = write_blocks(tmp_path / "blocks", whole, source, blocks)
    assert np.array_equal(BlockFolder.read(tmp_path / "blocks").cells, [b.cell for b in blocks])
    for number, block in enumerate(blocks):
        part = load_scene(made.part(number))
        names = [whole.views[index].name for index in block.views]
        assert [view.name for view in part.views] == names and part.unbounded
        trained = {whole.views[index].name for index in whole.splits["train"]}
        assert {part.views[index].name for index in part.splits["train"]} == trained & {*names}
        np.testing.assert_allclose([part.box_min, part.box_max], block.box)
        assert isinstance(part.views[0].__dict__["image"], np.ndarray)
    with pytest.raises(InputError, match="is there already"):
        write_blocks(tmp_path / "blocks", whole, source, blocks)
    text = made.part(0).read_text().replace('"images/', '"other/')
    made.part(0).write_text(text)
    with pytest.raises(InputError, match="is not the capture that the part was made of"):
        load_scene(made.part(0))
