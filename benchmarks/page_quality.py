"""Sections of docs/benchmarks.md on what trainings reach, from records of pictures and depths.

Each function writes one; see ``write_docs``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from page_parts import Records, below, of, place, seeds, table, text, values

USED = ("none", "auto")
"""Values of ``--appearance`` that are compared."""

THEN_MARCHED = ", then with `fast sampler=march`"
MARCHED_TODAY = ", today with `fast sampler=march` for `fast`"
"""What commands need since rays of unbounded captures are resampled by default."""


def scaling(records: Records) -> str:
    record = records["floaters"]
    figures = {"psnr": 2, "pulled_psnr": 2, "depth_error": 3, "near_density": 3}
    rows = [
        [str(row["steps"]), row["scaling"], *(seeds(row[key], n) for key, n in figures.items())]
        for row in record["rows"]
    ]
    without, with_it = (
        f"../benchmarks/results/floaters_{name}.png" for name in values(record["rows"], "scaling")
    )
    head = ["steps", "scaling", "PSNR [dB]", "moved back, PSNR [dB]", "depth error [m]", "density"]
    return below(
        text(
            f"""`builtin:room-sparse` with `rgb`, {len(record["rows"][0]["seeds"])} seeds. Training
            cameras moved back by a fifth of the content distance see what hangs in front of them.
            The last column is the mean optical depth around training cameras nearer than any
            surface, where nothing is. A test view [without]({without}) and [with]({with_it})
            scaling.""",
            records.source("floaters"),
        ),
        table(head, rows),
        equal_steps(records),
        by_field(records),
    )


def equal_steps(records: Records) -> str:
    rows, gains = [], []
    names = [f"presets_scaling_{steps}" for steps in (2000, 1000, 4000)]
    for record in (records[name] for name in names):
        for scene in values(record["rows"], "scene"):
            none, clamped = (
                of(record["rows"], scene=scene, candidate=candidate)
                for candidate in ("fast scaling=none", "fast")
            )
            psnr = [[row["psnr"] for row in side] for side in (none, clamped)]
            gains.append(round(float(np.mean(psnr[1]) - np.mean(psnr[0])), 2) + 0.0)
            ssim, depth = (
                ", ".join(f"{np.mean([row[key] for row in side]):.3f}" for side in (none, clamped))
                if key in none[0]
                else ""
                for key in ("ssim", "depth_error")
            )
            gain = f"{gains[-1]:+.2f}"
            cells = [seeds(psnr[0], 2), seeds(psnr[1], 2), gain, ssim, depth]
            rows.append([place(scene), str(record["steps"]), *cells])
    head = ["capture", "steps", "none, PSNR [dB]", "clamped, PSNR [dB]", "gain", "SSIM"]
    return below(
        text(
            f"""Equal steps of `fast` without and with scaling. The gain is between
            {min(gains):+.2f} and {max(gains):+.2f} dB.""",
            *(records.source(name) for name in names),
        ),
        table([*head, "depth error [m]"], rows),
    )


def by_field(records: Records) -> str:
    record, epsilons = records["scaling_fields"], records["scaling_fields_epsilon"]
    settings = record["settings"]
    return below(
        text(
            f"""{settings["steps"]} equal steps of {settings["rays"]} rays, what clamped
            scaling gains over none, PSNR in dB (negative: it loses;
            [by capture](decisions/fields.md)): {gains(record["rows"])}; with marched rays and other
            epsilons of Adam, {gains(epsilons["rows"])}.""",
            records.source("scaling_fields"),
            records.source("scaling_fields_epsilon", THEN_MARCHED),
        ),
    )


def gains(rows: list[dict[str, Any]]) -> str:
    """What clamped scaling gains in each field, from the capture that gains least to the other."""
    said = []
    for field in values(rows, "field"):
        means = [
            [
                np.mean([r["psnr"] for r in of(rows, field=field, scene=scene, scaling=scaling)])
                for scene in values(rows, "scene")
            ]
            for scaling in ("clamped", "none")
        ]
        of_captures = np.subtract(*means)
        said.append(f"`{field}` {of_captures.min():+.2f} to {of_captures.max():+.2f}")
    return ", ".join(said)


def extents(records: Records) -> str:
    boxes, presets, distances, extent = (
        records[name] for name in ("boxes", "presets", "distances", "extents")
    )
    own, planned, *others = boxes["rows"]
    compared = ", ".join(f"{row['psnr']:.2f}" for row in others)
    raced = "; ".join(
        f"`{row['candidate']}` {row['psnr']:.2f} dB, {row['middle_psnr']:.2f} in the middle"
        for row in presets["rows"]
    )
    columns = ["cameras", "photographs", "found", "points", "true"]
    rows = [
        [place(row["scene"]), *(f"{row[key]:.3g}" if row[key] else "" for key in columns)]
        for row in distances["rows"]
    ]
    reached = "; ".join(
        f"{place(scene)} "
        + ", ".join(f"({r['extent']}) {r['psnr']:.2f}" for r in of(extent["rows"], scene=scene))
        for scene in values(extent["rows"], "scene")
    )
    return below(
        text(
            f"""After {boxes["steps"]} steps the scene's own box reaches {own["psnr"]:.2f} dB, the
            one planned by pixels {planned["psnr"]:.2f} dB, others, from the best to the worst by
            the plan, {compared} dB. After {presets["time_limit"]:.0f} s in turns: {raced}.
            PSNR in dB after {extent["steps"]} steps of `rgb` with the extent from cameras,
            a short training, points: {reached}. The table has content distances of
            these, in scene units, and where it is known the median over all pixels.""",
            *(records.source(name) for name in ("boxes", "presets", "extents", "distances")),
        ),
        table(["scene", "cameras", "photographs", "short training", "points", "true"], rows),
    )


def resampling(records: Records) -> str:
    parts = []
    for record in (records[f"presets_{name}"] for name in ("resampled", "resampled_door")):
        compared = "; ".join(
            f"{place(scene)} "
            + " and ".join(
                f"{row['psnr']:.2f} dB (SSIM {row['ssim']:.3f}, {row['samples_per_ray']:.0f}"
                " samples a ray)"
                for row in of(record["rows"], scene=scene)
            )
            for scene in values(record["rows"], "scene")
        )
        parts.append(f"After {record['time_limit']:.0f} s in turns: {compared}.")
    return text(
        f"""`fast` with marched rays, and with resampled ones, on cores that other programs used as
        well. {" ".join(parts)}""",
        records.source("presets_resampled", MARCHED_TODAY),
        records.source("presets_resampled_door", MARCHED_TODAY),
    )


def calibration(records: Records) -> str:
    record, parts = records["calibration"], []
    for scene in values(record["rows"], "scene"):
        found = of(record["rows"], scene=scene)
        posed, coloured = (
            float(np.mean([row[key] - row["psnr"] for row in found]))
            for key in ("posed", "coloured")
        )
        moved = float(np.median([row["moved"] for row in found]))
        parts.append(f"{place(scene)} {posed:+.2f} and {coloured:+.2f} dB ({moved:.1f} pixels)")
    exposed = records["exposures"]
    most = max(values(exposed["rows"], "stops"))
    found = []
    for scene in values(exposed["rows"], "scene"):
        pair = [of(exposed["rows"], scene=scene, stops=most, appearance=how)[0] for how in USED]
        psnrs = " and ".join(f"{row['cc_psnr']:.2f}" for row in pair)
        masses = " and ".join(f"{row['near_mass']:.4f}" for row in pair)
        found.append(f"{place(scene)} {psnrs} dB ({masses})")
    return text(
        f"""After {record["steps"]} steps of `fast` with {record["voxels"]:,} voxels, the pose of
        each test view, or its colours, is fitted to its photograph. Mean gain there, and by how
        many pixels poses move, as median: {"; ".join(parts)}. With training views whose exposure
        is changed by {most:.1f} stops, as standard deviation, cc-PSNR (and near mass) without
        fitted exposures and with: {"; ".join(found)}.""",
        records.source("calibration"),
        records.source("exposures"),
    )
