"""The page of a comparison: one file that opens in any browser, without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from PIL import Image

from warpnerf.reports.comparison import FIGURES, Row, in_words, sentences
from warpnerf.reports.comparison_pictures import PHOTOGRAPH, Views

JPEG_QUALITY = 92

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem; color: #1e1e22; }
h1 { font-size: 1.6rem; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.8rem; text-align: right; border-bottom: 1px solid #e4e4e8; }
th:first-child, td:first-child { text-align: left; }
td small { display: block; color: #70707a; }
.better { background: #dff2e1; }
.worse { background: #fae0dd; }
.wide { overflow-x: auto; }
img, video { max-width: 100%; }
.names, .slider, .view input { width: min(100%, 44rem); }
.names { display: flex; justify-content: space-between; margin-bottom: 0.4rem; }
.slider { position: relative; }
.slider img { display: block; width: 100%; }
.slider img + img { position: absolute; inset: 0; height: 100%; clip-path: inset(0 0 0 50%); }
.slider i { position: absolute; top: 0; bottom: 0; left: 50%; width: 2px; background: #fff; }
figure { margin: 1rem 0; }
figcaption { color: #70707a; font-size: 0.9rem; }
</style>
</head>
<body>
<h1>$title</h1>
<p>$what</p>
$sentences
<h2>Figures</h2>
<p>Mean over seeds, and half of their range. <a href="#figures">What they are</a> stands below.</p>
<div class="wide">$figures</div>
<h2>Paired differences</h2>
<p>Mean over seeds of the difference with equal seed, and its interval. Green is significantly
better, red significantly worse.</p>
<div class="wide">$differences</div>
<h2>Views</h2>
<p>Of the trainings with seed $seed. The bar uncovers one beside the other.</p>
<div id="views"></div>
$film
$moments
$near
<h2>Training</h2>
<figure><img src="$curves" alt="PSNR of training rays over steps"></figure>
<h2>The capture</h2>
<figure>
<img src="$cameras" alt="cameras that see a point, by its distance">
<img src="$sampling" alt="density of rays, by the distance from a camera">
<figcaption>How many training cameras have a point in their pictures, and how many rays of theirs
pass by it per area, by its distance from one of them: means over points, whatever hides one thing
behind another. The density leaves out that pixels off the axis are more densely spaced in angle.
</figcaption>
</figure>
<h2 id="figures">What the figures are</h2>
<p>Light in front is absorbed before 0.8 of the true depth, light at surfaces from there to 1.25 of
it, light behind after that, and light that passes nowhere: the four sum to 1. More at surfaces is
better; each of the others alone is neither, as a field that is emptier everywhere has less light in
front and more that passes. Optical depth near cameras is measured up to a tenth of the content
distance. Where two training views see: over the pixels of test views whose true surface at least
two training views see (on captures without depths, those that show a point of structure from
motion); coverage is the share of them where the field is at least half opaque. Views
pulled back are training cameras moved back by a fifth of the content distance.</p>
<script>
const views = $views;
const place = document.getElementById("views");
const make = (tag, of, name) => {
  const element = document.createElement(tag);
  if (name) element.className = name;
  of.append(element);
  return element;
};
for (const [title, pictures] of Object.entries(views)) {
  const names = Object.keys(pictures);
  const view = make("div", place, "view");
  make("h3", view).textContent = title;
  const row = make("div", view, "names");
  const slider = make("div", view, "slider");
  const images = [make("img", slider), make("img", slider)];
  const bar = make("i", slider);
  const range = make("input", view);
  range.type = "range";
  range.max = 1000;
  range.value = 500;
  range.setAttribute("aria-label", "uncovered share");
  const first = names[0] === "$photograph" && names.length > 2 ? 1 : 0;
  for (const [side, begin] of [first, names.length - 1].entries()) {
    const select = make("select", row);
    for (const name of names) select.add(new Option(name, name));
    select.selectedIndex = begin;
    const show = () => {
      images[side].src = pictures[select.value];
      images[side].alt = title + ", " + select.value;
    };
    select.onchange = show;
    show();
  }
  range.oninput = () => {
    images[1].style.clipPath = "inset(0 0 0 " + range.value / 10 + "%)";
    bar.style.left = range.value / 10 + "%";
  };
}
</script>
</body>
</html>
""")


def comparison_page(
    title: str,
    what: str,
    rows: Sequence[Row],
    views: Views,
    pictures: Mapping[str, np.ndarray],
    film: Path | None,
    seed: int,
) -> bytes:
    """Write the page.

    Args:
        title: Its heading.
        what: A sentence on what was trained.
        rows: Figures and differences.
        views: For the sliders.
        pictures: ``curves``, ``cameras``, ``sampling``, and ``moments`` and ``near`` where there
            are, [H, W, 3].
        film: .mp4 or .gif, where there is one.
        seed: Of the trainings that pictures are of.

    Returns:
        HTML in UTF-8, with all pictures in it.
    """
    moments = ""
    if "moments" in pictures:
        moments = (
            "<h2>Moments of the training</h2>\n"
            f'<figure><img src="{_uri(pictures["moments"], "PNG")}" alt="depth during training">'
            "<figcaption>A training camera: where depth is yellow, light ends close to it."
            "</figcaption></figure>"
        )
    near = ""
    if "near" in pictures:
        near = (
            "<h2>Density around the training cameras, from above</h2>\n"
            f'<figure><img src="{_uri(pictures["near"], "PNG")}" alt="density near cameras">'
            "<figcaption>Optical depth of vertical lines, as far as they lie within a tenth of the "
            "content distance of a training camera; nothing is there, unless something was "
            "photographed from so close.</figcaption></figure>"
        )
    in_page = {
        view: {name: _uri(picture, "JPEG") for name, picture in of_view.items()}
        for view, of_view in views.items()
    }
    text = _PAGE.substitute(
        title=escape(title),
        what=escape(what),
        sentences="\n".join(f"<p>{escape(sentence)}</p>" for sentence in sentences(rows)),
        figures=_figures(rows),
        differences=_differences(rows),
        seed=seed,
        moments=moments,
        near=near,
        film=_moving(film),
        views=_script(in_page),
        photograph=PHOTOGRAPH,
        **{name: _uri(pictures[name], "PNG") for name in ("curves", "cameras", "sampling")},
    )
    return text.encode()


def _figures(rows: Sequence[Row]) -> str:
    """A table: figures down, configurations across."""
    lines = []
    for name, figure in FIGURES.items():
        if not any(name in row.values for row in rows):
            continue
        cells = []
        for row in rows:
            values = row.values.get(name)
            if values is None:
                cells.append("<td></td>")
                continue
            spread = ""
            if len(values) > 1:
                spread = f"<small>± {np.ptp(values) / 2.0:.{figure.digits}f}</small>"
            cells.append(f"<td>{np.mean(values):.{figure.digits}f}{spread}</td>")
        lines.append(f"<tr><td>{escape(figure.heading)}</td>{''.join(cells)}</tr>")
    seconds = "".join(
        f"<td>{np.mean(row.seconds):.0f}</td>" if row.seconds else "<td></td>" for row in rows
    )
    lines.append(f"<tr><td>seconds of training</td>{seconds}</tr>")
    return _table([row.candidate.name for row in rows], lines)


def _differences(rows: Sequence[Row]) -> str:
    """A table: figures down, comparisons across."""
    compared = [row for row in rows if row.candidate.against is not None]
    lines = []
    for name, figure in FIGURES.items():
        if not any(name in row.differences for row in compared):
            continue
        cells = []
        for row in compared:
            difference = row.differences.get(name)
            if difference is None:
                cells.append("<td></td>")
                continue
            sign = figure.better * int(np.sign(difference.mean)) * difference.significant
            mark = {1: ' class="better"', -1: ' class="worse"'}.get(sign, "")
            mean, _, interval = in_words(difference, figure.digits).partition(", ")
            cells.append(f"<td{mark}>{mean}<small>{interval}</small></td>")
        lines.append(f"<tr><td>{escape(figure.heading)}</td>{''.join(cells)}</tr>")
    headings = [f"{row.candidate.name} less {row.candidate.against}" for row in compared]
    return _table(headings, lines)


def _table(headings: Sequence[str], lines: Sequence[str]) -> str:
    cells = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    return f"<table><tr><th></th>{cells}</tr>{''.join(lines)}</table>"


def _uri(picture: np.ndarray, kind: str) -> str:
    """A picture as the address of itself."""
    buffer = BytesIO()
    options: dict[str, Any] = {"quality": JPEG_QUALITY} if kind == "JPEG" else {}
    Image.fromarray(picture).save(buffer, kind, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _moving(film: Path | None) -> str:
    """A film with its heading; nothing where there is none."""
    if film is None:
        return ""
    data = base64.b64encode(film.read_bytes()).decode()
    plays = f'<video src="data:video/mp4;base64,{data}" controls loop muted playsinline></video>'
    if film.suffix == ".gif":
        plays = f'<img src="data:image/gif;base64,{data}" alt="a camera that backs away">'
    return (
        f"<h2>A camera that backs away</h2>\n<figure>{plays}<figcaption>From where a training "
        "camera stood, backwards; colour above depth.</figcaption></figure>"
    )


def _script(value: Any) -> str:
    """JSON that ends no script, whatever names of views hold."""
    return json.dumps(value).replace("</", "<\\/")
