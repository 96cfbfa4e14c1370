"""A page without a browser: it speaks to viser as its page does, and keeps the pictures it gets."""

from __future__ import annotations

import io
import threading
import time
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from viser.transforms import SO3
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect


def connection(port: int, **options: Any) -> ClientConnection:
    """A connection as viser's page makes it."""
    protocol: Any = f"viser-v{viser.__version__}"
    return connect(
        f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, proxy=None, **options
    )


def camera_message(c2w: np.ndarray, **changes: Any) -> dict[str, Any]:
    """What a page of 80 x 60 pixels says of its camera, by its pose c2w [3, 4] in OpenCV's axes."""
    message = {
        "type": "ViewerCameraMessage",
        "wxyz": SO3.from_matrix(np.asarray(c2w[:, :3], np.float64)).wxyz.tolist(),
        "position": c2w[:, 3].tolist(),
        "fov": 0.8,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 60,
        "image_width": 80,
        "look_at": (c2w[:, 3] + 3.0 * c2w[:, 2]).tolist(),
        "up_direction": (-c2w[:, 1]).tolist(),
    }
    return message | changes


class PageClient:
    """Connected within a ``with`` statement."""

    def __init__(self, port: int) -> None:
        self.pictures: list[np.ndarray] = []
        self.times: list[float] = []
        self.messages: dict[str, list[dict[str, Any]]] = {}
        self._news = threading.Condition()
        self._socket = connection(port)
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> PageClient:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()

    def say(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def look_from(self, c2w: np.ndarray, **changes: Any) -> None:
        self.say(camera_message(c2w, **changes))

    def wait(self, what: Any, seconds: float = 120.0) -> None:
        """Until a condition on this client, or on anything else, holds."""
        end = time.monotonic() + seconds
        with self._news:
            while not what(self):
                assert time.monotonic() < end, "nothing of that kind came"
                self._news.wait(0.05)

    def wait_for_size(self, width: int, height: int, after: int = 0) -> np.ndarray:
        """The first picture of a size that came after so many."""

        def found() -> list[np.ndarray]:
            return [p for p in self.pictures[after:] if p.shape == (height, width, 3)]

        self.wait(lambda _: found())
        return found()[0]

    def _listen(self) -> None:
        try:
            while True:
                self._take(self._socket.recv())
        except ConnectionClosed:
            return

    def _take(self, raw: Any) -> None:
        end = 16 + int.from_bytes(raw[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16:end]))
        arrays = []
        for length in content.get("binaryBufferLengths", ()):
            begin = -(-end // 8) * 8
            end = begin + length
            arrays.append(raw[begin:end])
        with self._news:
            for message in content["messages"]:
                message = _with_arrays(message, arrays)
                if message.get("rgb_data") is not None:  # a BackgroundImageMessage
                    picture = Image.open(io.BytesIO(message["rgb_data"])).convert("RGB")
                    self.pictures.append(np.asarray(picture))
                    self.times.append(time.monotonic())
                else:
                    message["n_pictures"] = len(self.pictures)  # that came before
                    self.messages.setdefault(message["type"], []).append(message)
            self._news.notify_all()


def _with_arrays(said: Any, arrays: list[bytes]) -> Any:
    """What was said, with flat arrays in place of their numbers."""
    if not isinstance(said, dict):
        return said
    if "__binary_index" in said:
        return np.frombuffer(arrays[said["__binary_index"]], said["dtype"])
    return {key: _with_arrays(value, arrays) for key, value in said.items()}
