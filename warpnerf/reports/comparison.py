"""Comparisons of configurations: what an experiment's figures say, in numbers and in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpnerf.config import Scaling
from warpnerf.config_json import config_to_json
from warpnerf.reports.experiment import Candidate, Experiment
from warpnerf.reports.paired import CONFIDENCE, Difference, paired_difference
from warpnerf.runs.logs import read_reports


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure that is compared."""

    heading: str
    """With its unit."""
    path: tuple[str, ...]
    """Where metrics.json has it."""
    better: int
    """1: more is better; -1: less is; 0: neither by itself."""
    digits: int
    """Behind the point."""


def _light(split: str, rays: str) -> dict[str, Figure]:
    """Where light is absorbed. Only what ends at surfaces tells better from worse: an emptier field
    has less in front of them, and misses them more."""
    headings = {
        "front": ("light in front", 0),
        "hit": ("light at surfaces", 1),
        "behind": ("light behind", 0),
        "transmitted": ("light that passes", 0),
    }
    return {
        f"{name}_{split}": Figure(
            heading=f"{heading}, {rays}",
            path=("measures", "light", split, name),
            better=better,
            digits=4,
        )
        for name, (heading, better) in headings.items()
    }


FIGURES = {
    "psnr": Figure(heading="PSNR [dB]", path=("mean", "psnr"), better=1, digits=2),
    "cc_psnr": Figure(
        heading="PSNR, colours corrected [dB]", path=("mean", "cc_psnr"), better=1, digits=2
    ),
    "ssim": Figure(heading="SSIM", path=("mean", "ssim"), better=1, digits=4),
    "training_psnr": Figure(
        heading="PSNR of training views [dB]",
        path=("measures", "training_psnr"),
        better=0,
        digits=2,
    ),
    "pulled_psnr": Figure(
        heading="PSNR of views pulled back [dB]",
        path=("floaters", "pulled_psnr"),
        better=1,
        digits=2,
    ),
    "seen_psnr": Figure(
        heading="PSNR where two training views see [dB]",
        path=("measures", "seen", "2", "psnr"),
        better=1,
        digits=2,
    ),
    "coverage": Figure(
        heading="coverage there", path=("measures", "seen", "2", "coverage"), better=1, digits=4
    ),
    "seen_depth_error": Figure(
        heading="depth error there [scene units]",
        path=("measures", "seen", "2", "depth_error"),
        better=-1,
        digits=4,
    ),
    **_light("test", "test rays"),
    **_light("train", "training rays"),
    "near_mass": Figure(
        heading="optical depth near cameras", path=("floaters", "near_mass"), better=-1, digits=4
    ),
    "near_density": Figure(
        heading="optical depth where nothing is",
        path=("measures", "near_density"),
        better=-1,
        digits=4,
    ),
}
"""By name; docs/metrics.md has their formulas. A capture has those that can be measured there."""

WITHIN = ("floaters", "within")
"""Where metrics.json has the distance up to which the figures beside it were taken."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a configuration came to."""

    candidate: Candidate
    """Which."""
    values: dict[str, list[float]]
    """By figure, of each seed that did not fail."""
    seconds: list[float]
    """Of training, of each seed that did not fail."""
    differences: dict[str, Difference]
    """By figure, from that which it is compared with; none where it is compared with none."""
    left_out: tuple[str, ...] = ()
    """Which trainings failed, and what could not be compared, a sentence each."""


def candidates_of(
    configs: Mapping[tuple[str, str | None, Scaling, str | None], Any],
) -> list[Candidate]:
    """Configurations by preset, field, scaling and decay, each compared with one of them.

    That is the one with the first scaling and decay, of the same preset and field; of a single
    scaling and decay, the first of all.

    Args:
        configs: In the order in which they are to stand; None is the preset's own.
    """
    names = {key: "-".join(part for part in key if part is not None) for key in configs}
    first, n_forms = next(iter(configs)), len({key[2:] for key in configs})
    found = []
    for key, config in configs.items():
        against = (*key[:2], *first[2:]) if n_forms > 1 else first
        other = None if against == key else names[against]
        found.append(Candidate(name=names[key], config=config, against=other))
    return found


def compare_figures(experiment: Experiment) -> list[Row]:
    """The figures of an experiment that has finished, and their paired differences.

    Seeds whose trainings failed are left out of both sides.
    """
    found = {
        candidate.name: {
            seed: metrics
            for seed in experiment.seeds
            if (metrics := experiment.metrics(candidate, seed)) is not None
        }
        for candidate in experiment.candidates
    }
    rows = []
    for candidate in experiment.candidates:
        own, other = found[candidate.name], found.get(candidate.against or "", {})
        left_out = [
            f"{candidate.name} with seed {seed} failed, and counts in no figure: {failure}"
            for seed in experiment.seeds
            if (failure := experiment.failure(candidate, seed)) is not None
        ]
        paired = [seed for seed in own if seed in other]
        mine, theirs = (_known([of[seed] for seed in paired]) for of in (own, other))
        differences = {
            name: paired_difference(mine[name], theirs[name]) for name in mine if name in theirs
        }
        if any(value_at(own[seed], WITHIN) != value_at(other[seed], WITHIN) for seed in paired):
            differences = {n: d for n, d in differences.items() if FIGURES[n].path[0] != WITHIN[0]}
            left_out.append(
                f"{candidate.name} against {candidate.against}: figures near cameras are not "
                "compared, as they were taken up to different distances."
            )
        seconds = []
        for seed in own:
            reports = read_reports(experiment.run(candidate, seed).folder / "log.jsonl")
            seconds.append(float(reports[-1]["seconds"]) if reports else 0.0)
        rows.append(
            Row(
                candidate=candidate,
                values=_known(list(own.values())),
                seconds=seconds,
                differences=differences,
                left_out=tuple(left_out),
            )
        )
    return rows


def _known(metrics: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """Figures that all of some trainings have, by name, a value of each."""
    known = {}
    for name, figure in FIGURES.items():
        values = [value for of in metrics if (value := value_at(of, figure.path)) is not None]
        if values and len(values) == len(metrics):
            known[name] = values
    return known


def value_at(tree: Any, path: Sequence[str]) -> float | None:
    """A number in metrics.json; None where it has none."""
    for name in path:
        tree = tree.get(name) if isinstance(tree, dict) else None
    return float(tree) if isinstance(tree, int | float) else None


def sentences(rows: Sequence[Row]) -> list[str]:
    """What differs significantly and what does not, a sentence for each, and a caution."""
    said = [sentence for row in rows for sentence in row.left_out]
    compared = [row for row in rows if row.differences]
    n_seeds = [difference.seeds for row in compared for difference in row.differences.values()]
    if not n_seeds:
        return [*said, "Nothing could be compared."]
    if max(n_seeds) < 2:
        return [
            *said,
            "One seed: differences have no interval, and none can be called significant.",
        ]
    said += [f"{r.candidate.name} against {r.candidate.against}: {_verdict(r)}." for r in compared]
    by_chance = (1.0 - CONFIDENCE) * sum(n > 1 for n in n_seeds)
    said.append(
        f"{CONFIDENCE:.0%} intervals of the mean difference over {max(n_seeds)} seeds, by "
        f"Student's t; they say nothing of other captures. Of {sum(n > 1 for n in n_seeds)} "
        f"differences, {by_chance:.1f} are expected to look significant by chance."
    )
    return said


def _verdict(row: Row) -> str:
    """Figures that are better, worse, changed and not significantly different, in words.

    Names and intervals have commas; so lists are divided by semicolons, and groups by full stops.
    """
    groups: dict[str, list[str]] = {"better in": [], "worse in": [], "changed in": []}
    rest = []
    for name, difference in row.differences.items():
        figure = FIGURES[name]
        if not difference.significant:
            rest.append(figure.heading.partition(" [")[0])
            continue
        how = {1: "better in", -1: "worse in", 0: "changed in"}[
            int(np.sign(difference.mean)) * figure.better
        ]
        groups[how].append(
            f"{figure.heading.partition(' [')[0]} ({in_words(difference, figure.digits)})"
        )
    parts = [f"{how} {'; '.join(names)}" for how, names in groups.items() if names]
    if rest:
        parts.append(f"no significant difference in {'; '.join(rest)}")
    return ". ".join(part[0].upper() + part[1:] if k else part for k, part in enumerate(parts))


def in_words(difference: Difference, digits: int) -> str:
    """A difference and its interval."""
    text = f"{difference.mean:+.{digits}f}"
    if difference.low is None or difference.high is None:
        return text
    return f"{text}, {difference.low:+.{digits}f} to {difference.high:+.{digits}f}"


def figures_to_json(experiment: Experiment, rows: Sequence[Row]) -> dict[str, Any]:
    """What figures.json says."""
    capture = experiment.capture
    return {
        "scene": capture.source,
        "downscale": capture.downscale,
        "seeds": list(experiment.seeds),
        "confidence": CONFIDENCE,
        "sentences": sentences(rows),
        "configurations": [
            {
                "name": row.candidate.name,
                "against": row.candidate.against,
                "train": config_to_json(row.candidate.config),
                "seconds": row.seconds,
                "left_out": list(row.left_out),
                "figures": {
                    name: {
                        "values": values,
                        "mean": float(np.mean(values)),
                        "half_range": float(np.ptp(values)) / 2.0,
                    }
                    for name, values in row.values.items()
                },
                "differences": {
                    name: asdict(difference) | {"significant": difference.significant}
                    for name, difference in row.differences.items()
                },
            }
            for row in rows
        ],
    }
