"""How soon, how often and how finely the page of `warpnerf view` gets pictures.

    python benchmarks/viewer.py runs/room

Serves the run as the command does, and connects as its page does, with a window of 800 x 600
pixels: over and over, how long the first picture takes; while the camera moves, how many pictures
come in a second and how large they are; how long after the last move all of the fine one is there.
Where there is a Chromium, it also measures from the page's load event to its first picture: a
browser that draws without a graphics card, on the same cores. Then trains with and without a page
that looks, in turns. Writes benchmarks/results/viewer_<device>.json.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from chromium import browser, missing
from measuring import machine, median_interval, options, show, write_record
from page_client import PageClient
from page_server import served

import warpnerf as wn
from warpnerf.runs.run import Run
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer
from warpnerf.viewer.painter import Painter, Settings, Subject
from warpnerf.viewer.session import Session
from warpnerf.viewer.viewpoint import Viewpoint, fov_to_see

WIDTH, HEIGHT = 800, 600
MESSAGES_PER_SECOND = 50
"""Of a page whose camera moves."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("run", type=Path, help="folder of a trained run")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=3.0, help="that the camera moves, a round")
    parser.add_argument("--steps", type=int, default=1500, help="of the trainings")
    parser.add_argument("--no-browser", action="store_true")
    arguments = parser.parse_args()
    field = wn.load_field(arguments.run / "field.safetensors", arguments.device)
    record: dict[str, Any] = {
        "machine": machine(arguments.device, Workers(arguments.device).count),
        "model": field.model.name,
        "grid": field.lattice.size,
        "window": [WIDTH, HEIGHT],
    }
    record["painting"] = painting(field, Run(arguments.run), arguments.rounds)
    with served(arguments.run, arguments.device) as port:
        record |= measured(port, arguments.rounds, arguments.seconds)
        reason = "not requested" if arguments.no_browser else missing()
        record["browser"] = reason or in_a_browser(port, arguments.rounds)
    record |= beside_a_training(arguments.device, arguments.steps)
    print(f"wrote {write_record(record, arguments.output, 'viewer', arguments.device)}")


def painting(field: wn.Field, run: Run, rounds: int) -> dict[str, Any]:
    """One fine picture and nothing besides, whole and in bands of 40 rows."""
    scene = wn.load_scene(run.read_config().scene, downscale=run.read_config().downscale)
    camera = scene.training_cameras[0]
    viewpoint = Viewpoint(
        c2w=camera.c2w, fov=fov_to_see(camera, WIDTH / HEIGHT), width=WIDTH, height=HEIGHT
    )
    painter = Painter([Subject(name="", field=lambda: field)])
    settings = Settings(near=0.0, far=1.0, within=0.1)
    result: dict[str, Any] = {}
    for name, rows in {"whole": HEIGHT, "bands": 40}.items():
        seconds, work = [], []
        for _ in range(rounds + 1):
            began, busy = time.perf_counter(), time.process_time()
            for first in range(0, HEIGHT, rows):
                band = range(first, min(HEIGHT, first + rows))
                painter.paint(viewpoint, settings, (WIDTH, HEIGHT), band)
            seconds.append(time.perf_counter() - began)
            work.append(time.process_time() - busy)
        result[name] = {
            "seconds": median_interval(seconds[1:]),
            "core_seconds": median_interval(work[1:]),
        }
        print(
            f"a picture, {name:6} {show(result[name]['seconds'], 2)} s, of the cores' time "
            f"{show(result[name]['core_seconds'], 2)} s"
        )
    return result


def measured(port: int, rounds: int, seconds: float) -> dict[str, Any]:
    """What a page gets in a window of its own, over and over."""
    first, rate, pixels, fine = [], [], [], []
    for _ in range(rounds):
        with PageClient(port) as page:
            page.wait(lambda page: "SetCameraLookAtMessage" in page.messages)
            orbit = Orbit(page)
            began = time.monotonic()
            page.look_from(orbit.pose(0.0), **orbit.window)
            page.wait(lambda page: page.pictures)
            first.append(page.times[0] - began)
            before, began = len(page.pictures), time.monotonic()
            for message in range(round(seconds * MESSAGES_PER_SECOND)):
                time.sleep(max(0.0, began + message / MESSAGES_PER_SECOND - time.monotonic()))
                page.look_from(orbit.pose(0.2 * message / MESSAGES_PER_SECOND), **orbit.window)
            stopped = time.monotonic()
            moving = page.pictures[before:]
            rate.append(len(moving) / (stopped - began))
            pixels.append(float(np.median([p.shape[0] * p.shape[1] for p in moving])))
            while time.monotonic() - max(page.times[-1], stopped) < 0.7:
                time.sleep(0.05)
            assert page.pictures[-1].shape == (HEIGHT, WIDTH, 3)
            fine.append(page.times[-1] - stopped)
    results = {
        "first_picture_seconds": median_interval(first),
        "moving_pictures_per_second": median_interval(rate),
        "moving_pixels": median_interval(pixels),
        "fine_picture_seconds": median_interval(fine),
    }
    side = results["moving_pixels"]["median"] / (WIDTH * HEIGHT)
    print(f"first picture after     {show(results['first_picture_seconds'], 3)} s")
    print(f"pictures while moving   {show(results['moving_pictures_per_second'], 1)} / s")
    print(f"  of about {WIDTH * side**0.5:.0f} x {HEIGHT * side**0.5:.0f} pixels")
    print(f"{WIDTH} x {HEIGHT} at rest after {show(results['fine_picture_seconds'], 2)} s")
    return results


class Orbit:
    """Poses around what the page is told to look at first."""

    def __init__(self, page: PageClient) -> None:
        def last(kind: str, name: str) -> np.ndarray:
            return np.array(page.messages[kind][-1][name])

        self._position = last("SetCameraPositionMessage", "position")
        self._target = last("SetCameraLookAtMessage", "look_at")
        self._up = last("SetCameraUpDirectionMessage", "position")
        self.window = {
            "image_width": WIDTH,
            "image_height": HEIGHT,
            "fov": page.messages["SetCameraFovMessage"][-1]["fov"],
            "up_direction": self._up.tolist(),
        }

    def pose(self, angle: float) -> np.ndarray:
        """[3, 4] in OpenCV's axes, turned about what is up by an angle in radians."""
        arm, up = self._position - self._target, self._up / np.linalg.norm(self._up)
        arm = (
            np.cos(angle) * arm
            + np.sin(angle) * np.cross(up, arm)
            + (1.0 - np.cos(angle)) * (up @ arm) * up
        )
        ahead = -arm / np.linalg.norm(arm)
        right = np.cross(ahead, up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead, self._target + arm], axis=1)


def in_a_browser(port: int, rounds: int) -> dict[str, Any]:
    """From the load event of the page to the panel's word about its first picture.

    And on the way: when its scripts have run, so that it connects, and when it says where its
    camera is, for which a picture can be made.
    """
    seconds: dict[str, list[float]] = {"connected": [], "camera": [], "first_picture": []}
    with browser() as chromium:
        for _ in range(rounds):
            page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            connected: list[float] = []
            said: list[float] = []

            def listen(socket: Any, connected: list[float] = connected, said: Any = said) -> None:
                connected.append(time.monotonic())
                socket.on("framesent", lambda _: said.append(time.monotonic()))

            page.on("websocket", listen)
            page.goto(f"http://127.0.0.1:{port}/")
            began = time.monotonic()
            page.get_by_text("pixels").wait_for()
            ended = time.monotonic()
            for name, at in zip(seconds, (connected[0], said[0], ended), strict=True):
                seconds[name].append(at - began)
            page.close()
    result = {f"{name}_seconds": median_interval(values) for name, values in seconds.items()}
    print(f"in a browser, connects  {show(result['connected_seconds'], 2)} s")
    print(f"  its camera is known   {show(result['camera_seconds'], 2)} s")
    print(f"  first picture after   {show(result['first_picture_seconds'], 2)} s")
    return result


def beside_a_training(device: str, steps: int) -> dict[str, Any]:
    """Steps per second of trainings: without a page, with one at which nobody looks, and looked at.

    The three take turns of 25 steps.
    """
    scene = wn.load_scene("builtin:room", downscale=4)
    config = replace(wn.PRESETS["fast"], steps=steps, device=device)
    names = ("without", "nobody looks", "somebody looks")
    trainers = {name: Trainer(scene, config) for name in names}
    sessions = {}
    for name in names[1:]:
        trainer = trainers[name]
        subject = Subject(
            name=name, field=trainer.field, stamp=lambda trainer=trainer: trainer.steps_done
        )
        sessions[name] = Session(
            [subject], scene, content_distance=scene.content_distance, training=True, port=0
        )
    spent: dict[str, list[float]] = {name: [] for name in names}
    with PageClient(sessions["somebody looks"].server.get_port()) as page:
        page.wait(lambda page: "SetCameraLookAtMessage" in page.messages)
        orbit, turn = Orbit(page), 0
        while any(trainer.fraction < 1.0 for trainer in trainers.values()):
            turn += 1
            page.look_from(orbit.pose(0.02 * turn), **orbit.window)
            time.sleep(0.02)
            for name in names if turn % 2 else names[::-1]:
                trainer = trainers[name]
                session = sessions.get(name)
                if session is not None:
                    session._last = time.monotonic()
                began, done = time.perf_counter(), trainer.steps_done
                while trainer.fraction < 1.0 and trainer.steps_done < done + 25:
                    trainer.update()
                    if session is not None:
                        session.after_update()
                spent[name].append(time.perf_counter() - began)
        pictures = len(page.pictures)
    for session in sessions.values():
        session.__exit__(None, None, None)
    share = sessions["somebody looks"]._panel.share
    ratios = {}
    print("a training's time by that of one without a page")
    for name in names[1:]:
        pairs = zip(spent[name][1:], spent["without"][1:], strict=True)  # the first compiles
        ratios[name] = median_interval(mine / other for mine, other in pairs)
        print(f"  {name:15} {show(ratios[name], 3)}")
    print(f"  pictures get {share:.0%}: {pictures} in {sum(spent['somebody looks']):.1f} s")
    return {"training": {"share": share, "pictures": pictures, "steps": steps, "ratios": ratios}}


if __name__ == "__main__":
    main()
