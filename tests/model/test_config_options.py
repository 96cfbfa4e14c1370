"""An option for each field of a configuration, and what it does."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

import warpnerf as wn
from warpnerf.checks import InputError
from warpnerf.cli import train
from warpnerf.cli.config_options import options
from warpnerf.cli.configured import STEPS_OF_TIMED, begun_with, configured
from warpnerf.cli.main import main
from warpnerf.model.models import MODELS, register
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.spaces import SPACES
from warpnerf.model.storage_kinds import STORAGE_KINDS, Hash
from warpnerf.presets import PRESETS

SHIPPED = (
    (MODELS, {"rgb", "sh", "deferred", "per_sample"}),
    (STORAGE_KINDS, {"dense", "vm", "hash", "auto"}),
    (SPACES, {"none", "linf", "l2", "ndc"}),
)
"""Kinds of the package itself."""


@pytest.fixture(autouse=True)
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the kinds that other tests have registered."""
    for table, names in SHIPPED:
        for name in set(table) - names:
            monkeypatch.delitem(table, name)  # type: ignore[arg-type]


CLI = sorted((Path(train.__file__).parent).glob("*.py"))

GIVEN: dict[str, tuple[str, Any]] = {
    "steps": ("3e2", 300),
    "time_limit": ("5", 5.0),
    "scaling": ("quadratic", "quadratic"),
    "content_distance": ("1.5", 1.5),
    "coarse_steps": ("60", 60),
    "jacobian": ("density", "density"),
    "rays_per_step": ("512", 512),
    "background": ("0.1 0.2 0.3", (0.1, 0.2, 0.3)),
    "appearance": ("affine", "affine"),
    "occupancy_every": ("7", 7),
    "skip_empty_rays": ("false", False),
    "average_pixels": ("false", False),
    "alpha_min": ("0.01", 0.01),
    "settle_at": ("none", None),
    "seed": ("4", 4),
    "threads": ("1", 1),
    "device": ("cuda:1", "cuda:1"),
    "checkpoint_every": ("9", 9.0),
    "field": ("dense", wn.TrainConfig().field),
    "sampler": ("resampled", Resampled()),
    "model": ("sh", wn.SphericalHarmonics()),
    "grid.voxels": ("2000000", 2_000_000),
    "grid.grow_at": ("0.2 0.5", (0.2, 0.5)),
    "grid.shift_at_growth": ("1", 1.0),
    "grid.alpha_init": ("0.01", 0.01),
    "grid.contraction": ("l2", "l2"),
    "grid.planes": ("32", 32),
    "grid.box": ("-1 -1 -1 1 1 1", (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)),
    "grid.border": ("0.5", 0.5),
    "march.step_voxels": ("0.5", 0.5),
    "march.near": ("0.1", 0.1),
    "march.far": ("9", 9.0),
    "march.growth": ("0.01", 0.01),
    "march.transmittance_min": ("0.01", 0.01),
    "march.jitter": ("false", False),
    "optim.learning_rate_density": ("0.1", 0.1),
    "optim.learning_rate_rgb": ("0.1", 0.1),
    "optim.decay": ("0.03", 0.03),
    "optim.restart_at_growth": ("true", True),
    "optim.beta1": ("0.5", 0.5),
    "optim.beta2": ("0.9", 0.9),
    "optim.epsilon": ("1e-6", 1e-6),
    "optim.tv_density": ("1e-8", 1e-8),
    "optim.tv_rgb": ("1e-8", 1e-8),
    "optim.tv_until": ("0.5", 0.5),
    "optim.tv_every": ("2", 2),
    "optim.near_decay": ("0.1", 0.1),
    "optim.accumulate_at": ("none", ()),
    "loss.photometric": ("huber", "huber"),
    "loss.huber_delta": ("0.2", 0.2),
    "loss.distortion": ("0.02", 0.02),
    "loss.distortion_rise": ("10", 10.0),
    "loss.entropy": ("0", 0.0),
    "loss.opacity": ("0.5", 0.5),
    "loss.sample_colour": ("0.1", 0.1),
    "loss.near_clip": ("1", 1.0),
    "loss.near_clip_distance": ("0.2", 0.2),
    "model.degree": ("1", 1),
    "model.learning_rate_sh": ("0.1", 0.1),
    "model.frequencies": ("2", 2),
    "model.width": ("32", 32),
    "model.hidden_layers": ("1", 1),
    "model.learning_rate_features": ("0.1", 0.1),
    "model.learning_rate_mlp": ("0.1", 0.1),
    "model.specular": ("8", 8),
    "model.features": ("6", 6),
    "model.residual": ("false", False),
    "model.threshold": ("0.01", 0.01),
    "field.density": ("20", 20),
    "field.appearance": ("28", 28),
    "field.sparsity": ("1e-4", 1e-4),
    "field.levels": ("8", 8),
    "field.features": ("2", 2),
    "field.coarsest": ("16", 16),
    "field.finest": ("512", 512),
    "field.table": ("32768", 32768),
    "field.hidden": ("32", 32),
    "field.learning_rate": ("0.02", 0.02),
    "field.learning_rate_decoder": ("0.02", 0.02),
    "field.epsilon": ("1e-8", 1e-8),
    "sampler.samples": ("48", 48),
    "sampler.bins": ("128", 128),
    "sampler.voxels": ("5000", 5000),
    "sampler.learning_rate_proposal": ("0.1", 0.1),
    "sampler.anneal_until": ("0.2", 0.2),
    "sampler.update_every": ("2", 2),
}
"""By dotted name, other words than those by default, and their value."""

NEAR_CLIP = {"loss.near_clip": ("0.5",), "loss.near_clip_distance": ("0.1",)}

NEEDED = {
    "loss.huber_delta": {"loss.photometric": ("huber",)},
    "loss.near_clip": NEAR_CLIP,
    "loss.near_clip_distance": NEAR_CLIP,
    "loss.sample_colour": {"model": ("rgb",)},
    **{f"model.{name}": {"model": ("sh",)} for name in ("degree", "learning_rate_sh")},
    **{
        f"model.{name}": {"model": ("per_sample",)}
        for name in ("features", "residual", "threshold")
    },
    **{f"field.{f.name}": {"field": ("hash",)} for f in fields(Hash)},
    **{f"field.{name}": {"field": ("vm",)} for name in ("density", "appearance", "sparsity")},
    **{f"sampler.{f.name}": {"sampler": ("resampled",)} for f in fields(Resampled)},
}
"""Without which a field does nothing, or is none."""


def paths_of(config: Any, prefix: str = "") -> Iterator[str]:
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value) and f.name not in ("model", "field", "sampler"):
            yield from paths_of(value, f"{f.name}.")
        else:
            yield prefix + f.name


def value_of(config: Any, path: str) -> Any:
    for name in path.split("."):
        config = getattr(config, name)
    return config


def words(**given: str) -> dict[str, tuple[str, ...]]:
    return {path.replace("__", "."): tuple(text.split()) for path, text in given.items()}


def test_every_field_has_an_option() -> None:
    own = set(paths_of(wn.TrainConfig()))
    of_kinds = {f"model.{f.name}" for model in MODELS.values() for f in fields(model)}
    of_kinds |= {f"field.{f.name}" for kind in STORAGE_KINDS.values() for f in fields(kind)}  # type: ignore[arg-type]
    of_kinds |= {f"sampler.{f.name}" for f in fields(Resampled)}
    assert options(wn.TrainConfig()).keys() == own | of_kinds | {"box"}
    assert GIVEN.keys() == own | of_kinds


@pytest.mark.parametrize("path", GIVEN)
def test_an_option_changes_its_field_and_nothing_else(path: str) -> None:
    text, value = GIVEN[path]
    others = NEEDED.get(path, {})
    begin = configured(wn.TrainConfig(), others)
    changed = configured(wn.TrainConfig(), {**others, path: tuple(text.split())})
    assert value_of(changed, path) == value
    assert type(value_of(changed, path)) is type(value)
    assert path == "field" or value_of(begin, path) != value
    part, dot, name = path.partition(".")
    if dot:
        kept = replace(getattr(changed, part), **{name: value_of(begin, path)})
        assert replace(changed, **{part: kept}) == begin
    else:
        assert replace(changed, **{path: getattr(begin, path)}) == begin


def test_words_of_fields_that_may_be_several_things() -> None:
    begin = replace(PRESETS["quality"], march=wn.MarchConfig(far=9.0))
    given = words(time_limit="none", march__far="none", grid__box="scene", background="white")
    changed = configured(begin, given)
    assert (changed.time_limit, changed.march.far) == (None, None)
    assert (changed.grid.box, changed.background) == ("scene", "white")
    assert configured(begin, words(grid__grow_at="auto")).grid.grow_at == "auto"


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (words(grid__voxels="many"), "--voxels must be auto or a whole number, not 'many'."),
        (words(optim__decay="slow"), "--optim.decay must be a number, not 'slow'."),
        (words(march__jitter="maybe"), "--march.jitter must be true or false, not 'maybe'."),
        (words(time_limit="long"), "--time-limit must be a number or none, not 'long'."),
        (words(grid__box="here"), "--grid.box must be auto or scene or numbers, not 'here'."),
        (words(grid__box="1 2"), "grid.box must be auto, scene, or six numbers, x y z of"),
        (words(background="1 2"), "random or 3 numbers, not '1 2'."),
        (words(optim__decay="-1"), "optim.decay must be a finite number above 0, not -1.0."),
        (words(scaling="cubic"), "scaling must be one of none, quadratic, clamped, not 'cubic'."),
        (words(field="rows"), "field must be one of dense, vm, hash, auto, not 'rows'."),
        (words(model="nerf"), "--model must be one of rgb, sh, deferred, per_sample, not 'nerf'."),
        (words(model__degree="1"), "--model.degree is no option of the model deferred; it has "),
        (words(grid__contraction="l2", grid__planes="32"), "leave planes out"),
        (words(loss__huber_delta="0.2"), "leave huber_delta out"),
    ],
)
def test_what_does_not_fit_is_refused(given: dict[str, tuple[str, ...]], says: str) -> None:
    with pytest.raises(InputError) as error:
        configured(wn.TrainConfig(), given)
    assert says in str(error.value)


def test_both_spellings_of_models_and_losses_are_one() -> None:
    begin = wn.TrainConfig()
    dotted = configured(begin, words(model__width="32", loss__entropy="0.2"))
    assert configured(begin, {}, ["width=32"], ["entropy=0.2"]) == dotted
    assert configured(begin, words(model__width="32"), (), ["entropy=0.2"]) == dotted
    for given, model, loss in (
        (words(model__width="32"), ["width=48"], ()),
        (words(loss__entropy="1"), (), ["entropy=2"]),
    ):
        with pytest.raises(InputError, match=r"is given twice; keep one of them"):
            configured(begin, given, model, loss)


def test_what_a_preset_has_and_would_do_nothing_is_left_out() -> None:
    dvgo, llff, unbounded = (PRESETS[name] for name in ("dvgo", "dvgo-llff", "dvgo-unbounded"))
    fixed = configured(dvgo, words(grid__grow_at="none"))
    assert (fixed.grid.shift_at_growth, fixed.optim.restart_at_growth) == (0.0, False)
    contracted = configured(llff, words(grid__contraction="linf"))
    assert contracted.grid.planes == wn.GridConfig().planes != llff.grid.planes
    bounded = configured(unbounded, words(grid__contraction="none"))
    assert (bounded.grid.border, bounded.march.growth) == ("auto", "auto")
    assert configured(unbounded, words(grid__contraction="l2")).grid.border == 0.2
    huber = wn.LossConfig(photometric="huber", huber_delta=0.3, near_clip=1, near_clip_distance=2)
    plain = configured(
        replace(dvgo, loss=huber), words(loss__photometric="squared", loss__near_clip="0")
    )
    assert plain.loss == wn.LossConfig()
    with pytest.raises(InputError, match="leave shift_at_growth out"):  # as it is requested
        configured(dvgo, words(grid__grow_at="none", grid__shift_at_growth="1"))


def test_of_steps_and_time_the_one_that_is_given_ends_a_training() -> None:
    quality = PRESETS["quality"]
    for text, ends in (
        ({}, (quality.steps, quality.time_limit)),
        ({"steps": "7"}, (7, None)),
        ({"time_limit": "7"}, (STEPS_OF_TIMED, 7.0)),
        ({"steps": "7", "time_limit": "8"}, (7, 8.0)),
        ({"time_limit": "none"}, (quality.steps, None)),
    ):
        given = words(**text)
        config = begun_with(configured(quality, given), given)
        assert (config.steps, config.time_limit) == ends


class Trained(Exception):
    """In place of a training: what would be trained."""


def trained(monkeypatch: pytest.MonkeyPatch, *line: str | Path) -> tuple[Any, ...]:
    """What `warpnerf train` begins: scene, output, downscale, masks, images, configuration, and
    whether it replaces a run, and its page."""
    begun: list[tuple[Any, ...]] = []

    def begin(source: str, output: Path, options: Any, config: wn.TrainConfig, _: Any) -> int:
        downscale = 1 if options.downscale is None else options.downscale
        scene = source, output, downscale, options.masks, options.images
        begun.append((*scene, config, options.overwrite, options.page))
        return 0

    with monkeypatch.context() as patch:
        patch.setattr(train, "_begin", begin)
        assert main(["train", *map(str, line)]) == 0
    return begun[0]


def test_the_command_takes_dotted_names_and_short_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    dotted = (
        "--optim.decay 0.03 --grid.voxels 2e6 --loss.distortion 0.02 --march.near 0.1 "
        "--model.width 32 --field dense --grid.border=0.5 --grid.contraction l2 "
        "--march.jitter false --grid.grow-at 0.2 0.5 --optim.tv_rgb 0 "
        "--grid.box -1 -1 -1 1 1 1 --output out"
    )
    *_, config, _, _ = trained(monkeypatch, "builtin:room", *dotted.split())
    assert config == wn.TrainConfig(
        grid=wn.GridConfig(
            voxels=2_000_000,
            border=0.5,
            contraction="l2",
            grow_at=(0.2, 0.5),
            box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0),
        ),
        march=wn.MarchConfig(near=0.1, jitter=False),
        model=wn.Deferred(width=32),
        optim=wn.OptimConfig(decay=0.03, tv_rgb=0.0),
        loss=replace(PRESETS["fast"].loss, distortion=0.02),
    )
    short = (
        "--voxels=2e6 --border 0.5 --contraction l2 --near 0.1 --model-options width=32 "
        "--loss distortion=0.02 --optim.decay 0.03 --march.jitter false --grid.grow-at 0.2 0.5 "
        "--optim.tv-rgb 0 --output out --box -1 -1 -1 1 1 1"
    )
    *_, as_short, _, _ = trained(monkeypatch, *short.split(), "builtin:room")
    assert as_short == config


def test_a_model_that_a_program_registers_has_options(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Other(wn.Rgb):
        name: ClassVar[str] = "other"
        knobs: int = 3

    try:
        register(Other)
        line = ("builtin:room", "--output", "out", "--model", "other", "--model.knobs", "4")
        assert trained(monkeypatch, *line)[5].model == Other(knobs=4)
    finally:
        del MODELS["other"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("train --stesp 3", "train has no option --stesp, the nearest is --steps; warpnerf train"),
        ("train --lr 1", "train has no option --lr, here it is --optim.learning-rate-density; "),
        ("train --iters=9", "train has no option --iters, here it is --steps; "),
        ("train --data x", "train has no option --data: its folder is a word without one, "),
        ("eval --gpu 0", "eval has no option --gpu, here it is --device; "),
        ("eval --data x", "eval has no option --data, here it is --scene; "),
        (f"train x --steps {'9' * 400}", "steps must be below 2^63, "),
        ("train --decay 1", "train has no option --decay, the nearest is --optim.decay; "),
        ("train --grid.voxel=1", "--grid.voxel, the nearest is --grid.voxels; "),
        ("train --qqq", "train has no option --qqq; warpnerf train --help-all lists all."),
        ("render x --seconds 1 --sise 2 2", "render has no option --sise, the nearest is --size; "),
        ("inspect x --output y --optim.dekay 1", "the nearest is --optim.decay; "),
        ("trian x", "there is no command trian, the nearest is train; warpnerf --help lists all."),
        ("train x --box 0 0 0 1 1 1 --grid.box auto", "--box and --grid.box are the same"),
        ("train x --optim.decay None", "--optim.decay cannot be None; leave it out"),
        ("train x --config --steps 3", "--config has no value, as --steps may be an option"),
        ("train --grid.box auto x", "--grid.box must be auto or scene or numbers, not 'auto x'."),
    ],
)
def test_a_line_that_is_none_gets_a_sentence(
    line: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith("warpnerf: error: ") and len(err.splitlines()) == 1
    assert says in err


def helped(capsys: pytest.CaptureFixture[str], *line: str) -> str:
    with pytest.raises(SystemExit) as stop:
        main(list(line))
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_help_ends_in_a_terminal_of_one_column(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "1")
    assert "warpnerf train" in helped(capsys, "train", "--help")


def test_help_is_read_at_a_glance(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for command in ("train", "inspect"):
        short, full = helped(capsys, command, "--help"), helped(capsys, command, "--help-all")
        assert max(map(len, (short + full).splitlines())) <= 80
        assert "--optim.tv-every" not in short and "--help-all shows" in short
        for path in GIVEN:
            assert f"--{path.replace('_', '-')} " in full
        assert "``" not in full and "None" not in full and "GridConfig" not in full
    lines = helped(capsys, "train", "--help").splitlines()
    shown = [line.split()[0] for line in lines if line.startswith("  --")]
    first = "output preset steps time-limit voxels downscale masks split eval-views model resume"
    assert [flag.strip("-,") for flag in shown[:11]] == first.split()


def test_help_shows_the_values_of_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    for line, value in (
        (("--help",), "4000"),
        (("--preset", "dvgo", "--help"), "20000"),
        (("--help", "--preset=dvgo-llff"), "30000"),
    ):
        text = " ".join(helped(capsys, "train", *line).split())
        assert f"see optim.accumulate_at. (default: {value})" in text
    text = " ".join(helped(capsys, "train", "--help-all", "--preset", "dvgo").split())
    assert "(deferred: 64, per_sample: 128)" in text


def test_help_is_what_stands_below_the_fields(capsys: pytest.CaptureFixture[str]) -> None:
    text = " ".join(helped(capsys, "train", "--help-all").split())
    assert "--optim.decay FLOAT What is left of the learning rates at the end of training." in text
    assert "--model.specular INT Features of a node besides its diffuse colour, 1 to 28." in text
    text = " ".join(helped(capsys, "pose", "--help").split())
    assert "Longer side, pixels, to which photographs are reduced to look for features." in text


@pytest.mark.parametrize("path", CLI, ids=lambda path: path.stem)
def test_functions_of_the_command_have_few_arguments(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            of = node.args
            assert len([*of.posonlyargs, *of.args, *of.kwonlyargs]) <= 10, node.name
