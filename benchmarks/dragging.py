"""How many pictures a second the page of `warpnerf view` shows while the mouse drags the view.

    python benchmarks/dragging.py runs/room

In a real browser, Chromium of the system driven by playwright, which draws without a graphics card
on the same cores: a page of 640 x 400 pixels, a mouse that drags the view around for some seconds,
60 moves a second, and rests. Counted in the page is each picture when it becomes a texture, which
is when it is first drawn. Printed are pictures a second and their sizes during the drag, how long
after the last move all of the fine picture was drawn, and the time of the cores that the server
and the browser took for a picture. Where there is no browser, it says so.
"""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from chromium import browser, missing
from measuring import machine, median_interval, options, show, write_record
from page_server import served

from warpnerf.runtime.parallel import Workers

WIDTH, HEIGHT = 640, 400
MOVES_PER_SECOND = 60
REST = 2.0
"""Seconds without a picture, after which the last one was the fine one."""

COUNTER = """
window.pictures = [];
for (const kind of [WebGLRenderingContext, WebGL2RenderingContext])
    for (const name of ["texImage2D", "texSubImage2D"]) {
        const original = kind.prototype[name];
        kind.prototype[name] = function (...given) {
            const source = given[given.length - 1];
            if (source instanceof ImageBitmap || source instanceof HTMLImageElement)
                window.pictures.push([performance.now(), source.width, source.height]);
            return original.apply(this, given);
        };
    }
"""
"""Notes each picture that becomes a texture: milliseconds, width, height."""

WHOLE = f"end => window.pictures.some(p => p[0] > end && p[1] == {WIDTH} && p[2] == {HEIGHT})"
"""Whether a picture of full size has come since."""

QUIET = "rest => performance.now() - window.pictures.at(-1)[0] > rest"
"""Whether none has come for so many milliseconds."""

TICKS = os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("run", type=Path, help="folder of a trained run")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="that a drag takes")
    arguments = parser.parse_args()
    reason = missing()
    if reason is not None:
        raise SystemExit(reason)
    with served(arguments.run, arguments.device) as port:
        record = dragged(port, arguments.rounds, arguments.seconds)
    record["machine"] = machine(arguments.device, Workers(arguments.device).count)
    print(f"wrote {write_record(record, arguments.output, 'dragging', arguments.device)}")


def dragged(port: int, rounds: int, seconds: float) -> dict[str, Any]:
    """What a page shows while a mouse drags its view, over and over."""
    rates, fine, sizes, gaps = [], [], [], []
    cores: dict[str, list[float]] = {"server": [], "browser": []}
    with browser() as chromium:
        page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(120_000)
        page.add_init_script(COUNTER)
        # Else viser lowers the resolution, as a browser without a graphics card draws slowly.
        page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1")
        page.get_by_text("pixels").wait_for()
        time.sleep(3.0)  # the cameras and their photographs
        for number in range(rounds):
            page.evaluate("window.pictures.length = 0")
            before = core_seconds()
            begin, end = _drag(page, seconds, 1 if number % 2 else -1)
            after = core_seconds()
            page.wait_for_function(WHOLE, arg=end)
            page.wait_for_function(QUIET, arg=1e3 * REST)
            shown = [p for p in page.evaluate("window.pictures") if _of_the_view(*p[1:])]
            moving = [p for p in shown if begin <= p[0] <= end]
            whole = [p[0] for p in shown if p[0] > end and p[1:] == [WIDTH, HEIGHT]]
            rates.append(1e3 * len(moving) / (end - begin))
            gaps.append(1e-3 * float(np.diff([begin, *(p[0] for p in moving), end]).max()))
            sizes += [p[1:] for p in moving]
            fine.append(1e-3 * (whole[-1] - end))
            for name, values in cores.items():
                values.append((after[name] - before[name]) / max(len(moving), 1))
        page.close()
    width, height = np.median(sizes, axis=0).tolist()
    result = {
        "window": [WIDTH, HEIGHT],
        "pictures_per_second": median_interval(rates),
        "longest_gap_seconds": median_interval(gaps),
        "size": [width, height],
        "fine_picture_seconds": median_interval(fine),
        "core_seconds_per_picture": {n: median_interval(values) for n, values in cores.items()},
    }
    print(f"in a browser, dragged   {show(result['pictures_per_second'], 1)} pictures / s")
    print(f"  of {width:.0f} x {height:.0f} pixels, with gaps of up to")
    print(f"                        {show(result['longest_gap_seconds'], 2)} s")
    print(
        f"  all of the fine one   {show(result['fine_picture_seconds'], 2)} s after the last move"
    )
    for name, interval in result["core_seconds_per_picture"].items():
        print(f"  core seconds, {name:7} {show(interval, 3)} a picture")
    return result


def _of_the_view(width: int, height: int) -> bool:
    """Whether a texture is a picture of the view, and not a photograph or a symbol."""
    return width >= 16 and abs(width * HEIGHT - height * WIDTH) <= max(WIDTH, HEIGHT)


def _drag(page: Any, seconds: float, direction: int) -> tuple[float, float]:
    """Turn the view by the mouse, in the left half of the window, which the panel leaves free.

    Returns:
        When the mouse began to move, and when it stopped: milliseconds of the page's clock.
    """
    x, y = WIDTH // 4, HEIGHT // 2
    page.mouse.move(x, y)
    page.mouse.down()
    begin = page.evaluate("performance.now()")
    began = time.monotonic()
    move = 0
    while (now := time.monotonic() - began) < seconds:
        along = direction * 100.0 * np.sin(np.pi * now)
        page.mouse.move(x + along, y + 0.3 * along)
        move = max(move + 1, math.ceil(now * MOVES_PER_SECOND))
        time.sleep(max(0.0, began + move / MOVES_PER_SECOND - time.monotonic()))
    end = page.evaluate("performance.now()")
    page.mouse.up()
    return begin, end


def core_seconds() -> dict[str, float]:
    """The time of the cores that the server and the browser have taken, seconds."""
    parents, names, spent = {}, {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = stat.read_text().partition("(")[2].rpartition(")")
        except OSError:  # it has ended
            continue
        fields = rest.split()
        pid = int(stat.parent.name)
        parents[pid], names[pid] = int(fields[1]), name
        spent[pid] = (int(fields[11]) + int(fields[12])) / TICKS
    total = {"server": 0.0, "browser": 0.0}
    for pid in parents:
        ancestor = parents[pid]
        while ancestor > 1 and ancestor != os.getpid():
            ancestor = parents.get(ancestor, 0)
        if ancestor == os.getpid():
            # The driver of the browser is node, which no user has.
            who = "browser" if "chrom" in names[pid] else "server"
            total[who] += spent[pid] if names[pid] != "node" else 0.0
    return total


if __name__ == "__main__":
    main()
