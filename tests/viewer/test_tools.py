"""Measuring, clipping, and photographs compared with renderings."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.live_page import DISTANCE_OF_CONTENT, serving
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at, ring, tiny_scene
from tests.viewer.test_session import opencv
from warpnerf.evaluation.metrics import psnr
from warpnerf.media.pictures import to_bytes
from warpnerf.rendering.field import Field
from warpnerf.scenes.scene import View
from warpnerf.viewer.comparison import GAIN, MAX_SIDE, compare
from warpnerf.viewer.painter import Painter, Settings, Subject
from warpnerf.viewer.viewpoint import DISTANCE, Viewpoint

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from page_client import PageClient

SETTINGS = Settings(near=1.0, far=4.0, within=2.5)
SIZE = (40, 30)
SCALE = DISTANCE / DISTANCE_OF_CONTENT


@pytest.fixture(scope="module")
def field() -> Field:
    return tiny_field(density=40.0)


def painter(*fields: Field) -> Painter:
    return Painter([Subject(name=str(i), field=lambda f=f: f) for i, f in enumerate(fields)])


def test_a_surface_is_where_a_ray_meets_the_field(field: Field) -> None:
    origin, direction = np.array([0.0, -4.0, 0.1]), np.array([0.0, 1.0, 0.0])
    point = painter(field).surface(origin, direction, SETTINGS)
    assert point is not None
    seen = field.render_rays(origin[None], direction[None])
    np.testing.assert_allclose(point, [0.0, -4.0 + seen.depth[0] / seen.opacity[0], 0.1])
    assert -1.05 < point[1] < -0.9  # the front of the box, which is dense
    assert painter(field).surface(origin, -direction, SETTINGS) is None
    thin = tiny_field(density=-30.0)
    assert painter(thin).surface(origin, direction, SETTINGS) is None
    both = painter(thin, field)
    assert both.surface(origin, direction, replace(SETTINGS, layout="first")) is None
    assert both.surface(origin, direction, replace(SETTINGS, layout="second")) is not None


def test_what_is_clipped_is_neither_shown_nor_measured(field: Field) -> None:
    look = Viewpoint(
        c2w=look_at((0.0, -4.0, 0.1), (0.0, 0.0, 0.1))[:3], fov=0.7, width=40, height=30
    )
    clipped = replace(SETTINGS, clip=3.5)
    steps = replace(field.steps, near=3.5)
    wanted = to_bytes(replace(field, steps=steps).render(look.camera(*SIZE)).rgb)
    shown = painter(field).paint(look, clipped, SIZE)
    np.testing.assert_array_equal(shown, wanted)
    assert np.abs(shown.astype(int) - painter(field).paint(look, SETTINGS, SIZE)).max() > 30
    origin, direction = np.array([0.0, -4.0, 0.1]), np.array([0.0, 1.0, 0.0])
    point = painter(field).surface(origin, direction, clipped)
    assert point is not None and -0.5 <= point[1] < -0.4
    less = replace(SETTINGS, clip=0.5 * field.steps.near)  # than where rays begin anyway
    whole = painter(field).paint(look, SETTINGS, SIZE)
    np.testing.assert_array_equal(painter(field).paint(look, less, SIZE), whole)


def control(page: PageClient, label: str) -> str:
    """The identifier of what has a label in the panel."""
    for kind, messages in page.messages.items():
        for message in messages:
            if (
                kind.startswith("Gui")
                and "Folder" not in kind
                and message.get("props", {}).get("label") == label
            ):
                return str(message["uuid"])
    raise AssertionError(label)


def put(page: PageClient, label: str, value: Any) -> None:
    page.say(
        {"type": "GuiUpdateMessage", "uuid": control(page, label), "updates": {"value": value}}
    )


def click(page: PageClient, origin: Any, direction: Any) -> None:
    page.say(
        {
            "type": "ScenePointerMessage",
            "event_type": "click",
            "modifier": None,
            "ray_origin": [SCALE * x for x in origin],
            "ray_direction": list(direction),
            "screen_pos": [[0.5, 0.5]],
        }
    )


def test_two_clicks_measure_a_distance(field: Field) -> None:
    rays = [((x, -4.0, 0.1), (0.0, 1.0, 0.0)) for x in (-0.5, 0.4)]
    ends = [painter(field).surface(np.array(o), np.array(d), SETTINGS) for o, d in rays]
    length = float(np.linalg.norm(np.subtract(ends[1], ends[0])))  # type: ignore[arg-type]
    assert 0.85 < length < 1.0
    with serving(field) as session, PageClient(session.server.get_port()) as page:
        page.look_from(opencv(ring(5)[0]))
        page.wait_for_size(80, 60)
        click(page, *rays[0])  # not switched on
        put(page, "Measure", True)
        page.wait(lambda page: page.messages.get("ScenePointerEnableMessage"))
        click(page, (np.nan, 0.0, 0.0), (0.0, 0.0, 1.0))
        click(page, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        click(page, (0.0, -4.0, 0.1), (0.0, -1.0, 0.0))  # away from it
        for ray in rays:
            click(page, *ray)
        page.wait(lambda page: page.messages.get("LabelMessage"))
        (label,) = page.messages["LabelMessage"]
        assert label["props"]["text"] == f"{length:.4g}"
        told = [
            m["position"] for m in page.messages["SetPositionMessage"] if m["name"] == label["name"]
        ]
        middle = SCALE * 0.5 * np.sum(ends, axis=0)  # type: ignore[arg-type]
        np.testing.assert_allclose(told[-1], middle, atol=1e-5)
        put(page, "Scene unit", 2.5)
        page.wait(lambda page: len(page.messages["LabelMessage"]) == 2)
        assert page.messages["LabelMessage"][1]["props"]["text"] == f"{2.5 * length:.4g}"
        click(page, *rays[0])  # begins again
        page.wait(lambda page: "/measure/length" in removed(page))
        put(page, "Measure", False)
        page.wait(lambda page: "/measure/0" in removed(page))


def test_of_two_runs_at_once_nothing_is_measured(field: Field) -> None:
    """A click would not tell which of them is meant."""
    with serving(field, field) as session, PageClient(session.server.get_port()) as page:
        page.look_from(opencv(ring(5)[0]))
        page.wait_for_size(80, 60)
        put(page, "Runs", "divided")
        put(page, "Measure", True)
        page.wait(lambda page: page.messages.get("ScenePointerEnableMessage"))
        click(page, (-0.5, -4.0, 0.1), (0.0, 1.0, 0.0))
        page.wait(lambda page: "nothing is measured" in session._ruler._said.content)
        assert not session._ruler.points


def test_nothing_is_clipped_in_normalised_device_coordinates(field: Field) -> None:
    """What is near the camera is where these begin."""
    in_ndc = replace(field, steps=replace(field.steps, in_ndc=True))
    for shown, clips in ((field, True), (in_ndc, False)):
        panel = ("Clip before", clips)
        with serving(shown) as session, PageClient(session.server.get_port()) as page:
            page.wait(lambda page: page.messages.get("GuiSliderMessage"))
            sliders = page.messages["GuiSliderMessage"]
            (slider,) = (m for m in sliders if m["props"]["label"] == panel[0])
            updates = page.messages.get("GuiUpdateMessage", [])
            hidden = [m for m in updates if m["uuid"] == slider["uuid"]]
            seen = hidden[-1]["updates"]["visible"] if hidden else slider["props"]["visible"]
            assert seen == panel[1]


def removed(page: PageClient) -> set[str]:
    return {message["name"] for message in page.messages.get("RemoveSceneNodeMessage", [])}


def view(field: Field, *, width: int = 40, height: int = 30, **changes: Any) -> View:
    """A photograph that is the field's own picture, noisy in its left half."""
    camera = camera_at(
        ring(9)[0], width=width, height=height, fx=50.0, fy=50.0, cx=0.5 * width + 3.0, cy=14.0
    )
    image = to_bytes(field.render(camera).rgb).astype(int)
    noise = np.random.default_rng(0).integers(-30, 31, image.shape)
    noise[:, width // 2 :] = 0
    image = np.clip(image + noise, 0, 255).astype(np.uint8)
    return View(name="a.png", camera=camera, image=image, **changes)


def test_a_photograph_and_its_rendering_side_by_side(field: Field) -> None:
    one = view(field)
    picture, (figure,) = compare(painter(field), one)
    rgb = field.render(one.camera).rgb
    target = one.image / 255.0
    assert picture.shape == (30, 120, 3)
    np.testing.assert_array_equal(picture[:, :40], one.image)
    np.testing.assert_array_equal(picture[:, 40:80], to_bytes(rgb))
    wanted = to_bytes(np.clip(GAIN * np.abs(rgb - target), 0.0, 1.0))
    np.testing.assert_array_equal(picture[:, 80:], wanted)
    assert wanted[:, :20].mean() > 20.0 > 2.0 >= wanted[:, 20:].max()
    assert figure == pytest.approx(psnr(rgb, target)) and 20.0 < figure < 30.0


def test_what_a_mask_leaves_out_does_not_count(field: Field) -> None:
    mask = np.ones((30, 40), bool)
    mask[:, :20] = False
    picture, (figure,) = compare(painter(field), view(field, mask=mask))
    assert figure > 45.0 and picture[:, 80:100].max() == 0
    assert picture[:, :20].min() > 150  # pale


def test_large_photographs_are_reduced_and_two_runs_have_two_rows(field: Field) -> None:
    large = view(field, width=2 * MAX_SIDE + 7, height=9)
    picture, figures = compare(painter(field, tiny_field(density=0.0)), large)
    assert picture.shape == (2 * 3, 3 * 322, 3)  # thirds
    assert len(figures) == 2 and figures[0] > figures[1]
    blocks = (large.image / 255.0)[:9, :966].reshape(3, 3, 322, 3, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(picture[:3, :322], to_bytes(blocks))


def test_a_page_shows_the_difference_of_a_test_photograph(field: Field) -> None:
    scene = tiny_scene(ring(9), width=40, height=30, fx=50.0, fy=50.0, cx=20.0, cy=15.0)
    name = scene.views[scene.splits["test"][0]].name
    with (
        serving(field, scene=scene) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(ring(5)[0]))
        page.wait_for_size(80, 60)
        put(page, "Photograph", f"test: {name}")
        put(page, "Show the difference", True)
        page.wait(lambda page: page.messages.get("GuiImageMessage"))
        (modal,) = page.messages["GuiModalMessage"]
        assert modal["title"] == f"test: {name}"
        page.wait(
            lambda page: any(
                "PSNR: " in message["props"].get("_markdown", "")
                for message in page.messages["GuiMarkdownMessage"]
            )
        )
