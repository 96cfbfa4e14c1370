"""The page: it holds everything, requests nothing, and shows what the field shows."""

from __future__ import annotations

import importlib.util
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.exporting.test_cameras import ball_scene
from tests.support.solid_fields import ball_field
from warpnerf.checks import InputError
from warpnerf.exporting.export import export
from warpnerf.exporting.first_view import widest_view
from warpnerf.exporting.page import splats_html
from warpnerf.exporting.splats import Splats, splats_of
from warpnerf.exporting.visibility import visibility
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene
from warpnerf.viewer.viewpoint import first_look

pytest.importorskip("viser")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    *("--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle"),
    *("--use-angle=swiftshader", "--disable-background-networking"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    field, scene = ball_field(), replace(ball_scene(), name="a <b>")
    views = [scene.views[index] for index in scene.splits["train"]]
    splats = splats_of(field, visibility(field, views))
    file = tmp_path_factory.mktemp("page") / "b.html"
    file.write_bytes(b"".join(splats_html(splats, scene, field.background, scene.cameras[2])))
    return file


def test_an_exported_page_begins_where_most_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Camera] = []

    def made(splats: Splats, scene: Scene, background: object, begin: Camera) -> list[bytes]:
        begun.append(begin)
        return [b"page"]

    monkeypatch.setattr("warpnerf.exporting.page.splats_html", made)
    field, scene = ball_field(), ball_scene()
    assert export(field, tmp_path / "b.html", scene=scene).read_bytes() == b"page"
    assert begun == [widest_view(field, scene.training_cameras)]
    look = first_look(scene.training_cameras, begun[0])
    np.testing.assert_array_equal(look.c2w, begun[0].c2w)


def test_the_page_loads_nothing(page: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = page.read_text()
    assert text.lstrip().lower().startswith("<!doctype html>")
    assert "<title>a &lt;b&gt;</title>" in text
    assert not re.search(r"<(script|img|iframe)[^>]* src=[\"']?(https?:)?//", text)
    assert not re.search(r"<link[^>]* href=[\"']?(https?:)?//", text)


def test_without_viser_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "viser" else find(name)
    )
    with pytest.raises(InputError, match=r'pip install "warpnerf\[viewer\]"'):
        export(ball_field(), tmp_path / "b.html", scene=ball_scene())
    assert list(tmp_path.iterdir()) == []


def test_lengths_of_any_unit_make_the_same_page() -> None:
    """viser shows what lies between a hundredth and a thousand of its units."""
    scene, pages = ball_scene(), []
    splats = splats_of(ball_field())
    for unit in (1.0, 1024.0):  # a power of two: no digit is rounded
        views = [replace(view, camera=in_unit(view.camera, unit)) for view in scene.views]
        pages.append(
            splats_html(
                replace(splats, centres=unit * splats.centres, scales=unit * splats.scales),
                replace(scene, views=views, content_distance=unit * scene.content_distance),
                (0.3, 0.3, 0.3),
            )
        )
    assert pages[0] == pages[1]


def in_unit(camera: Camera, unit: float) -> Camera:
    return replace(camera, c2w=camera.c2w * [1.0, 1.0, 1.0, unit])


@pytest.mark.ci
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_a_browser_without_a_network_shows_the_ball(page: Path, tmp_path: Path) -> None:
    """Opened as a file: red where x is above the middle's, green where not, gray around."""
    playwright = pytest.importorskip("playwright.sync_api")
    from PIL import Image

    camera, field = ball_scene().cameras[2], ball_field()
    truth = field.render(camera).rgb  # 48 x 40: a pixel is ten of the page
    free = slice(18, None)  # rows below what the page says about rendering without a GPU
    asked: list[str] = []
    agree = 0.0
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        context = browser.new_context(offline=True, viewport={"width": 480, "height": 400})
        tab = context.new_page()
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(page.as_uri())
        for _ in range(120):  # until it has loaded and sorted the splats
            tab.wait_for_timeout(500)
            tab.screenshot(path=tmp_path / "page.png")
            pixels = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")) / 255.0
            shown = pixels.reshape(40, 10, 48, 10, 3).mean(axis=(1, 3))
            agree = float((np.abs(shown - truth).max(axis=2)[free] < 0.2).mean())
            if agree > 0.9:
                break
        browser.close()
    assert agree > 0.9
    assert not [url for url in asked if url.startswith(("http:", "https:", "ws:", "wss:"))]
