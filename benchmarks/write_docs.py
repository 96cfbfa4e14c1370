"""Writes docs/benchmarks.md from the records in benchmarks/results.

    python benchmarks/write_docs.py

Each function under "Sections", here and in page_quality.py, page_jobs.py and page_evidence.py,
writes one section. Its words hold whatever was measured, what follows from figures is in
docs/decisions; its figures are read from the records, none is written by hand. After a new record,
run it again.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import RESULTS, ROOT, named, show
from page_evidence import evidence
from page_jobs import jobs
from page_parts import Records, below, medians, middle, of, place, table, text, values
from page_quality import calibration, extents, resampling, scaling

PAGE = ROOT / "docs" / "benchmarks.md"
MEGA, GIBI = 1e6, 2.0**30

INTRODUCTION = """\
`python benchmarks/write_docs.py` writes this page from the records in `benchmarks/results/`. A
record names its command, machine, versions and, where it has one, commit: what the defaults were
then. Scenes, and how to read a record, are in [benchmarks/README.md](../benchmarks/README.md), what
presets reach within minutes in [README.md](../README.md#results), what follows from figures in
[decisions](decisions/README.md). Both sides of a comparison take turns on one machine. Brackets
hold intervals of a median; ± is half of the range over seeds.
"""

RGB_TODAY = ", today with `--model rgb`"
"""What commands need since trainings take another model by default."""


def page(folder: Path = RESULTS) -> str:
    """The text of docs/benchmarks.md, by the records of a folder."""
    records = Records(folder)
    sections = [f"## {heading}\n\n{write(records)}\n" for heading, write in SECTIONS.items()]
    return "\n".join(["# Benchmarks\n", text(INTRODUCTION) + "\n", *sections])


# Sections


def cost(records: Records) -> str:
    names = ["gradient_scaling", "gradient_scaling_models", "gradient_scaling_fields"]
    results = [
        {"model": "rgb", "field": "dense", **row}
        for name in names
        for row in records[name]["results"]
    ]
    said = {
        "render_train": "fused launch, as in trainings",
        "render_backward": "backward launch",
        "control": "a launch against itself",
        "torch backward": "torch with the paper's operation, one thread",
        "operation alone": "that operation alone",
    }
    columns = list(dict.fromkeys((row["model"], row["field"]) for row in results))
    rows = []
    for name, words in said.items():
        cells = []
        for model, field in columns:
            for row in of(results, model=model, field=field, name=name):
                percent = {key: 100 * share for key, share in row["share_of_backward"].items()}
                cells.append(f"{show(row['difference_us'], 0)}; {show(percent, 2)} %")
        rows.append([words, *cells, *[""] * (len(columns) - len(cells))])
    return below(
        text(
            f"""Scaled against without: microseconds per {records[names[0]]["n_samples"]:,} samples,
            and share of the unscaled backward pass. Of warpnerf these are two compiled programs,
            which differ a little whatever they leave out. Fields besides dense grids were measured
            on cores that other programs used as well.""",
            *(records.source(name) for name in names),
        ),
        table(["", *(kind(model, field) for model, field in columns)], rows),
    )


def kind(model: str, field: str) -> str:
    """A model, and what it is stored in besides a dense grid."""
    return f"`{model}`" if field == "dense" else f"`{model}`, `{field}`"


def throughput(records: Records) -> str:
    names = ["throughput", "throughput_models", "throughput_fields"]
    cases = [case for name in names for case in records[name]["cases"]]
    others = list(dict.fromkeys(key for case in cases for key in case["rows"][-1]["candidates"]))
    others.remove("warpnerf")
    rows = []
    for case in cases:
        found = case["rows"][-1]["candidates"]
        model, field = case.get("model", "rgb"), case.get("field", "dense")
        what = [kind(model, field), case["rays"], f"{case['grid']}³", case["scene"]]
        what += [] if case["scaled"] else ["not scaled"]
        times = (
            f"{middle(found[key]['ms'], 0)} ({middle(found[key]['over_warpnerf'], 1)})"
            if key in found
            else ""
            for key in others
        )
        cells = [f"{case['n_samples']:,}", middle(found["warpnerf"]["ms"], 1)]
        rows.append([", ".join(what), *cells, *times])
    record, memory = (records[name] for name in names[:2])
    last = [case["rows"][-1] for case in record["cases"]]
    second = [row["candidates"]["warpnerf"]["over_one_thread"] for row in last]
    quiet = [case["undisturbed"]["times_as_fast"] for case in records["threads"]["cases"]]
    ours, theirs, steps = (
        ", ".join(f"{row[key] / unit:.0f}" for row in memory["memory"])
        for key, unit in (("warpnerf_bytes", MEGA), ("torch_bytes", MEGA), ("n_steps", 1))
    )
    return below(
        text(
            f"""The gradient of a training step (forward, loss, scaled adjoint, zeroing,
            accumulation) of {record["n_rays"]} rays x {record["n_steps"]} steps on
            {last[0]["threads"]} threads, in ms; in brackets how many times as long as warpnerf, the
            median over rounds ([plot](../benchmarks/results/throughput_cpu.png) of the first run).
            So many threads are {medians(second)} times as fast as one there, and {medians(quiet)}
            times where controls find the cores idle. Besides grid, gradient and optimiser a step
            takes {ours} MB with {steps} steps a ray, torch {theirs} MB between the passes. Fields
            besides dense grids, where torch is told where samples lie, were measured on cores that
            other programs used as well: of these rows ratios compare, not times.""",
            *(records.source(name) for name in (*names, "threads")),
        ),
        table(["model, rays, grid", "samples", "warpnerf", *others], rows),
    )


def late(records: Records) -> str:
    record = records["against_torch"]
    rows = []
    for row in record["rows"]:
        cells = [f"`{row['model']}`", f"{row['n_samples'] / row['n_rays']:.0f}"]
        for what in ("pass", "step"):
            cells += [middle(row[f"{who}_{what}_ms"], 1) for who in ("warpnerf", "torch")]
            cells.append(show(row[f"{what}_over_warpnerf"], 1))
        rows.append(cells)
    sides = [
        f"{what}, {who}" for what in ("pass", "step") for who in ("warpnerf", "torch", "ratio")
    ]
    return below(
        text(
            f"""Steps at nine tenths of {record["steps"]} against eager torch, on up to
            {record["machine"]["threads"]} threads, in ms. Free cells are skipped and rays end early
            on both sides; a step is the pass and Adam; `dvgo` is DVGO's model.""",
            records.source("against_torch"),
        ),
        table(["model", "samples per ray", *sides], rows),
    )


def models(records: Records) -> str:
    steps, heads, older = records["models"], records["heads"], records["against"]
    scenes, captures = values(steps["rows"], "scene"), values(heads["rows"], "scene")
    threads, rows, small = max(values(steps["rows"], "threads")), [], named("deferred")
    for model in values(steps["rows"], "model"):
        cells = []
        for scene in scenes:
            (row,) = of(steps["rows"], model=model, scene=scene, threads=threads)
            cells.append(f"{row['samples_per_ray']:.0f}")
            cells.append(f"{middle(row['step_ms'], 1)} ({middle(row['over_rgb'], 2)})")
        for scene in captures:
            ends = [row["curve"][-1] for row in of(heads["rows"], model=model, scene=scene)]
            cells.append(f"{np.mean([end['psnr'] for end in ends]):.2f}")
        rows.append(
            [f"`{model}`", *cells, medians([r["ratio"] for r in of(older["rows"], model=model)])]
        )
    head = [f"{place(s)}, {what}" for s in scenes for what in ("samples per ray", "step [ms]")]
    head += [f"{place(scene)}, PSNR" for scene in captures]
    return below(
        text(
            f"""Whole steps late in a training of {steps["steps"]} steps on {threads} threads, in
            brackets over those of `rgb`. PSNR in dB after {heads["time_limit"]:.0f} s, each on a
            clock of its own ([plot](../benchmarks/results/heads_cpu.png)). The last column is time
            at commit {older["commits"]["here"]} over that at {older["commits"]["there"]}, the least
            and the greatest median over rays and scenes. `deferred` is
            `wn.Deferred(specular={small.specular}, width={small.width})`.""",
            *(records.source(name) for name in ("models", "heads", "against")),
        ),
        table(["model", *head, "over an older commit"], rows),
    )


def training(records: Records) -> str:
    record, schedules, order = (records[name] for name in ("training", "schedules", "ray_order"))
    parts = {"rays": "rays and their gradient", "drawing": "drawing rays", "Adam": "Adam"}
    parts["smoothing"] = "total variation"
    rows = []
    for scene, row in record["scenes"].items():
        shares = [row[part] for part in parts]
        cells = [f"{share:.1%}" for share in [*shares, 1 - sum(shares)]]
        rows.append([place(scene), f"{row['samples_per_ray']:.0f}", *cells])
    reached = "; ".join(
        f"{schedule}: "
        + ", ".join(
            f"{row['psnr']:.2f} dB ({row['besides_rays']:.0%})"
            for row in of(schedules["rows"], schedule=schedule)
        )
        for schedule in schedules["schedules"]
    )
    batch = 4  # steps, of which updates are late in a training
    ratios = "; ".join(
        f"{place(scene)} "
        + ", ".join(show(found[run], 2) for run in found if run.endswith(f", {batch} steps"))
        for scene, found in order["scenes"].items()
    )
    return below(
        text(
            f"Shares of trainings of {record['time_limit']:.0f} s with `rgb`.",
            records.source("training", RGB_TODAY),
        ),
        table(["scene", "samples per ray", *parts.values(), "the rest"], rows),
        text(
            f"""Steps per update: PSNR after {schedules["time_limit"]:.0f} s with `rgb` on
            {", ".join(place(scene) for scene in values(schedules["rows"], "scene"))}, in brackets
            the share of time that is not rays: {reached}. Time of a pass with rays sorted by where
            their middles lie, over that with rays as they are drawn, in batches of {batch} steps,
            on one thread and on several: {ratios}.""",
            records.source("schedules", RGB_TODAY),
            records.source("ray_order", RGB_TODAY),
        ),
    )


def machine(records: Records) -> str:
    start, disk, frames = (records[name] for name in ("footprint", "photos_on_disk", "rendering"))
    memory, (width, height) = start["memory"], disk["size"]
    times = "; ".join(
        f"threads {row['threads']}: {middle(row['warpnerf']['ms'], 0)} ms, eager torch"
        f" {show(row['torch_over_warpnerf'], 1)} times as long"
        for row in frames["rows"]
    )
    return below(
        text(
            f"""`warpnerf train` on {place(start["scene"])} with `rgb` ends its first step after
            {start["cold_seconds"]:.1f} s where kernels have to be compiled, after
            {middle(start["cached_seconds"], 1)} s where not. It takes
            {memory["peak_bytes"] / MEGA:.0f} MB, {memory["before_bytes"] / MEGA:.0f} of them before
            training; values, gradient and moments of {memory["grid"][0]}³ nodes in single precision
            are {memory["arrays_bytes"] / MEGA:.0f} MB. {disk["photographs"]} photographs of
            {width} x {height} pixels, {disk["decoded_bytes"] / GIBI:.1f} GiB decoded, on disk:
            `train` takes {disk["most_anonymous_bytes"] / GIBI:.2f} GiB of its own, with pages of
            the file, which the system can take back,
            {disk["most_resident_bytes"] / GIBI:.2f}. An update takes
            {show(disk["disk_over_memory"], 2)} of its time with photographs in memory. A
            frame of {frames["pixels"]} x {frames["pixels"]} pixels: {times}.""",
            records.source("footprint", RGB_TODAY),
            records.source("photos_on_disk"),
            records.source("rendering"),
        ),
    )


def exports(records: Records) -> str:
    record = records["mesh"]
    rows = [
        [
            f"{row['opacity']:.0%}" + (", `--unseen`" if row["unseen"] else ""),
            f"{100 * row['mesh_to_truth']:.2f} cm, {row['mesh_within_5_cm']:.1%}",
            f"{100 * row['truth_to_mesh']:.2f} cm, {row['truth_within_5_cm']:.1%}",
            f"{row['colour_psnr']:.1f} dB",
        ]
        for row in record["mesh"]
    ]
    splats = record["splats"]
    figures = splats["psnr_against_field"]
    of_object = records["object_mesh"]
    names = ("mesh_to_truth", "truth_to_mesh", "chamfer", "thin_mean", "thin_most", "apart")
    meshes = [
        [row["mesh"], f"{row['faces']:,}", *(f"{1e3 * row[name]:.1f}" for name in names)]
        for row in of_object["rows"]
    ]
    return below(
        text(
            f"""`builtin:room` after {record["steps"]} steps, exported, against its exact surfaces:
            mean distance, and what is within five centimetres. A voxel edge is
            {100 * record["voxel_edge"]:.1f} cm. {splats["count"]:,} splats, drawn by another
            renderer (`tests/reference/splats.py`), are {min(figures):.1f} to {max(figures):.1f} dB
            from the field's own pictures ([a test view](splats.jpg)).""",
            records.source("mesh"),
        ),
        table(["opacity of a voxel edge", "mesh to truth", "truth to mesh", "colours"], rows),
        text(
            f"""Meshes of the object of `object_scan.py` against its exact surfaces, in thousandths
            of a scene unit: mean distance from the mesh to the truth; from what the training
            cameras see to points on the mesh, which hardly comes below how far these are apart
            (last column); and the mean of both, the chamfer distance. Of thin parts, at most
            {1e3 * of_object["thin"]:.0f} across, the mean distance to the mesh, and what nine
            tenths stay below. {of_object["about"]}""",
            records.source("object_mesh"),
        ),
        table(
            [
                *("mesh", "faces", "to truth", "from truth", "chamfer"),
                *("thin parts", "nine tenths", "points apart"),
            ],
            meshes,
        ),
    )


def served(records: Records) -> str:
    viewer, client = records["viewer"], records["nerfbaselines_client"]
    dragging = records["dragging"]
    ratio = viewer["training"]["ratios"]["nobody looks"]
    width, height = viewer["window"]
    compared = "; ".join(
        f"{place(row['scene'])} {row['psnr_nerfbaselines']:.2f} and {row['psnr_warpnerf']:.2f} dB,"
        f" SSIM {row['ssim_nerfbaselines']:.3f} and {row['ssim_warpnerf']:.3f}"
        for row in client["scenes"]
    )
    return below(
        text(
            f"""The page of `warpnerf view` in a window of {width} x {height} pixels: a fine picture
            takes {show(viewer["painting"]["whole"]["seconds"], 2)} s, and is there
            {show(viewer["fine_picture_seconds"], 2)} s after the last move. The first
            comes {show(viewer["first_picture_seconds"], 2)} s after the page has said where its
            camera is; in Chromium, drawing on the same cores,
            {show(viewer["browser"]["first_picture_seconds"], 2)} s after the load event.
            A mouse that drags a window of {dragging["window"][0]} x {dragging["window"][1]} pixels
            sees {show(dragging["pictures_per_second"], 1)} pictures a second, and the fine one
            {show(dragging["fine_picture_seconds"], 2)} s after the last move. A training
            with a page at which nobody looks takes {show(ratio, 2)} of the time without.
            Metrics by nerfbaselines of its own pictures, and by warpnerf of the same field
            after {client["steps"]} steps: {compared}. The rest is rounding.""",
            records.source("viewer"),
            records.source("dragging"),
            records.source("nerfbaselines_client"),
        ),
    )


SECTIONS: dict[str, Callable[[Records], str]] = {
    "What the scaling changes": scaling,
    "Pairs without and with the scaling": evidence,
    "What the scaling costs": cost,
    "Throughput": throughput,
    "Late in a training": late,
    "Models": models,
    "Where the time of a training goes": training,
    "Extent and content distance": extents,
    "Resampled steps": resampling,
    "Poses and exposures": calibration,
    "Start, memory, rendering": machine,
    "Several processes, scenes in blocks": jobs,
    "Exports": exports,
    "Viewer and nerfbaselines": served,
}
"""By heading, to which other documents link."""


def main() -> None:
    PAGE.write_text(page())
    print(f"page: {PAGE}")


if __name__ == "__main__":
    main()
