"""A viewer session: its clients, which of them is served next, and how much time pictures get.

All rendering happens in the thread that calls ``work`` or ``serve``: in a training that is the
training's own, between two updates, so that nothing changes under a picture, and pictures change
nothing in the training.
"""

from __future__ import annotations

import math
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from types import TracebackType
from typing import Any

import numpy as np

from warpnerf.checks import require_extra
from warpnerf.evaluation.near_field import NEAR_SHARE
from warpnerf.media.camera_path import look_at
from warpnerf.scenes.scene import Scene
from warpnerf.viewer.comparison import Comparison
from warpnerf.viewer.painter import Painter, Settings, Subject
from warpnerf.viewer.panel import Panel
from warpnerf.viewer.ruler import Ruler
from warpnerf.viewer.screen import Paces, Screen
from warpnerf.viewer.server import address, close_server, open_server
from warpnerf.viewer.stage import Pyramids, Stage
from warpnerf.viewer.viewpoint import FirstLook, Viewpoint, World, first_look

WARM_UP_SIZE = (120, 90)
"""Pixels."""
MOST_REQUESTS = 8
"""That wait for the thread that renders."""
MAX_DEBT = 0.5
"""Seconds that pictures may save up, or run ahead of their share."""


class Page:
    """A client of the server, and what it sees."""

    def __init__(self, client: Any, screen: Screen, pyramids: Pyramids) -> None:
        """Say in its panel what it is shown."""
        self.client = client
        self.screen = screen
        self.pyramids = pyramids
        self.viewpoint: Viewpoint | None = None
        self.turn = 0  # when it was last drawn for, counted over all pages
        self._said = client.gui.add_markdown("", order=-1.0)
        self._pictures = 0
        self._since = monotonic()

    def say(self) -> None:
        """Say how large the pictures are, and while the camera moves how many come in a second."""
        now = monotonic()
        width, height = self.screen.size
        self._pictures += self.screen.coarse
        if self.screen.fine or not self._said.content:
            self._said.content = f"{width} x {height} pixels"
        elif self.screen.coarse and now - self._since > 0.5:
            rate = self._pictures / (now - self._since)
            self._said.content = f"{width} x {height} pixels, {rate:.0f} pictures/s"
        else:
            return
        self._pictures, self._since = 0, now


class Session:
    """A page that shows one or two fields, as long as the ``with`` statement lasts."""

    def __init__(
        self,
        subjects: Sequence[Subject],
        scene: Scene | None,
        *,
        content_distance: float,
        depths: tuple[float, float] | None = None,
        training: bool = False,
        host: str = "127.0.0.1",
        port: int | None = None,
    ) -> None:
        """Serve the page; nothing is drawn before ``work`` or ``serve``.

        Args:
            subjects: What is looked at: one field, or two in the same coordinates.
            scene: Whose training cameras are shown; None: none are.
            content_distance: Scene units.
            depths: What gets the first and the last colour, scene units; None: by the content
                distance.
            training: Whether ``after_update`` will be called, and the page shares its time.
            host: Name or address to listen at.
            port: None: 8080, or the next that is free; 0: any that is free.

        Raises:
            InputError: viser is missing, or host and port cannot be listened at.
        """
        self._painter = Painter(subjects)
        self._paces = Paces()
        self._pages: dict[int, Page] = {}
        self._news = threading.Event()
        self._requests: deque[Callable[[], None]] = deque(maxlen=MOST_REQUESTS)
        self._turns = 0
        self._last = monotonic()
        self._credit = 0.0
        world = World.of(content_distance)
        self._world = world
        near, far = depths or (0.0, 2.5 * content_distance)
        settings = Settings(near=near, far=far, within=NEAR_SHARE * content_distance)
        box = subjects[0].field().surroundings
        look = _before(box) if scene is None else first_look(scene.training_cameras)
        require_extra("viser", "viewer", "the viewer")
        self._warm_up(Viewpoint(c2w=look.c2w, fov=look.fov, width=4, height=3), settings)
        self.server = open_server(host, port)
        """viser's."""
        with self.server.atomic():
            world.begin(self.server, look)
            self._stage = Stage(self.server, world, scene)
            self._panel = Panel(
                self.server,
                self._stage,
                world,
                settings,
                box,
                content_distance,
                subjects,
                training,
                lambda client_id: getattr(self._pages.get(client_id), "viewpoint", None),
                self._news.set,
            )
            self._ruler = Ruler(
                self.server, world, self._painter, lambda: self._panel.settings, self._request
            )
            if scene is not None:
                Comparison(self.server, scene, self._painter, self._request)
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._forget)

    @property
    def address(self) -> str:
        """Of the page."""
        return address(self.server)

    def __enter__(self) -> Session:
        """Nothing more."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the page."""
        close_server(self.server)

    def serve(self) -> None:
        """Draw what pages request, until something is raised: by a signal, as a rule."""
        while True:
            self._news.clear()
            self._answer()
            page, due = self._next()
            wait = due - monotonic()
            if page is not None and wait <= 0.0:
                self._advance(page)
            else:
                self._news.wait(min(wait, 1.0))

    def after_update(self) -> None:
        """Between two updates of a training: give pictures their share of the time.

        Where nobody looks, that is none.
        """
        now = monotonic()
        if not self._pages:
            self._last, self._credit = now, 0.0
            return
        share = self._panel.share
        earned = (now - self._last) * share / (1.0 - share)
        self._credit = min(self._credit + earned, MAX_DEBT)
        try:
            self._spend()
        except Exception as error:  # whatever is wrong with a page: the training is worth more
            self._pages.clear()
            close_server(self.server)
            warnings.warn(
                f"the page failed ({error!r}); training continues without it", stacklevel=2
            )
        self._last = monotonic()

    def _spend(self) -> None:
        """Draw as long as there is time to spend, and something to draw."""
        while self._credit > 0.0:
            began = monotonic()
            self._answer()
            self._credit -= monotonic() - began
            page, due = self._next()
            began = monotonic()
            if page is None or due > began:
                break
            self._advance(page)
            self._credit -= monotonic() - began

    def notify(self, title: str, body: str) -> None:
        """Say something in all pages."""
        for page in list(self._pages.values()):
            page.client.add_notification(title, body)
            page.client.flush()

    def _warm_up(self, viewpoint: Viewpoint, settings: Settings) -> None:
        """Compile, and measure, before anybody waits for it."""
        pixels = math.prod(WARM_UP_SIZE)
        for _ in range(2):
            began = monotonic()
            look = self._painter.look(viewpoint, settings, WARM_UP_SIZE)
        for pace in (self._paces.coarse, self._paces.fine):
            pace.note(pixels, monotonic() - began)
        self._painter.reproject(look, viewpoint, pixels)

    def _request(self, work: Callable[[], None]) -> None:
        """Have something done by the thread that renders; the oldest of too many is forgotten."""
        self._requests.append(work)
        self._news.set()

    def _answer(self) -> None:
        """Do what was requested."""
        while self._requests:
            self._requests.popleft()()

    def _next(self) -> tuple[Page | None, float]:
        """The page to be served next, and since or until when; none: infinity."""
        settings, now = self._panel.settings, monotonic()
        waiting = []
        for page in list(self._pages.values()):
            due = page.screen.due(settings)
            if due is not None:
                waiting.append((max(due, now), page.turn, page))
        due, _, first = min(waiting, key=lambda one: one[:2], default=(math.inf, 0, None))
        return first, due

    def _advance(self, page: Page) -> None:
        self._turns += 1
        page.turn = self._turns
        page.screen.advance(self._panel.settings, self._panel.share)

    async def _welcome(self, client: Any) -> None:
        """A page has come: viser calls this once its camera is known."""

        def show(picture: np.ndarray, quality: int) -> None:
            if client.client_id not in self._pages:  # closed meanwhile
                return
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)
            page.say()
            client.flush()
            if page.screen.fine:
                page.pyramids.put_up()

        screen = Screen(self._painter, show, self._paces)
        page = Page(client, screen, self._stage.welcome(client))
        self._pages[client.client_id] = page
        self._look(page)

        # A coroutine, which the server's own thread runs: a pool of threads could mix up the order.
        @client.camera.on_update
        async def _(_: Any) -> None:
            self._look(page)

    def _look(self, page: Page) -> None:
        camera = page.client.camera
        viewpoint = self._world.viewpoint(
            camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height
        )
        if viewpoint is not None:
            page.viewpoint = viewpoint
            page.screen.look_from(viewpoint)
            page.pyramids.stand_at(viewpoint.c2w[:, 3])
            self._news.set()

    async def _forget(self, client: Any) -> None:
        self._pages.pop(client.client_id, None)
        self._stage.forget(client.client_id)


def _before(box: tuple[np.ndarray, np.ndarray]) -> FirstLook:
    """Before a box, for fields without cameras."""
    middle, extent = 0.5 * (box[0] + box[1]), box[1] - box[0]
    up, before = np.array([0.0, 0.0, 1.0]), np.array([0.0, extent[1], 0.0])
    return FirstLook(c2w=look_at(middle - before, middle, up), fov=math.radians(50.0), up=up)
