"""`warpnerf compare`: configurations times seeds on one capture, and a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

from warpnerf.checks import InputError, require_whole, said
from warpnerf.cli.arguments import SceneName, Settings, Usual
from warpnerf.cli.configured import begun_with, configured
from warpnerf.cli.given import NOTHING, Given, flag_of, near_to
from warpnerf.cli.machine import FAILED, require_machine
from warpnerf.config import Scaling, TrainConfig
from warpnerf.model.storage_kinds import STORAGE_KINDS
from warpnerf.presets import PRESETS
from warpnerf.runtime.progress import ProgressBar
from warpnerf.runtime.signals import Stopped, StopRequest
from warpnerf.scenes.split import read_split

if TYPE_CHECKING:
    from warpnerf.reports.comparison import Row
    from warpnerf.reports.experiment import Capture, Experiment


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """What `warpnerf compare` is given besides a configuration."""

    scene: SceneName
    """Folder of a scene, an .npz file, builtin:room or builtin:room-sparse; with two test views or
    more."""
    output: Path
    """Folder for the runs and the report; the same again to continue."""
    scalings: tuple[str, ...] = ("none", "quadratic", "clamped")
    """Scalings of gradients by distance; the others are compared with the first."""
    near_decays: tuple[str, ...] = ()
    """Strengths of the decay of densities near cameras (optim.near_decay), such as 0 and 0.1; by
    default that of the preset."""
    fields: tuple[str, ...] = ()
    """Fields: dense, vm, hash, auto; by default that of the preset."""
    presets: tuple[str, ...] = ("fast",)
    """Presets to begin with, as of train."""
    seeds: int = 3
    """How many: each configuration is trained with seeds 0, 1, ..."""
    downscale: int = 1
    """As of train."""
    masks: Path | None = None
    """As of train."""
    split: str | None = None
    """As of train."""
    model_options: Settings = ()
    """As of train."""
    loss: Settings = ()
    """As of train."""


USUAL = Usual(
    (
        "output",
        "scalings",
        "near_decays",
        "fields",
        "presets",
        "seeds",
        "steps",
        "time_limit",
        "downscale",
        "masks",
        "split",
        "model",
        "grid.voxels",
        "march.near",
        "device",
        "threads",
    )
)

LISTS = {
    "scaling": "--scalings",
    "optim.near_decay": "--near-decays",
    "field": "--fields",
    "seed": "--seeds",
}
"""Fields of a configuration that are compared, and the option that lists them."""

MAX_SEEDS = 1000
"""More are a mistake."""


def compare_command(options: CompareOptions, given: Annotated[Given, USUAL] = NOTHING) -> int:
    """Compare scalings, fields or presets on a scene: train each with several seeds, and report.

    Stopped, it continues with the same command; no training is repeated. Options that train has as
    well replace the values of all presets.

    --help-all shows one for each field of the configuration.
    """
    for name, flag in LISTS.items():
        if name in given:
            raise InputError(f"{flag_of(name)}: compare takes several, by {flag}.")
    require_whole("--seeds", options.seeds, 1)
    if options.seeds > MAX_SEEDS:
        raise InputError(f"--seeds must be at most {MAX_SEEDS}, not {options.seeds}.")
    configs = _configs(options, given)
    if len(configs) < 2:
        raise InputError(
            "compare needs two configurations or more; name several by --scalings, --near-decays, "
            "--fields or --presets."
        )
    for config in configs.values():
        require_machine(config)

    from warpnerf.media.video import video_file
    from warpnerf.reports.compare import PAGE, require_comparable, write_comparison
    from warpnerf.reports.comparison import candidates_of
    from warpnerf.reports.comparison_film import FILM, FPS
    from warpnerf.reports.experiment import Experiment, require_free

    require_free(options.output)
    capture = _capture(options, next(iter(configs.values())).threads)
    require_comparable(capture.scene)
    experiment = Experiment(options.output, capture, candidates_of(configs), options.seeds)
    experiment.begin()
    try:
        code = train_all(experiment)
        if code is not None:
            return code
        with ProgressBar("reading fields") as bar:
            rows = write_comparison(experiment, bar.report)
    except Stopped as stopped:
        print("stopped; the same command continues", flush=True)
        return stopped.exit_code
    _print(rows)
    film, note = video_file(options.output / FILM, FPS)
    if note is not None:
        print(note)
    print(f"wrote {options.output / PAGE}, figures.json, {film.name}, and pictures")
    return (
        FAILED if any(experiment.failure(*trial) is not None for trial in experiment.trials) else 0
    )


def _configs(
    options: CompareOptions, given: Given
) -> dict[tuple[str, str | None, Scaling, str | None], TrainConfig]:
    """Configurations by preset, field, scaling and decay.

    Raises:
        InputError: A name is none or stands twice, or an option does not fit.
    """
    _require_names("--scalings", options.scalings, get_args(Scaling))
    _require_names("--presets", options.presets, list(PRESETS))
    if options.fields:
        _require_names("--fields", options.fields, list(STORAGE_KINDS))
    stored: Sequence[str | None] = options.fields or (None,)
    decays: Sequence[str | None] = options.near_decays or (None,)
    found: dict[Any, TrainConfig] = {}
    for preset, field, scaling, decay in product(options.presets, stored, options.scalings, decays):
        of_this = {**given, "scaling": (scaling,)}
        if field is not None:
            of_this["field"] = (field,)
        if decay is not None:
            of_this["optim.near_decay"] = (decay,)
        config = configured(PRESETS[preset], of_this, options.model_options, options.loss)
        own = config.optim.near_decay == PRESETS[preset].optim.near_decay
        key = preset, field, scaling, None if own else f"decay-{config.optim.near_decay:g}"
        if key in found:
            raise InputError(f"--near-decays: {decay} is given twice; leave one of them out.")
        found[key] = begun_with(config, given)
    return found


def _require_names(flag: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise InputError unless all names are known, and none stands twice."""
    if not names:
        raise InputError(f"{flag} has no value; it takes one or several of {', '.join(known)}.")
    for name in names:
        if name not in known:
            raise InputError(
                f"{flag}: {said(name)} is none of {', '.join(known)}{near_to(name, known)}."
            )
        if names.count(name) > 1:
            raise InputError(f"{flag}: {name} is given twice; leave one of them out.")


def _capture(options: CompareOptions, threads: int | None) -> Capture:
    """What is trained on."""
    from warpnerf.reports.experiment import Capture
    from warpnerf.scenes.formats.load import BUILTIN, load_scene

    split = None if options.split is None else read_split(options.split)
    scene, source = options.scene, options.scene
    if not source.startswith(BUILTIN):
        source = str(Path(source).resolve())
    print(f"reading {scene}", flush=True)
    return Capture(
        scene=load_scene(
            scene, downscale=options.downscale, masks=options.masks, threads=threads, split=split
        ),
        source=source,
        downscale=options.downscale,
        masks=None if options.masks is None else str(options.masks.resolve()),
        split=split,
    )


def train_all(experiment: Experiment) -> int | None:
    """Train what has not been trained yet, a line of a table each.

    Returns:
        None: all is done; an exit code where it was asked to stop.
    """
    trials = experiment.trials
    width = max(len(candidate.name) for candidate in experiment.candidates)
    print(f"{'':7}  {'configuration':{max(width, 13)}}  seed    PSNR    SSIM", flush=True)
    for number, (candidate, seed) in enumerate(trials, 1):
        place = f"{number} of {len(trials)}"
        with StopRequest() as stop:
            ended = experiment.metrics(candidate, seed) or experiment.failure(candidate, seed)
            if ended is None:
                with ProgressBar(f"{candidate.name}, seed {seed}") as bar:
                    experiment.train(candidate, seed, lambda: stop.asked, bar.report)
            if stop.exit_code is not None:
                print("stopped; what was trained is saved, and the same command continues")
                return stop.exit_code
        metrics, failure = experiment.metrics(candidate, seed), experiment.failure(candidate, seed)
        said = "" if failure is None else f"failed: {failure}"
        if metrics is not None:
            said = f"{metrics['mean']['psnr']:6.2f}  {metrics['mean']['ssim']:6.4f}"
        print(f"{place:>7}  {candidate.name:{max(width, 13)}}  {seed:4}  {said}", flush=True)
    return None


def _print(rows: Sequence[Row]) -> None:
    """Means, half of the range over seeds, differences, and what they say."""
    import numpy as np

    from warpnerf.reports.comparison import FIGURES, in_words, sentences
    from warpnerf.runtime.terminal import table_text

    names = [name for name in FIGURES if any(name in row.values for row in rows)]
    cells = []
    for name in names:
        line, digits = [FIGURES[name].heading], FIGURES[name].digits
        for row in rows:
            values, difference = row.values.get(name), row.differences.get(name)
            text = "" if values is None else f"{np.mean(values):.{digits}f}"
            if values is not None and len(values) > 1:
                text += f" ± {np.ptp(values) / 2.0:.{digits}f}"
            if difference is not None:
                text += f" ({in_words(difference, digits)})"
            line.append(text)
        cells.append(line)
    print(table_text(["", *(row.candidate.name for row in rows)], cells))
    for sentence in sentences(rows):
        print(sentence)
