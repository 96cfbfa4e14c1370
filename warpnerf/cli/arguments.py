"""How the command line reads the functions of its subcommands: types of options, and their help."""

from __future__ import annotations

import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from tyro.constructors import PrimitiveConstructorSpec, PrimitiveTypeInfo

from warpnerf.checks import said
from warpnerf.cli.config_options import field_docs, given_in, given_type, options
from warpnerf.cli.given import SHORT, flag_of
from warpnerf.cli.values import READERS, WANTED
from warpnerf.config import TrainConfig

RunFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
SceneName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Settings = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE [NAME=VALUE ...]")]

Corners = Annotated[
    tuple[float, float, float, float, float, float] | None,
    tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1"),
]


@dataclass(frozen=True)
class Usual:
    """Which fields of a configuration --help shows; --help-all shows all."""

    paths: tuple[str, ...]
    """Their dotted names, in the order in which their options are shown. Options that are no
    fields of it may stand among them, for the order."""


registry = tyro.constructors.ConstructorRegistry()
"""How words become values. None is what an option is that is left out, and no word for it."""


@registry.primitive_rule
def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """A number."""
    of_type = info.type
    if of_type not in (int, float):
        return None

    def read(words: list[str]) -> Any:
        try:
            return READERS[of_type](words[0])
        except ValueError:
            raise ValueError(f"must be {WANTED[of_type]}, not {said(words[0])}.") from None

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
        raise ValueError(f"must be {metavar}, not {said(words[0])}.")

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


def with_help(
    command: Callable[..., int], begin: TrainConfig | None = None, everything: bool = True
) -> Callable[..., int]:
    """A subcommand for tyro, with an option for each field of the dataclasses that it takes.

    Options' help is what its docstring says, or what stands below the fields, without the breaks
    of its lines. Defaults are told where they are values: what an option is that is left out, the
    help says.

    Args:
        command: Its arguments are options, dataclasses of options, or ``Given``: an option for each
            field of a configuration.
        begin: The configuration whose values help shows; None: fast.
        everything: Whether there are options for all of its fields, or only the usual ones, for
            help that is read at a glance.

    Returns:
        A function of all options; it calls the command.
    """
    begin = begin or TrainConfig()
    own = inspect.signature(command).parameters.values()
    types_of = typing.get_type_hints(command, include_extras=True)
    described = _described(inspect.getdoc(command) or "")
    parameters: list[inspect.Parameter] = []
    shown: tuple[str, ...] = ()
    for p in own:
        kind = types_of[p.name]
        if is_dataclass(kind):
            parameters += _of_fields(kind)
        elif usual := _usual(kind):
            shown = () if everything else usual
            parameters += _of_config(p.name, begin, shown)
        else:
            told = tyro.conf.arg(help=described.get(p.name), help_behavior_hint=_default)
            how = p.kind if p.kind is p.POSITIONAL_ONLY else p.KEYWORD_ONLY
            parameters.append(p.replace(annotation=Annotated[kind, told], kind=how))
    if shown:
        first = {path.replace(".", "_"): place for place, path in enumerate(shown)}
        parameters.sort(key=lambda p: first.get(p.name, len(first)))
    signature = inspect.Signature(parameters)

    def called(*args: Any, **kwargs: Any) -> int:
        values = signature.bind(*args, **kwargs).arguments
        arguments: dict[str, Any] = {}
        for p in own:
            kind = types_of[p.name]
            if is_dataclass(kind):
                make: Any = kind
                names = {f.name for f in fields(kind)} & values.keys()
                arguments[p.name] = make(**{name: values[name] for name in names})
            elif p.name in values:
                value = values[p.name]
                arguments[p.name] = given_in(value) if _usual(kind) else value
        placed = [p.name for p in own if p.kind is p.POSITIONAL_ONLY and p.name in arguments]
        first = [arguments.pop(name) for name in placed]
        return command(*first, **arguments)

    functools.update_wrapper(called, command, updated=())
    del called.__wrapped__  # type: ignore[attr-defined]  # else its annotations count
    called.__signature__ = signature  # type: ignore[attr-defined]
    called.__annotations__ = {p.name: p.annotation for p in parameters}
    return called


def _of_fields(kind: Any) -> Iterator[inspect.Parameter]:
    """A parameter for each field of a dataclass."""
    types_of, described = typing.get_type_hints(kind, include_extras=True), field_docs(kind)
    for f in fields(kind):
        told = tyro.conf.arg(help=described.get(f.name), help_behavior_hint=_default)
        default = inspect.Parameter.empty if f.default is MISSING else f.default
        yield inspect.Parameter(
            f.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=Annotated[types_of[f.name], told],
        )


def _of_config(
    name: str, begin: TrainConfig, shown: tuple[str, ...]
) -> Iterator[inspect.Parameter]:
    """One parameter for all fields of a configuration, or one for each of those that are shown."""
    how, all_of_them = inspect.Parameter.KEYWORD_ONLY, options(begin)
    if not shown:
        fields_of, told = given_type(begin), tyro.conf.arg(name="", help="The configuration.")
        yield inspect.Parameter(
            name, how, default=fields_of(), annotation=Annotated[fields_of, told]
        )
        return
    for path in all_of_them.keys() & set(shown):
        flag = flag_of(path).removeprefix("--")
        annotation = all_of_them[path].annotation(flag)
        yield inspect.Parameter(path.replace(".", "_"), how, default=None, annotation=annotation)


def _usual(kind: Any) -> tuple[str, ...]:
    """What help shows of a configuration, where an argument stands for one."""
    marks = getattr(kind, "__metadata__", ())
    return next((mark.paths for mark in marks if isinstance(mark, Usual)), ())


def flags_of(command: Callable[..., int]) -> set[str]:
    """All words that begin an option of a subcommand."""
    flags = {"--help"}
    for p in inspect.signature(with_help(command)).parameters.values():
        marks = p.annotation.__metadata__
        if is_dataclass(typing.get_args(p.annotation)[0]):
            paths = options(TrainConfig())
            flags |= {"--help-all", *SHORT.values(), *(f"--{path}" for path in paths)}
        elif tyro.conf.Positional not in marks:
            flags.add(f"--{p.name}")
            if typing.get_args(p.annotation)[0] is bool:
                flags.add(f"--no-{p.name}")
    return {flag.replace("_", "-") for flag in flags}


def _default(value: str) -> str:
    return f"(default: {value})" if value not in ("", "None", "False") else ""


def _described(docstring: str) -> dict[str, str]:
    """What a docstring's Args say of each argument."""
    section = docstring.partition("\nArgs:\n")[2]
    section = re.split(r"\n(?=\S)", section)[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n      .*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in entries}
