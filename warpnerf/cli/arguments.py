"""How the command line reads the functions of its subcommands: types of options, and their help."""

from __future__ import annotations

import functools
import inspect
import re
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from tyro.constructors import PrimitiveConstructorSpec, PrimitiveTypeInfo

RunFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
SceneName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Settings = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE [NAME=VALUE ...]")]

NUMBERS = {int: "a whole number", float: "a number"}

registry = tyro.constructors.ConstructorRegistry()
"""How words become values. None is what an option is that is left out, and no word for it."""


@registry.primitive_rule
def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """A number."""
    of_type, what = info.type, NUMBERS.get(info.type)
    if what is None:
        return None

    def read(words: list[str]) -> Any:
        try:
            return of_type(words[0])
        except ValueError:
            raise ValueError(f"must be {what}, not {words[0]!r}.") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=of_type.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, (int, of_type)),
        str_from_instance=lambda value: [str(value)],
    )


@registry.primitive_rule
def alternatives(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """One of several types, or None: the first that takes the words."""
    if typing.get_origin(info.type) not in (Union, types.UnionType):
        return None
    specs = []
    for member in typing.get_args(info.type):
        if member is type(None):
            continue
        spec = registry.get_primitive_spec(PrimitiveTypeInfo.make(member, info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return None
        specs.append(spec)
    if len(specs) > 1 and any(spec.nargs != 1 for spec in specs):
        return None
    metavar = "|".join(spec.metavar for spec in specs)

    def read(words: list[str]) -> Any:
        for spec in specs:
            if spec.choices is not None and words[0] not in spec.choices:
                continue
            try:
                return spec.instance_from_str(words)
            except ValueError:
                if len(specs) == 1:
                    raise
        raise ValueError(f"must be {metavar}, not {words[0]!r}.")

    def written(value: Any) -> list[str]:
        fitting = [spec for spec in specs if value is not None and spec.is_instance(value)]
        return fitting[0].str_from_instance(value) if fitting else [str(value)]

    return PrimitiveConstructorSpec(
        nargs=specs[0].nargs,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or any(s.is_instance(value) for s in specs),
        str_from_instance=written,
        choices=specs[0].choices if len(specs) == 1 else None,
    )


def with_help(command: Callable[..., int]) -> Callable[..., int]:
    """A subcommand whose options' help is what its docstring says, without the breaks of its lines.

    Defaults are told where they are values: what an option is that is left out, the docstring says.
    """
    described = _described(inspect.getdoc(command) or "")
    types_of = typing.get_type_hints(command, include_extras=True)
    signature = inspect.signature(command)

    def annotated(name: str) -> Any:
        told = tyro.conf.arg(help=described.get(name), help_behavior_hint=_default)
        return Annotated[types_of[name], told]

    def called(*args: Any, **kwargs: Any) -> int:
        return command(*args, **kwargs)

    parameters = [p.replace(annotation=annotated(p.name)) for p in signature.parameters.values()]
    functools.update_wrapper(called, command, updated=())
    del called.__wrapped__  # type: ignore[attr-defined]  # else its annotations count
    called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {p.name: p.annotation for p in parameters}
    return called


def _default(value: str) -> str:
    return f"(default: {value})" if value not in ("", "None", "False") else ""


def _described(docstring: str) -> dict[str, str]:
    """What a docstring's Args say of each argument."""
    section = docstring.partition("\nArgs:\n")[2]
    section = re.split(r"\n(?=\S)", section)[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n      .*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in entries}
