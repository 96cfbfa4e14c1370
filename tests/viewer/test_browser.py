"""The viewer in a real browser: the picture is right, moves with the mouse, and the panel works."""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.live_page import serving
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.media.recorded_path import read_path
from warpnerf.rendering.field import Field
from warpnerf.scenes.scene import Scene
from warpnerf.viewer.painter import Painter, Settings, Subject, pixel_rays
from warpnerf.viewer.session import Session
from warpnerf.viewer.stage import stand_in

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from chromium import browser, missing

pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(missing() is not None, reason=f"the page is not tested: {missing()}"),
    pytest.mark.timeout(240),
]

WIDTH, HEIGHT = 900, 400
LEFT = slice(0, 560)  # columns that the panel does not hide


@pytest.fixture(scope="module")
def field() -> Field:
    return tiny_field()


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Cameras whose principal point is off the middle, as those of phones are."""
    return tiny_scene(ring(6), width=80, height=60, fx=70.0, fy=70.0, cx=40.0, cy=30.0)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as chromium:
        yield chromium


def screenshot(page: Any) -> np.ndarray:
    """What a page shows, [H, W, 3] uint8."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def eventually(holds: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


def opened(chromium: Any, session: Session) -> Any:
    page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    page.set_default_timeout(120_000)  # ms; other tests take the cores
    page.goto(session.address)
    eventually(lambda: at_rest(session))
    page.get_by_text("warpnerf: run 0").wait_for()
    notice = page.get_by_text("Software WebGL rendering detected")  # in front of the picture
    notice.wait_for()
    notice.locator("xpath=ancestor::*[@role='alert']").get_by_role("button").click()
    notice.wait_for(state="hidden")
    return page


def at_rest(session: Session) -> bool:
    pages = list(session._pages.values())
    return bool(pages) and all(
        page.screen.fine and page.screen.due(session._panel.settings) is None for page in pages
    )


def wanted(session: Session, field: Field, settings: Settings) -> np.ndarray:
    """What the field looks like from where the only page says that it is."""
    (page,) = session._pages.values()
    assert page.viewpoint is not None
    one = Painter([Subject(name="", field=lambda: field)])
    return one.paint(page.viewpoint, settings, (WIDTH, HEIGHT))[:, LEFT]


def shows(page: Any, picture: np.ndarray) -> bool:
    """Whether a page shows a picture, but for what JPEG and the page's own scaling lose."""
    return bool(np.abs(screenshot(page)[:, LEFT].astype(float) - picture).mean() < 8.0)


def test_the_page_shows_the_field_and_follows_the_mouse(
    chromium: Any, field: Field, scene: Scene
) -> None:
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        page.get_by_label("Show", exact=True).uncheck(force=True)  # cameras in front of the field
        settings = session._panel.settings
        first = wanted(session, field, settings)
        assert first.std() > 30.0
        assert np.abs(first - first[:, ::-1].astype(float)).mean() > 12.0  # mirrored is no match
        assert np.abs(first - first[::-1].astype(float)).mean() > 12.0
        eventually(lambda: shows(page, first))
        (looking,) = session._pages.values()
        begun = looking.viewpoint

        page.mouse.move(100, 300)
        page.mouse.down()
        page.mouse.move(260, 260, steps=8)
        page.mouse.up()
        eventually(lambda: looking.viewpoint is not begun and at_rest(session))
        second = wanted(session, field, settings)
        assert np.abs(second.astype(float) - first).mean() > 12.0
        eventually(lambda: shows(page, wanted(session, field, settings)))
        page.close()
        eventually(lambda: not session._pages)


def test_what_is_chosen_in_the_panel_is_shown(chromium: Any, field: Field, scene: Scene) -> None:
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        page.get_by_label("Show", exact=True).uncheck(force=True)
        for kind in ("depth", "near field", "opacity", "colour"):
            page.get_by_label("Picture").click()
            page.get_by_role("option", name=kind).click()
            eventually(lambda k=kind: session._panel.settings.kind == k and at_rest(session))
            picture = wanted(session, field, replace(session._panel.settings))
            eventually(lambda p=picture: shows(page, p))
        page.close()


@pytest.mark.parametrize("along", [0.4, 1.0], ids=["side", "photograph"])
def test_a_training_camera_is_stood_in_by_a_click(
    chromium: Any, field: Field, scene: Scene, along: float
) -> None:
    """On the pyramid that is drawn where that camera is; so its place on the screen is right."""
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        (looking,) = session._pages.values()
        world, begun = session._world, looking.viewpoint
        assert begun is not None
        # From behind all cameras, so that they are in sight.
        camera = replace(scene.cameras[0], c2w=ring(6, radius=7.0, height=2.0)[0][:3])
        stand_in(looking.client, camera, world)
        eventually(lambda: looking.viewpoint is not begun and at_rest(session))
        target, view = scene.cameras[4], looking.viewpoint.camera(WIDTH, HEIGHT)
        # 1: the middle of its photograph, on the pyramid's base.
        point = target.position + along * session._stage.length / world.scale * target.forward
        local = view.c2w[:, :3].T @ (point - view.position)
        x = view.cx - view.fx * local[0] / local[2]
        y = view.cy + view.fy * local[1] / local[2]
        assert 0 < x < LEFT.stop and 0 < y < HEIGHT
        page.mouse.click(x, y)
        eventually(lambda: np.abs(looking.viewpoint.c2w[:, 3] - target.position).max() < 1e-3, 20.0)
        np.testing.assert_allclose(looking.viewpoint.c2w, target.c2w, atol=1e-3)
        page.close()


def test_clicks_in_the_page_measure_what_is_under_them(
    chromium: Any, field: Field, scene: Scene
) -> None:
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        page.get_by_label("Show", exact=True).uncheck(force=True)
        page.get_by_text("Distance", exact=True).click()
        page.get_by_label("Measure", exact=True).evaluate("box => box.click()")  # it still unfolds
        (looking,) = session._pages.values()
        camera, painter = looking.viewpoint.camera(WIDTH, HEIGHT), session._painter
        spots = np.array([[210, 420], [230, 480]])  # rows and columns
        ends = [
            painter.surface(origin, direction, session._panel.settings)
            for origin, direction in zip(*pixel_rays(camera, *spots.T), strict=True)
        ]
        assert all(end is not None for end in ends)
        time.sleep(1.0)  # until the page knows that clicks are wanted
        for number, (row, column) in enumerate(spots, 1):
            page.mouse.click(column + 0.5, row + 0.5)
            eventually(lambda n=number: len(session._ruler.points) == n, 20.0)
        page.get_by_text("scene units, from").wait_for()
        points = session._ruler.points
        np.testing.assert_allclose(points, ends, atol=0.02)
        assert session._ruler.length == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.05)
        page.close()


def test_a_photograph_is_compared_in_a_window(chromium: Any, field: Field, scene: Scene) -> None:
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        page.get_by_text("Compare with a photograph").click()
        page.get_by_role("button", name="Show the difference").click()
        page.get_by_text("PSNR:").wait_for()
        page.get_by_role("button", name="Close", exact=True).click()
        page.get_by_text("PSNR:").wait_for(state="hidden")
        page.close()


def test_a_path_is_recorded_and_saved(
    chromium: Any, field: Field, scene: Scene, tmp_path: Path
) -> None:
    with serving(field, scene=scene) as session:
        page = opened(chromium, session)
        (looking,) = session._pages.values()
        page.get_by_text("Camera path").click()
        page.get_by_role("button", name="Pass here").click()
        page.get_by_text("1 place, 0 s").wait_for()
        here, begun = looking.viewpoint.c2w, looking.viewpoint
        page.mouse.move(60, 300)
        page.mouse.down()
        page.mouse.move(160, 260, steps=5)
        page.mouse.up()
        eventually(lambda: looking.viewpoint is not begun and at_rest(session))
        page.get_by_role("button", name="Pass here").click()
        page.get_by_text("2 places, 2 s").wait_for()
        there = looking.viewpoint.c2w
        with page.expect_download() as download:
            page.get_by_role("button", name="Save").click()
        file = tmp_path / "path.json"
        download.value.save_as(file)
        page.close()
    path = read_path(file)
    assert path.seconds == 2.0 and json.loads(file.read_text())["width"] == path.width
    for key, pose in zip(path.keys, (here, there), strict=True):
        np.testing.assert_allclose(key.c2w, pose, atol=1e-6)


def test_a_page_from_elsewhere_gets_nothing(chromium: Any, field: Field, tmp_path: Path) -> None:
    """One in the same browser that requests the viewer's socket."""
    (tmp_path / "evil.html").write_text("<p>hello</p>")
    with serving(field) as session:
        page = chromium.new_page()
        page.goto((tmp_path / "evil.html").as_uri())
        said = page.evaluate(
            """address => new Promise(done => {
                const socket = new WebSocket(address, ["viser-v1.1.1"]);
                socket.onopen = () => done("open");
                socket.onerror = () => done("refused");
            })""",
            session.address.replace("http", "ws"),
        )
        assert said == "refused"
        assert not session._pages
        page.close()
