"""Pictures of records: bars beside the bounds of the machine, and curves of trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

COLOURS = {
    "warpnerf": "#c0392b",
    "torch": "#e8a33d",
    "torch.compile": "#b9770e",
    "numba": "#2471a3",
    "taichi": "#5dade2",
    "drjit": "#1e8449",
}

MODEL_COLOURS = {"rgb": "#e8a33d", "sh": "#2471a3", "deferred": "#c0392b", "per_sample": "#1e8449"}
NO_PLOT = "no plot: matplotlib is not installed"


def plot_heads(record: dict[str, Any], path: Path) -> str:
    """Draw a record of heads.py: a panel each scene, a curve each model and seed.

    Returns:
        What to tell: where it is, or why there is none.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return NO_PLOT
    scenes = list(dict.fromkeys(row["scene"] for row in record["rows"]))
    figure = Figure(figsize=(4.0 * len(scenes) + 1.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axis, scene in zip(axes, scenes, strict=True):
        named = set()
        for row in record["rows"]:
            if row["scene"] != scene:
                continue
            model = row["model"]
            axis.plot(
                [point["seconds"] for point in row["curve"]],
                [point["psnr"] for point in row["curve"]],
                color=MODEL_COLOURS.get(model),
                label=None if model in named else model,
                marker=".",
                markersize=3,
                linewidth=1,
            )
            named.add(model)
        axis.set_title(scene, fontsize=9)
        axis.set_xlabel("seconds of training", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("PSNR on the test views, dB", fontsize=8)
    axes[-1].legend(fontsize=7, frameon=False)
    figure.suptitle(record["machine"]["cpu"], fontsize=8)
    figure.savefig(path, dpi=150)
    return f"plot: {path}"


def plot_throughput(record: dict[str, Any], path: Path) -> str:
    """Draw a record: a panel each number of threads, a group of bars each case.

    Returns:
        What to tell: where it is, or why there is none.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return NO_PLOT
    cases = record["cases"]
    panels = len(cases[0]["rows"])
    names = list(dict.fromkeys(name for case in cases for name in case["rows"][0]["candidates"]))
    labelled: set[str] = set()
    figure = Figure(figsize=(5.5 * panels + 1.5, 1.2 * len(cases) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, sharey=True, squeeze=False)[0]
    height = 0.8 / len(names)
    for panel, axis in enumerate(axes):
        for i, case in enumerate(cases):
            row = case["rows"][panel]
            for j, name in enumerate(name for name in names if name in row["candidates"]):
                ms = row["candidates"][name]["ms"]
                label = None if name in labelled or panel < panels - 1 else name
                labelled |= {name} if label else set()
                y = i - 0.4 + height * (j + 0.5)
                axis.barh(y, ms["median"], height, color=COLOURS[name], label=label)
                axis.hlines(y, ms["low"], ms["high"], color="black", linewidth=1)
                axis.annotate(
                    f" {ms['median']:.0f}" if ms["median"] >= 10 else f" {ms['median']:.1f}",
                    (ms["high"], y),
                    va="center",
                    fontsize=6,
                )
            for key, style in (("least_ms", "-"), ("cached", ":"), ("walk", "--")):
                bound = row.get(key, row.get("bounds_ms", {}).get(key))
                if bound is not None:
                    axis.vlines(
                        bound,
                        i - 0.42,
                        i + 0.42,
                        color="black",
                        linestyle=style,
                        linewidth=1,
                        label=None if i else BOUNDS[key],
                    )
        threads = cases[0]["rows"][panel]["threads"]
        axis.set_title("1 thread" if threads == 1 else f"{threads} threads", fontsize=9)
        axis.set_xscale("log")
        axis.set_xlabel("milliseconds a step", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yticks(range(len(cases)), [label_of(case) for case in cases])
    axes[0].invert_yaxis()
    axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.suptitle(
        f"Forward, loss and adjoint of {record['n_rays']} rays x {record['n_steps']} steps, "
        f"{record['machine']['cpu']}",
        fontsize=10,
    )
    figure.savefig(path, dpi=150)
    return f"plot: {path}"


BOUNDS = {
    "least_ms": "bound of any program",
    "cached": "warpnerf, if memory were free",
    "walk": "random lines, ray after ray",
}


def label_of(case: dict[str, Any]) -> str:
    """A case in two lines."""
    scaling = "" if case["scaled"] else ", not scaled"
    return f"{case['model']}: {case['rays']} rays, {case['grid']}^3\n{case['scene']}{scaling}"
