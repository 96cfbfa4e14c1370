"""The section of docs/benchmarks.md on pairs of trainings without and with the scaling."""

from __future__ import annotations

from typing import Any

import numpy as np
from page_parts import Records, below, place, table, text

from warpnerf.reports.paired import CONFIDENCE

COLUMNS = {
    "psnr": ("PSNR [dB]", 2),
    "ssim": ("SSIM", 4),
    "training_psnr": ("of training views", 2),
    "pulled_psnr": ("moved back", 2),
    "front_train": ("light in front", 3),
    "behind_train": ("behind", 3),
    "seen_depth_error": ("depth error", 3),
    "near_mass": ("near mass", 4),
}


def evidence(records: Records) -> str:
    record = records["evidence"]
    rows = [
        [place(row["scene"].replace("builtin-", "builtin:")), f"`{row['name'].split('-')[0]}`"]
        + [cell(row, name) for name in COLUMNS]
        for row in record["rows"]
        if row["differences"]
    ]
    gains = [row["differences"]["psnr"]["mean"] for row in record["rows"] if row["differences"]]
    return below(
        text(
            f"""Photographs reduced {record["downscale"]} times, {record["steps"]} steps,
            {record["seeds"]} seeds; both sides of a pair draw the same rays. `rgb` is trained
            without other losses, `fast` is the preset. First without the scaling, then by how much
            that changes with it, and its {CONFIDENCE:.0%} interval over the seeds
            ([formulas](metrics.md)). PSNR changes by {min(gains):+.2f} to {max(gains):+.2f} dB.
            """,
            records.source("evidence"),
        ),
        table(["capture", "", *(heading for heading, _ in COLUMNS.values())], rows),
    )


def cell(row: dict[str, Any], name: str) -> str:
    """What a figure is without the scaling, and how it changes."""
    if name not in row["differences"]:
        return ""
    digits, change = COLUMNS[name][1], row["differences"][name]
    without = float(np.mean(row["values"][name])) - change["mean"]
    return (
        f"{without:.{digits}f} {change['mean']:+.{digits}f} "
        f"({change['low']:+.{digits}f}, {change['high']:+.{digits}f})"
    )
