"""The method of nerfbaselines, without nerfbaselines: what it would pass is made here."""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.scenes.cameras.camera import Camera

SHORT = {"steps": "12", "rays_per_step": "64", "voxels": "4096", "model": "rgb", "threads": "1"}


@dataclass(frozen=True)
class Cameras:
    """The arrays of nerfbaselines' cameras."""

    poses: np.ndarray
    intrinsics: np.ndarray
    camera_models: np.ndarray
    distortion_parameters: np.ndarray
    image_sizes: np.ndarray

    def __getitem__(self, index: int) -> "Cameras":
        return Cameras(*(array[index] for array in vars(self).values()))

    def item(self) -> "Cameras":
        return self


def cameras_of(cameras: list[Camera], model: int = 1) -> Cameras:
    def opencv(camera: Camera) -> np.ndarray:
        return camera.c2w * np.array([1.0, -1.0, -1.0, 1.0])

    return Cameras(
        poses=np.array([opencv(c) for c in cameras], np.float32),
        intrinsics=np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float32),
        camera_models=np.full(len(cameras), model, np.int32),
        distortion_parameters=np.array(
            [(c.k1, c.k2, c.p1, c.p2, c.k3, c.k4, c.k5, c.k6) for c in cameras]
        ),
        image_sizes=np.array([(c.width, c.height) for c in cameras], np.int32),
    )


@pytest.fixture
def method(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module, with a stand-in for nerfbaselines that keeps what is registered."""
    stand_in = ModuleType("nerfbaselines")
    stand_in.registered = []  # type: ignore[attr-defined]
    stand_in.register = stand_in.registered.append  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "nerfbaselines", stand_in)
    monkeypatch.delitem(sys.modules, "warpnerf.nerfbaselines", raising=False)
    module = importlib.import_module("warpnerf.nerfbaselines")
    yield module
    sys.modules.pop("warpnerf.nerfbaselines", None)


@pytest.fixture
def dataset() -> dict[str, Any]:
    scene = tiny_scene(ring(6))
    return {
        "cameras": cameras_of(scene.cameras),
        "images": [view.image for view in scene.views],
        "image_paths": [f"/data/room/{view.name}" for view in scene.views],
        "image_paths_root": "/data/room",
        "metadata": {"background_color": None},
    }


def test_it_is_registered_as_the_project_says(method: Any) -> None:
    (spec,) = sys.modules["nerfbaselines"].registered  # type: ignore[attr-defined]
    module, _, name = spec["method_class"].partition(":")
    assert spec["id"] == "warpnerf" and getattr(importlib.import_module(module), name)
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    assert f'[project.entry-points."nerfbaselines.specs"]\nwarpnerf = "{module}"' in project


def test_a_camera_sees_what_ours_sees(method: Any, dataset: dict[str, Any]) -> None:
    for index, camera in enumerate(tiny_scene(ring(6)).cameras):
        same = method.camera_of(dataset["cameras"][index])
        assert np.allclose(same.c2w, camera.c2w, atol=1e-6)
        for name in ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
            assert getattr(same, name) == pytest.approx(getattr(camera, name), abs=1e-6), name


def test_distortion_stands_in_opencvs_order(method: Any) -> None:
    (bent,) = (Camera(width=4, height=3, fx=4, fy=4, cx=2, cy=1.5, c2w=np.eye(4)[:3], k1=0.1,
                      k2=0.2, p1=0.3, p2=0.4),)  # fmt: skip
    camera = method.camera_of(cameras_of([bent])[0])
    assert (camera.k1, camera.k2, camera.p1, camera.p2) == (0.1, 0.2, 0.3, 0.4)
    straight = method.camera_of(cameras_of([bent], model=0)[0])
    assert (straight.k1, straight.k2, straight.p1, straight.p2) == (0.0, 0.0, 0.0, 0.0)
    wide = Camera(width=4, height=3, fx=2, fy=2, cx=2, cy=1.5, c2w=np.eye(4)[:3], k1=0.1, k2=0.01,
                  k3=0.002, k4=0.001, fisheye=True)  # fmt: skip
    camera = method.camera_of(cameras_of([wide], model=2)[0])
    assert camera.fisheye and camera.radial == wide.radial
    full = replace(bent, k3=0.05, k4=0.06, k5=0.07, k6=0.08)
    camera = method.camera_of(cameras_of([full], model=3)[0])
    assert (camera.radial, camera.k5, camera.k6, camera.p2) == (full.radial, 0.07, 0.08, 0.4)
    with pytest.raises(wn.InputError, match="a lens of the kind 4 is not read"):
        method.camera_of(cameras_of([bent], model=4)[0])


def test_train_save_go_on_and_render(method: Any, dataset: dict[str, Any], tmp_path: Path) -> None:
    def trained(begin: Any, until: int) -> Any:
        for step in range(begin.get_info()["loaded_step"] or 0, until):
            found = begin.train_iteration(step)
        assert found["num_rays"] == 64
        return begin

    def started(**given: Any) -> Any:
        return method.WarpnerfMethod(train_dataset=dataset, config_overrides=SHORT, **given)

    whole = trained(started(), 12)
    assert whole.get_info()["num_iterations"] == 12
    half = trained(started(), 5)
    half.save(str(tmp_path / "half"))
    rest = trained(started(checkpoint=str(tmp_path / "half")), 12)
    rest.save(str(tmp_path / "rest"))
    opened = method.WarpnerfMethod(checkpoint=str(tmp_path / "rest"))
    assert opened.get_info()["loaded_step"] == 12

    camera = dataset["cameras"][3]
    pictures = [m.render(camera) for m in (whole, rest, opened)]
    height, width = dataset["images"][3].shape[:2]
    for picture in pictures:
        assert picture["color"].shape == (height, width, 3) and picture["color"].dtype == np.uint8
        assert picture["depth"].shape == picture["accumulation"].shape == (height, width)
        assert all(np.array_equal(picture[k], pictures[0][k]) for k in picture)
    options = {"outputs": ("color",), "output_type_dtypes": {"color": "float32"}}
    (color,) = opened.render(camera, options=options).values()
    assert np.abs(color * 255.0 - pictures[0]["color"]).max() <= 0.5001  # rounded, not cut off

    opened.save(str(tmp_path / "again"))  # nerfbaselines does so to tell checkpoints apart
    assert wn.load_checkpoint(tmp_path / "again" / "checkpoint.safetensors").progress.step == 12
    with pytest.raises(wn.InputError, match="give the dataset to train"):
        opened.train_iteration(12)


@pytest.mark.slow  # compiles for each
@pytest.mark.parametrize("other", [{"field": "vm"}, {"field": "hash"}, {"sampler": "resampled"}])
def test_other_fields_and_samplers_go_on(
    method: Any,
    dataset: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    other: dict[str, str],
) -> None:
    """Saved and continued they are what they are in one go."""
    monkeypatch.setitem(globals(), "SHORT", SHORT | other)
    test_train_save_go_on_and_render(method, dataset, tmp_path)


def test_masks_are_kept(method: Any, dataset: dict[str, Any]) -> None:
    masks = [np.full(image.shape[:2], 255, np.uint8) for image in dataset["images"]]
    masks[1][:, :3] = 0
    masks[2][:] = 0
    views = method.scene_of({**dataset, "masks": masks}).views
    assert [view.name for view in views] == ["000.png", "001.png", "003.png", "004.png", "005.png"]
    assert np.array_equal(views[1].mask, masks[1] > 0)


def test_points_of_the_dataset_give_box_and_content_distance(
    method: Any, dataset: dict[str, Any]
) -> None:
    """Of the same points as warpnerf reads them; not of points that the cameras do not see."""
    points = np.random.default_rng(0).normal(0.0, 0.15, (300, 3))
    without = method.scene_of(dataset)
    assert without.content_distances is None and without.points is None
    found = method.scene_of({**dataset, "points3D_xyz": points.astype(np.float32)})
    away = [np.median(np.linalg.norm(points - c.position, axis=1)) for c in found.cameras]
    np.testing.assert_allclose(found.content_distances, away, rtol=1e-5)
    assert found.content_distance == pytest.approx(np.median(away))
    assert found.content_distance != without.content_distance
    assert "points of the dataset" in found.notes[0] and len(found.points) == 300
    elsewhere = points + np.array([0.0, 0.0, 40.0])
    for unseen in (elsewhere, np.concatenate([points, elsewhere[:30]]), points[:0], points * 1e300):
        kept = method.scene_of({**dataset, "points3D_xyz": unseen})
        assert kept.notes == without.notes and kept.content_distances is None


def test_options(method: Any) -> None:
    config = method.configured({**SHORT, "preset": "quality"}, np.array([255, 0, 51], np.uint8))
    assert config.steps == 12 and config.grid.voxels == 4096 and config.model.name == "rgb"
    assert config.background == (1.0, 0.0, 0.2)
    assert config.march == wn.PRESETS["quality"].march
    assert method.configured({"content_distance": "auto"}, None).content_distance == "auto"
    assert config.appearance == "none"
    assert method.configured({"appearance": "affine"}, None).appearance == "affine"
    other = method.configured({"field": "hash", "sampler": "resampled"}, None)
    assert (other.field, other.sampler) == (wn.Hash(), Resampled())
    factors = method.configured({"preset": "tensorf", "field": "vm"}, None)
    assert factors.field == wn.PRESETS["tensorf"].field
    same = method.configured({"preset": "quality", "model": "deferred"}, None)
    assert same.model == wn.PRESETS["quality"].model
    for wrong, message in (
        ({"stepz": "1"}, "stepz: there is no such option"),
        ({"steps": "many"}, "steps must be int, not 'many'"),
        ({"preset": "best"}, "preset must be fast or quality"),
    ):
        with pytest.raises(wn.InputError, match=message):
            method.configured(wrong, None)


def test_there_must_be_something_to_begin_with(method: Any) -> None:
    with pytest.raises(wn.InputError, match="give a checkpoint or a dataset"):
        method.WarpnerfMethod()
