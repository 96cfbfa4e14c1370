"""Render outputs: what each panel shows, and what is left where nothing is seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.solid_fields import ball_field, camera_at
from warpnerf.checks import InputError
from warpnerf.media.filming import render_stills, render_video
from warpnerf.media.panels import Panels
from warpnerf.media.pictures import depth_picture
from warpnerf.rendering.field import Field

CENTRE, RADIUS = np.array([0.1, -0.05, 0.15]), 0.6


@pytest.fixture(scope="module")
def field() -> Field:
    return ball_field()


def test_normals_are_those_of_the_ball_in_the_cameras_axes(field: Field) -> None:
    camera = camera_at((2.4, 0.6, 0.9))
    shown = Panels(field=field, outputs=("normals",)).picture(camera) / 255.0
    assert shown.shape == (40, 48, 3)
    rendering = field.render(camera)
    u, v = np.meshgrid(np.arange(48) + 0.5, np.arange(40) + 0.5)
    ways = np.stack([(u - 24) / 48, (20 - v) / 48, -np.ones_like(u)], axis=-1)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    away = (camera.position - CENTRE) @ camera.c2w[:, :3]
    middle = (ways * away).sum(-1)
    inner = middle**2 - away @ away + RADIUS**2
    hit = (inner > 0.05) & (rendering.opacity > 0.99)  # well within its outline
    distance = -middle - np.sqrt(np.maximum(inner, 0.0))
    normals = (away + distance[..., None] * ways) / RADIUS
    assert hit.sum() > 150
    cosines = ((2.0 * shown - 1.0) * normals).sum(-1)[hit]
    assert cosines.min() > 0.9 and cosines.mean() > 0.98
    np.testing.assert_array_equal(shown[rendering.opacity < 1e-3], 1.0)


def test_each_output_alone_and_all_side_by_side(field: Field) -> None:
    camera = camera_at((2.4, 0.6, 0.9))
    seen = field.render(camera)
    alone = {
        output: Panels(field=field, outputs=(output,), near=1.0, far=4.0).picture(camera)
        for output in ("colour", "depth", "opacity", "normals")
    }
    np.testing.assert_allclose(alone["colour"] / 255.0, seen.rgb, atol=0.003)
    np.testing.assert_allclose(alone["opacity"][..., 1] / 255.0, seen.opacity, atol=0.003)
    depth = depth_picture(seen, 1.0, 4.0)
    np.testing.assert_allclose(alone["depth"][:40] / 255.0, depth, atol=0.003)
    assert alone["depth"].shape[0] > 40  # the legend
    outputs = ("normals", "opacity", "colour")
    together = Panels(field=field, outputs=outputs).picture(camera)
    assert together.shape == (40, 3 * 48 + 8, 3)
    for k, output in enumerate(outputs):
        np.testing.assert_array_equal(together[:, 52 * k : 52 * k + 48], alone[output])


def test_transparent_pictures_over_the_background_are_the_rendering(
    field: Field, tmp_path: Path
) -> None:
    camera = camera_at((2.4, 0.6, 0.9))
    seen = field.render(camera)
    render_stills(field, {"a.png": camera}, tmp_path / "s", show=("colour",), transparent=True)
    pixels = np.asarray(Image.open(tmp_path / "s" / "a.png")) / 255.0
    assert pixels.shape == (40, 48, 4)
    alpha = pixels[..., 3:]
    np.testing.assert_allclose(alpha[..., 0], seen.opacity, atol=0.003)
    over = alpha * pixels[..., :3] + (1.0 - alpha) * np.array(field.background)
    np.testing.assert_allclose(over, seen.rgb, atol=0.006)
    assert 0.1 < alpha.mean() < 0.9


def test_a_transparent_video_has_its_alpha(field: Field, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    cameras = [camera_at((2.4, 0.6, 0.9)), camera_at((2.4, 0.7, 0.9))]
    path = render_video(field, cameras, tmp_path / "a.mov", show=("colour",), transparent=True)
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgba") for frame in container.decode(video=0)]
    assert len(frames) == 2
    seen = field.render(cameras[0])
    np.testing.assert_allclose(frames[0][..., 3] / 255.0, seen.opacity, atol=0.05)
    solid = seen.opacity > 0.999
    assert np.abs(frames[0][..., :3] / 255.0 - seen.rgb)[solid].mean() < 0.05
    with pytest.raises(InputError, match=r"no transparency; let the name end in \.mov"):
        render_video(field, cameras, tmp_path / "a.mp4", transparent=True)


def test_outside_of_a_crop_nothing_is_seen(field: Field) -> None:
    camera = camera_at((0.1, -3.0, 0.15))
    cut = field.cropped((-1.0, -1.1, -1.2), (0.1, 1.1, 1.2))
    seen, all_of_it = cut.render(camera).opacity, field.render(camera).opacity
    u = 48 * (0.1 + 0.15) / 3.0 + 24  # two voxels beyond the crop
    assert seen[:, int(u) + 1 :].max() < 1e-3 < 0.9 < all_of_it[:, int(u) + 1 :].max()
    assert seen[:, :22].max() > 0.9
    assert field.render(camera).opacity.sum() > 1.5 * seen.sum()
    with pytest.raises(InputError, match="the first below the second"):
        field.cropped((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    with pytest.raises(InputError, match="crop holds no cell"):
        field.cropped((0.01, 0.01, 0.01), (0.02, 0.02, 0.02))


@pytest.mark.parametrize("outputs", [(), ("colour", "colour"), ("color",)])
def test_outputs_that_are_none_are_refused(field: Field, outputs: tuple) -> None:
    with pytest.raises(InputError, match="what is shown"):
        Panels(field=field, outputs=outputs)
