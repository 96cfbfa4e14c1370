"""Factors in packs of sixteen samples: against the plain form, and with several workers."""

from dataclasses import dataclass, replace
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
from warpnerf.fields.factors import Factors
from warpnerf.model.interface import Load, Model
from warpnerf.model.storage_kinds import Vm

VM = Vm()


@dataclass(frozen=True, kw_only=True)
class Plain(Vm):
    """The same without its vector form."""

    def encoding(self, load: Load, model: Model) -> Any:
        return super().encoding(load, model).replace()


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_sinks_unwritten(monkeypatch)


def gradient(
    model: Model,
    kind: Vm = VM,
    threads: int = 1,
    contraction: str = "none",
    n_rays: int = N_RAYS,
) -> Gradient:
    stored = Vm(density=kind.density, appearance=kind.appearance)
    trainer = trainer_of(model, stored, threads, contraction, n_rays)
    storage = trainer.storage
    assert isinstance(storage, Factors)
    fill(storage.planes, storage.lines)
    return gradient_of(trainer, replace(storage, kind=kind))


@pytest.mark.ci
@pytest.mark.parametrize(("name", "contraction"), CASES)
def test_packs_against_the_plain_form(name: str, contraction: str) -> None:
    packed, plain = (gradient(MODELS[name], k, 1, contraction) for k in (VM, Plain()))
    require_same(packed, plain, contraction)


@pytest.mark.parametrize("name", ["deferred", pytest.param("per_sample", marks=pytest.mark.slow)])
def test_wide_entries(name: str) -> None:
    numbers = {"density": 8, "appearance": 24}
    require_same(*(gradient(MODELS[name], k(**numbers)) for k in (Vm, Plain)))


@pytest.mark.parametrize("threads", [2, 3, 5, 30])
def test_one_worker_against_more(threads: int) -> None:
    """Also where there are more workers than rows of a plane."""
    require_workers_agree(lambda n: gradient(MODELS["deferred"], threads=n), threads)


@pytest.mark.parametrize("threads", [1, 2])
def test_flags_cover_all_that_is_not_0(threads: int) -> None:
    require_flags_cover(gradient(MODELS["deferred"], threads=threads, n_rays=4), "planes")
