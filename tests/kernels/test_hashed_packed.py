"""A hash in packs of sixteen samples: against the plain form, and with several workers."""

from dataclasses import dataclass, fields, replace
from typing import Any

import pytest

from tests.support.field_passes import (
    CASES,
    MODELS,
    N_RAYS,
    Gradient,
    fill,
    gradient_of,
    require_flags_cover,
    require_same,
    require_workers_agree,
    trainer_of,
)
from tests.support.unwritten import leave_sinks_unwritten
from warpnerf.fields.hashed import Hashed
from warpnerf.model.interface import Load, Model
from warpnerf.model.storage_kinds import Hash

SMALL = Hash(levels=6, coarsest=4, finest=40, table=512)
"""Two levels have an entry for each node; rows of the others are hashed."""


@dataclass(frozen=True, kw_only=True)
class Plain(Hash):
    """The same without its vector form."""

    def encoding(self, load: Load, model: Model) -> Any:
        return super().encoding(load, model).replace()


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_sinks_unwritten(monkeypatch)


def gradient(
    model: Model,
    kind: Hash = SMALL,
    threads: int = 1,
    contraction: str = "none",
    n_rays: int = N_RAYS,
    active: int | None = None,
    is_plain: bool = False,
) -> Gradient:
    trainer = trainer_of(model, kind, threads, contraction, n_rays)
    storage = trainer.storage
    assert isinstance(storage, Hashed) and storage.n_active == kind.levels
    fill(storage.values)
    if active is not None:
        wider = kind.finest / kind.resolutions[active - 1] / storage.lattice.voxel_size.min()
        storage = replace(storage, density_scale=float(wider))
        assert storage.n_active == active
    read_as = Plain(**{f.name: getattr(kind, f.name) for f in fields(kind)}) if is_plain else kind
    return gradient_of(trainer, replace(storage, kind=read_as))


@pytest.mark.ci
@pytest.mark.parametrize(("name", "contraction"), CASES)
def test_packs_against_the_plain_form(name: str, contraction: str) -> None:
    model = MODELS[name]
    packed, plain = (gradient(model, SMALL, 1, contraction, is_plain=p) for p in (False, True))
    require_same(packed, plain, contraction)


@pytest.mark.parametrize(
    ("name", "features"),
    [
        ("deferred", 2),
        ("per_sample", 8),
        pytest.param("deferred", 8, marks=pytest.mark.slow),
        pytest.param("per_sample", 2, marks=pytest.mark.slow),
    ],
)
def test_other_entries(name: str, features: int) -> None:
    """And a number of inputs of the decoder that fills no vectors."""
    kind = replace(SMALL, features=features, levels=5)
    require_same(*(gradient(MODELS[name], kind, is_plain=p) for p in (False, True)))


@pytest.mark.parametrize(
    ("name", "hidden", "features"),
    [
        ("deferred", 16, 4),
        ("many", 48, 2),
        pytest.param("deferred", 48, 2, marks=pytest.mark.slow),
        pytest.param("many", 16, 4, marks=pytest.mark.slow),
    ],
)
def test_a_hidden_layer(name: str, hidden: int, features: int) -> None:
    kind = replace(SMALL, features=features, hidden=hidden)
    packed, plain = (gradient(MODELS[name], kind, is_plain=p) for p in (False, True))
    assert packed["hidden"].any() and packed["decoder"].any()
    require_same(packed, plain)


@pytest.mark.parametrize("hidden", [0, 16])
def test_levels_that_are_not_active(hidden: int) -> None:
    kind = replace(SMALL, hidden=hidden)
    packed, plain = (
        gradient(MODELS["deferred"], kind, active=3, is_plain=p) for p in (False, True)
    )
    first = packed["hidden" if hidden else "decoder"].reshape(24, -1)
    assert (first[12:] == 0.0).all() and first[:12].any()
    require_same(packed, plain)


@pytest.mark.parametrize("threads", [2, 3, 5, 8, 20])
def test_one_worker_against_more(threads: int) -> None:
    """Also where there are more workers than levels."""
    require_workers_agree(lambda n: gradient(MODELS["deferred"], threads=n), threads)


@pytest.mark.parametrize("threads", [2, 8])
def test_one_worker_against_more_with_a_hidden_layer(threads: int) -> None:
    kind = replace(SMALL, hidden=16)
    require_workers_agree(lambda n: gradient(MODELS["deferred"], kind, threads=n), threads)


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_flags_cover_all_that_is_not_0(threads: int) -> None:
    require_flags_cover(gradient(MODELS["deferred"], threads=threads, n_rays=4), "values")
