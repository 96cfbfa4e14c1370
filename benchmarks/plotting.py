"""The picture of a record of throughput.py: bars beside the bounds of the machine."""

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


def plot_throughput(record: dict[str, Any], path: Path) -> str:
    """Draw a record: a panel each number of threads, a group of bars each case.

    Returns:
        What to tell: where it is, or why there is none.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return "no plot: matplotlib is not installed"
    cases = record["cases"]
    panels = len(cases[0]["rows"])
    names = list(cases[0]["rows"][0]["candidates"])
    figure = Figure(figsize=(5.5 * panels + 1.5, 1.2 * len(cases) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, sharey=True, squeeze=False)[0]
    height = 0.8 / len(names)
    for panel, axis in enumerate(axes):
        for i, case in enumerate(cases):
            row = case["rows"][panel]
            for j, name in enumerate(names):
                ms = row["candidates"][name]["ms"]
                y = i - 0.4 + height * (j + 0.5)
                axis.barh(y, ms["median"], height, color=COLOURS[name], label=name if not i else "")
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
                        label="" if i else BOUNDS[key],
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
    return f"{case['rays']} rays, {case['grid']}^3\n{case['scene']}{scaling}"
