"""A page's session whose pictures are made in a thread of its own, so that tests can look."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from warpnerf.rendering.field import Field
from warpnerf.viewer.painter import Subject
from warpnerf.viewer.session import Session

DISTANCE_OF_CONTENT = 3.0


class Ended(Exception):
    pass


@contextmanager
def serving(*fields: Field, scene: Any = None) -> Iterator[Session]:
    """A session whose pictures are made in a thread of its own."""
    subjects = [Subject(name=f"run {i}", field=lambda f=f: f) for i, f in enumerate(fields)]
    session = Session(subjects, scene, content_distance=DISTANCE_OF_CONTENT, port=0)
    failed: list[BaseException] = []

    def serve() -> None:
        try:
            session.serve()
        except Ended:
            pass
        except BaseException as error:
            failed.append(error)

    def end() -> Any:
        raise Ended

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    with session:
        yield session
        session._next = end  # type: ignore[method-assign]
        session._news.set()
        thread.join(20)
    assert not failed
