"""An option for each field of a training's configuration, made from the dataclasses.

Names, types, help and defaults are those of the fields, so a new field has an option. Words become
values in ``cli.configured``, because those of a model depend on which one is chosen.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from warpnerf.checks import InputError
from warpnerf.cli.given import SHORT, Given
from warpnerf.cli.values import metavar_of, takes_several, text_of
from warpnerf.config import GridConfig, LossConfig, MarchConfig, TrainConfig
from warpnerf.model.models import MODELS
from warpnerf.model.sampler_kinds import SAMPLER_KINDS
from warpnerf.model.spaces import SPACES
from warpnerf.model.storage_kinds import STORAGE_KINDS
from warpnerf.optim_config import OptimConfig

PARTS: dict[str, type] = {
    "grid": GridConfig,
    "march": MarchConfig,
    "optim": OptimConfig,
    "loss": LossConfig,
}
"""By name, the fields of a configuration that are configurations themselves."""

NAMED: dict[str, Mapping[str, type]] = {
    "model": MODELS,
    "field": STORAGE_KINDS,
    "sampler": SAMPLER_KINDS,
}
"""By name, the fields that are one of several kinds, and these."""

OF_KINDS = "Behind each option: the kinds that have it, and what it is by default for each."

METAVARS = {"grid.box": "X0 Y0 Z0 X1 Y1 Z1|{auto,scene}", "grid.grow_at": "SHARE ...|{auto}"}
METAVARS["optim.accumulate_at"] = METAVARS["grid.grow_at"]
"""By dotted name, where the type does not tell enough."""

BOX = "box"
"""The option that takes six numbers for ``grid.box``, and so no word that follows."""


@dataclass(frozen=True, kw_only=True)
class Option:
    """A field as an option."""

    path: str
    """The field's dotted name."""
    metavar: str
    nargs: Any
    """Words that it takes: a number, or * for any."""
    help: str
    hint: str
    """What help says after that."""

    def annotation(self, name: str | None = None) -> Any:
        """For tyro: words, under its dotted name or another one."""
        words: PrimitiveConstructorSpec[tuple[str, ...]] = PrimitiveConstructorSpec(
            nargs=self.nargs,
            metavar=self.metavar,
            instance_from_str=tuple,
            is_instance=lambda value: True,
            str_from_instance=lambda value: [],
        )
        short = SHORT.get(self.path)
        told = tyro.conf.arg(
            name=name,
            aliases=(short,) if short and name is None else None,
            help=self.help,
            help_behavior_hint=self.hint,
        )
        return Annotated[tuple[str, ...] | None, words, told]


def options(begin: TrainConfig) -> dict[str, Option]:
    """All options, by the dotted names of their fields.

    Args:
        begin: Where a training begins that they are not given for; help shows its values.
    """
    docs = field_docs(TrainConfig)
    kinds = get_type_hints(TrainConfig)
    made: list[Option] = []
    for f in fields(TrainConfig):
        value = getattr(begin, f.name)
        if f.name in PARTS:
            made += _of_part(f.name, PARTS[f.name], value)
        elif f.name in NAMED:
            table = NAMED[f.name]
            choices, hint = "{" + ",".join(table) + "}", f"(default: {value.name})"
            help_text = _for_the_command(docs.get(f.name, ""))
            made.append(Option(path=f.name, metavar=choices, nargs=1, help=help_text, hint=hint))
            made += _of_kinds(f.name, table, value)
        else:
            made.append(_option(f.name, kinds[f.name], docs.get(f.name, ""), _default(value)))
    box = next(option for option in made if option.path == "grid.box")
    told = f"{box.help.partition('. ')[0]}. Six numbers for grid.box."
    corners = Option(path=BOX, metavar="X0 Y0 Z0 X1 Y1 Z1", nargs=6, help=told, hint=box.hint)
    return {option.path: option for option in [*made, corners]}


def _of_part(name: str, part: type, begin: Any) -> Iterator[Option]:
    told, kinds = field_docs(part), get_type_hints(part)
    for f in fields(part):
        hint = _default(getattr(begin, f.name))
        yield _option(f"{name}.{f.name}", kinds[f.name], told.get(f.name, ""), hint)


def _of_kinds(name: str, table: Mapping[str, type], begin: Any) -> Iterator[Option]:
    """Options of all kinds, each once; which one has them, help says."""
    owners: dict[str, dict[str, Field[Any]]] = {}
    for kind_name, kind in table.items():
        for f in fields(kind) if is_dataclass(kind) else ():
            owners.setdefault(f.name, {})[kind_name] = f
    for option, of in owners.items():
        kind = table[next(iter(of))]
        values = {name: f.default for name, f in of.items()}
        if begin.name in of:
            values[begin.name] = getattr(begin, option)
        hint = ", ".join(f"{name}: {text_of(value)}" for name, value in values.items())
        told = field_docs(kind).get(option, "")
        yield _option(f"{name}.{option}", get_type_hints(kind)[option], told, f"({hint})")


def _option(path: str, kind: Any, told: str, hint: str) -> Option:
    metavar = METAVARS.get(path) or metavar_of(kind)
    if path == "grid.contraction":
        metavar = "{" + ",".join(("auto", *SPACES)) + "}"
    nargs = "*" if takes_several(kind) else 1
    return Option(path=path, metavar=metavar, nargs=nargs, help=_for_the_command(told), hint=hint)


def _default(value: Any) -> str:
    return f"(default: {text_of(value)})"


def given_type(begin: TrainConfig) -> type:
    """A dataclass for tyro with a field for each option, in groups by part.

    Args:
        begin: As for ``options``.
    """
    own: list[Any] = []
    groups: dict[str, list[Any]] = {}
    for path, option in options(begin).items():
        part, dot, name = path.rpartition(".")
        if dot:
            groups.setdefault(part, []).append((name, option.annotation(), None))
        else:
            own.append((f"{name}_", option.annotation(name.replace("_", "-")), None))
    for part, members in groups.items():
        group = make_dataclass(f"{part.capitalize()}Options", members)
        told = inspect.getdoc(PARTS[part]) if part in PARTS else OF_KINDS
        group.__doc__ = _for_the_command(told or "")
        own.append((part, group, field(default_factory=group)))
    return make_dataclass("ConfigOptions", own)


def given_in(parsed: Any) -> Given:
    """What tyro found on the command line.

    Args:
        parsed: An instance of what ``given_type`` returns.

    Raises:
        InputError: The box is given twice.
    """
    words: dict[str, tuple[str, ...]] = {}
    for f in fields(parsed):
        value = getattr(parsed, f.name)
        if is_dataclass(value):
            words |= {f"{f.name}.{name}": of for name, of in vars(value).items() if of is not None}
        elif value is not None:
            words[f.name.removesuffix("_")] = value
    if BOX in words:
        if "grid.box" in words:
            raise InputError("--box and --grid.box are the same; keep one of them.")
        words["grid.box"] = words.pop(BOX)
    return words


@cache
def field_docs(kind: type) -> dict[str, str]:
    """What stands below the fields of a dataclass and of those that it derives from."""
    told: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if is_dataclass(base):
            told |= _docs_in(base)
    return told


def _docs_in(kind: type) -> dict[str, str]:
    try:
        tree = _parsed(kind.__module__)
    except (OSError, TypeError, KeyError):  # no source: no help
        return {}
    found = [n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name == kind.__name__]
    body = found[0].body if found else []
    told = {}
    for line, below in pairwise(body):
        match line, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=text)):
                told[name] = " ".join(str(text).split())
    return told


@cache
def _parsed(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(sys.modules[module]))


def _for_the_command(told: str) -> str:
    """A docstring with the names that the command has for things.

    References to code alone are left out, configurations have the names of their options, and
    None is the word for it.
    """
    told = re.sub(r"\s*\((?:see )?``[\w.]+``\)", "", " ".join(told.split()))
    for name, kind in PARTS.items():
        told = told.replace(f"{kind.__name__}.", f"{name}.")
    return re.sub(r"\bNone\b", "none", told).replace("``", "")
