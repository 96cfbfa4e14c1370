"""A session and its pages, without a browser: who gets which picture, and what it costs."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.live_page import DISTANCE_OF_CONTENT, serving
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.config import TrainConfig
from warpnerf.media.pictures import to_bytes
from warpnerf.presets import PRESETS
from warpnerf.rendering.field import Field
from warpnerf.training.trainer import Trainer
from warpnerf.viewer.painter import KINDS, LAYOUTS, Subject
from warpnerf.viewer.session import Session
from warpnerf.viewer.stage import Pyramids
from warpnerf.viewer.viewpoint import DISTANCE, FLIP

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from page_client import PageClient, connection

TINY = replace(
    PRESETS["fast"], steps=60, threads=2, grid=replace(PRESETS["fast"].grid, voxels=4096)
)


@pytest.fixture(scope="module")
def field() -> Field:
    return tiny_field()


def opencv(pose: np.ndarray) -> np.ndarray:
    """A pose as a page says it, where the content distance is DISTANCE."""
    c2w = pose[:3].copy()
    c2w[:, :3] *= FLIP
    c2w[:, 3] *= DISTANCE / DISTANCE_OF_CONTENT
    return c2w


def seen(field: Field, pose: np.ndarray, size: tuple[int, int] = (80, 60)) -> np.ndarray:
    from warpnerf.viewer.viewpoint import Viewpoint

    view = Viewpoint(c2w=pose[:3], fov=0.8, width=size[0], height=size[1])
    return to_bytes(field.render(view.camera(*size)).rgb)


def close(picture: np.ndarray, wanted: np.ndarray) -> bool:
    """But for what JPEG loses."""
    return bool(np.abs(picture.astype(float) - wanted).mean() < 8.0)


def test_a_page_gets_the_picture_of_its_camera(field: Field) -> None:
    poses = ring(7)
    with serving(field) as session, PageClient(session.server.get_port()) as page:
        for pose in poses[:3]:
            before = len(page.pictures)
            page.look_from(opencv(pose), image_width=400, image_height=300)
            page.wait(lambda page, n=before: len(page.pictures) > n)
            page.wait_for_size(400, 300, before)
            wanted = seen(field, pose, (400, 300))
            assert wanted.std() > 20.0
            page.wait(lambda _: session._pages and all(p.screen.fine for p in pages(session)))
            # The session is done before its last picture has come here.
            page.wait(lambda page, w=wanted: close(page.pictures[-1], w))
            picture = page.pictures[-1]
            others = seen(field, poses[4], (400, 300)).astype(float)
            assert np.abs(others - picture).mean() > 20.0  # a picture of elsewhere is not alike
        coarse = min(picture.shape[1] for picture in page.pictures)
        assert coarse <= 400


def pages(session: Session) -> list[Any]:
    return list(session._pages.values())


def test_two_tabs_have_their_own_cameras(field: Field) -> None:
    poses = ring(5)
    with serving(field) as session:
        port = session.server.get_port()
        with PageClient(port) as first, PageClient(port) as second:
            first.look_from(opencv(poses[0]))
            second.look_from(opencv(poses[2]))
            for page, pose in ((first, poses[0]), (second, poses[2])):
                page.wait_for_size(80, 60)
                page.wait(lambda page, w=pose: close(page.pictures[-1], seen(field, w)))


def test_a_tab_closed_in_mid_picture_is_forgotten(field: Field) -> None:
    with serving(field) as session:
        port = session.server.get_port()
        for _ in range(5):
            with PageClient(port) as page:
                page.look_from(opencv(ring(5)[0]), image_width=1900, image_height=1900)
                page.wait(lambda page: page.pictures)
        with PageClient(port) as page:
            page.look_from(opencv(ring(5)[0]))
            page.wait_for_size(80, 60)
            page.wait(lambda _: len(session._pages) == 1)


def test_nonsense_about_a_camera_is_passed_over(field: Field) -> None:
    with serving(field) as session, PageClient(session.server.get_port()) as page:
        good = opencv(ring(5)[0])
        page.look_from(good)
        page.wait_for_size(80, 60)
        for wrong in (
            {"fov": float("nan")},
            {"image_width": 10**15},
            {"wxyz": [0.0, 0.0, 0.0, 0.0]},
            {"position": [1e300, 0.0, 0.0]},
        ):
            page.look_from(good, **wrong)
        before = len(page.pictures)
        page.look_from(opencv(ring(5)[1]))
        page.wait(lambda page: len(page.pictures) > before)


def test_what_a_page_can_set_stays_within_its_ends(field: Field) -> None:
    """Sliders and menus are the page's; what it sends may be anything."""
    with (
        serving(field, field, scene=tiny_scene(ring(5))) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(ring(5)[0]))
        page.wait_for_size(80, 60)
        controls = [
            message["uuid"]
            for kind, messages in page.messages.items()
            for message in messages
            if kind.startswith("Gui") and "uuid" in message and "value" in message
        ]
        assert len(controls) > 10
        for value in (float("nan"), 1e300, -1e300, "evil", True, [float("nan")] * 2, [9.0, -9.0]):
            for uuid in controls:
                with PageClient(session.server.get_port()) as other:
                    other.look_from(opencv(ring(5)[1]))
                    other.say(
                        {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                    )
        before = len(page.pictures)
        page.look_from(opencv(ring(5)[2]))
        page.wait_for_size(80, 60, before)
        settings = session._panel.settings
        assert settings.kind in KINDS and settings.layout in LAYOUTS
        numbers = [settings.near, settings.far, settings.within, settings.divider]
        assert np.isfinite(numbers).all() and 0.0 < settings.within <= DISTANCE_OF_CONTENT
        assert settings.crop is None or np.isfinite(settings.crop).all()


def test_one_stands_in_a_camera_without_seeing_it(field: Field) -> None:
    """A page hides the camera in front of its eyes, and shows it again."""
    poses = ring(5)
    with (
        serving(field, scene=tiny_scene(poses)) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(poses[1]))
        page.wait(lambda page: page.messages.get("BatchedMeshesMessage"))
        page.wait(lambda page: visible(page) == {0, 2, 3})
        page.look_from(opencv(ring(5, radius=1.0)[2]))
        page.wait(lambda page: visible(page) == {0, 1, 2, 3})
        step = session._stage.length / session._world.scale  # of the pyramids, scene units
        beside = poses[1].copy()
        for lengths, seen in ((1.8, {0, 2, 3}), (2.2, {0, 1, 2, 3})):
            beside[:3, 3] = poses[1][:3, 3] + lengths * step * poses[1][:3, 2]  # behind it
            page.look_from(opencv(beside))
            page.wait(lambda page, seen=seen: visible(page) == seen)


def test_photographs_are_shown_to_those_outside_of_the_cameras(field: Field) -> None:
    """Not near a camera, and not in the middle of all of them."""
    poses = ring(5)
    with (
        serving(field, scene=tiny_scene(poses)) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(poses[1]))
        page.wait(lambda page: len(page.messages.get("ImageMessage", [])) == 4)
        far = ring(5, radius=40.0)
        assert not photographs(page)
        page.look_from(opencv(far[1]))
        page.wait(photographs)
        middle = poses[1].copy()
        middle[:3, 3] = np.mean([pose[:3, 3] for pose in poses], axis=0)
        page.look_from(opencv(middle))
        page.wait(lambda page: not photographs(page))
        page.look_from(opencv(far[2]))
        page.wait(photographs)
        session._stage.show_cameras(visible=False, scale=1.0)
        page.wait(lambda page: not photographs(page))
        session._stage.show_cameras(visible=True, scale=1.0)
        page.wait(photographs)
        session._stage.show_cameras(visible=True, scale=40.0)  # so large that one is among them
        page.wait(lambda page: not photographs(page))


def photographs(page: PageClient) -> bool:
    """Whether a page shows photographs, by what it was told last."""
    told = page.messages.get("SetSceneNodeVisibilityMessage", [])
    return bool([m["visible"] for m in told if m["name"] == "/photographs"][-1:] == [True])


def test_where_nothing_changes_a_move_tells_nothing_of_cameras(field: Field) -> None:
    poses = ring(5)
    with (
        serving(field, scene=tiny_scene(poses)) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(poses[1]))
        page.wait(lambda page: len(page.messages.get("ImageMessage", [])) == 4)
        before = sum(map(len, page.messages.values()))
        pyramids = next(iter(session._stage._pages.values()))
        for _ in range(20):
            pyramids.stand_at(poses[1][:3, 3] + 1e-3)
        n = len(page.pictures)
        page.look_from(opencv(poses[1] + 1e-6 * np.eye(4)))
        page.wait(lambda page: len(page.pictures) > n)
        kinds = {k for k, m in page.messages.items() if k.startswith(("SetScene", "SceneNode"))}
        assert sum(map(len, page.messages.values())) - before < 5, kinds


def test_each_page_gets_its_cameras_after_its_picture(field: Field) -> None:
    """Whoever comes later, too, and with the photographs that have been made small before."""
    poses = ring(5)
    with serving(field, scene=tiny_scene(poses)) as session:
        for _ in range(2):
            with PageClient(session.server.get_port()) as page:
                page.look_from(opencv(poses[1]))
                page.wait(lambda page: visible(page) == {0, 2, 3})
                first = page.messages["BatchedMeshesMessage"][0]
                assert first["n_pictures"] >= 2  # a coarse one and a fine one
                drawn, cameras = first["props"], session._stage.cameras
                one = list(cameras.values())[1]
                wxyz, position = session._world.pose(one.c2w)
                np.testing.assert_allclose(drawn["batched_wxyzs"].reshape(-1, 4)[1], wxyz, 1e-5)
                np.testing.assert_allclose(
                    drawn["batched_positions"].reshape(-1, 3)[1], position, 1e-5
                )
                length = session._stage.length
                base = [one.width / one.fx / 2.0, one.height / one.fy / 2.0, 1.0]
                session._stage.show_cameras(visible=True, scale=2.0)
                page.wait(
                    lambda page, b=base, n=length: np.allclose(
                        scales(page)[2], 2.0 * n * np.array(b)
                    )
                )
                session._stage.show_cameras(visible=False, scale=2.0)
                page.wait(lambda page: visible(page) == set())
                session._stage.show_cameras(visible=True, scale=1.0)
                page.wait(lambda page: visible(page) == {0, 2, 3})
        page.wait(lambda _: not session._stage._pages)
    assert len(session._stage._photographs) == 4


def visible(page: PageClient) -> set[int]:
    """The cameras that a page shows, by what it was told last."""
    return set(np.flatnonzero(scales(page).all(axis=1)).tolist())


def scales(page: PageClient) -> np.ndarray:
    """Half the width and height of each pyramid's base, and its length, as it was told last."""
    told = page.messages.get("SceneNodeUpdateMessage", [])
    said = [m["updates"]["batched_scales"] for m in told if m["name"] == "/cameras"]
    return said[-1].reshape(-1, 3) if said else np.zeros((4, 3))


@pytest.mark.parametrize(("index", "stands"), [(2, True), (None, False), (-1, False), (4, False)])
def test_a_click_on_a_camera_that_is_not_there_does_nothing(
    field: Field, monkeypatch: pytest.MonkeyPatch, index: int | None, stands: bool
) -> None:
    """A page says which it was, and may say anything."""
    clicked: list[int] = []
    with serving(field, scene=tiny_scene(ring(5))) as session:
        monkeypatch.setattr(session._stage, "clicked", lambda i, client: clicked.append(i))
        pyramids = Pyramids(SimpleNamespace(), session._stage)
        pyramids._clicked(SimpleNamespace(instance_index=index, client=None))
    assert clicked == [index] * stands


def trained(config: TrainConfig, looking: bool) -> tuple[bytes, int]:
    """The grid after a training at which somebody looks, or nobody does, and pictures drawn."""
    scene = tiny_scene(ring(6), width=40, height=30, fx=40.0, fy=40.0, cx=20.0, cy=15.0)
    trainer = Trainer(scene, config)
    subject = Subject(name="it", field=trainer.field, stamp=lambda: trainer.steps_done)
    with Session(
        [subject], scene, content_distance=DISTANCE_OF_CONTENT, training=True, port=0
    ) as session:
        if not looking:
            trainer.run(between=session.after_update)
            return trainer.storage.values.numpy().tobytes(), session._turns
        with PageClient(session.server.get_port()) as page:
            page.look_from(opencv(ring(6)[0]))
            page.wait(lambda _: session._pages)

            def between() -> None:
                time.sleep(0.01)  # these updates are too short to leave time for a picture
                session.after_update()

            trainer.run(between=between)
            page.wait(lambda page: page.pictures)
            return trainer.storage.values.numpy().tobytes(), session._turns


def test_looking_at_a_training_changes_no_bits() -> None:
    alone, none = trained(TINY, looking=False)
    watched, some = trained(TINY, looking=True)
    assert (none, some > 1) == (0, True)
    assert alone == watched
    other, _ = trained(replace(TINY, seed=1), looking=False)
    assert other != alone


def test_pictures_get_their_share_and_no_more(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a clock that only updates and pictures move."""
    subject = Subject(name="it", field=lambda: field)
    now = [0.0]
    with Session(
        [subject], None, content_distance=DISTANCE_OF_CONTENT, training=True, port=0
    ) as session:
        monkeypatch.setattr("warpnerf.viewer.session.monotonic", lambda: now[0])
        drawn = 0.0

        def draw(page: Any) -> None:
            nonlocal drawn
            now[0] += 0.05
            drawn += 0.05

        session._pages[0] = object()  # type: ignore[assignment]
        session._next = lambda: (session._pages[0], 0.0)  # type: ignore[method-assign]
        session._advance = draw  # type: ignore[method-assign]
        session._last = 0.0
        for share in (0.3, 0.8):
            session._panel.share = share
            began, drawn = now[0], 0.0
            for _ in range(400):
                now[0] += 0.02  # an update
                session.after_update()
            assert drawn / (now[0] - began) == pytest.approx(share, abs=0.02)
        session._pages.clear()
        began, drawn = now[0], 0.0
        session.after_update()
        assert drawn == 0.0


def test_a_fault_of_the_page_does_not_end_a_training(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = Subject(name="it", field=lambda: field)
    with (
        Session(
            [subject], None, content_distance=DISTANCE_OF_CONTENT, training=True, port=0
        ) as session,
        PageClient(session.server.get_port()) as page,
    ):
        page.look_from(opencv(ring(5)[0]))
        page.wait(lambda _: session._pages)

        def fail(*arguments: Any) -> None:
            raise RuntimeError("of viser's")

        monkeypatch.setattr(session._painter, "look", fail)
        session._credit = 0.1
        with pytest.warns(UserWarning, match="the page failed .*of viser's.* training continues"):
            session.after_update()
        session.after_update()
        assert not session._pages


def resident_bytes() -> int:
    gc.collect()
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)  # what threads have freed stays with the allocator for a while
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
def test_two_hundred_connections_and_garbage_leave_memory_flat(field: Field) -> None:
    """All look, half of them send garbage and leave; twice as many take no more than as many."""
    poses = ring(11)

    def crowd(session: Session) -> None:
        port = session.server.get_port()
        clients = [PageClient(port) for _ in range(200)]
        for index, client in enumerate(clients):
            client.look_from(opencv(poses[index % 11]))
        for client in clients:
            client.wait(lambda client: client.pictures, 120.0)
        for index, client in enumerate(clients):
            if index % 2:
                client.say({"type": "NoSuchMessage"})
                with connection(port) as other:
                    other.send(b"\xff" * 1000)
            client.__exit__()
        clients[0].wait(lambda _: not session._pages, 60.0)

    with serving(field) as session:
        crowd(session)
        before = resident_bytes()
        for _ in range(2):
            crowd(session)
        assert resident_bytes() - before < 50 * 2**20
        with PageClient(session.server.get_port()) as page:
            page.look_from(opencv(poses[0]))
            page.wait_for_size(80, 60)
