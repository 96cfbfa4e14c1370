"""The command: reads the line, calls the package, prints."""

from __future__ import annotations

import errno
import functools
import io
import logging
import os
import re
import shlex
import shutil
import sys
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro

from warpnerf import __version__
from warpnerf.checks import InputError, way_out
from warpnerf.cli.arguments import flags_of, registry, with_help
from warpnerf.cli.blocks import blocks_command, train_blocks_command
from warpnerf.cli.compare import compare_command
from warpnerf.cli.demo import demo_command
from warpnerf.cli.evaluate import eval_command
from warpnerf.cli.export import export_command
from warpnerf.cli.foreign import SCENE, meant_by
from warpnerf.cli.given import near_to
from warpnerf.cli.inspect import inspect_command
from warpnerf.cli.machine import FAILED, check_command, warmup_command
from warpnerf.cli.pose import pose_command
from warpnerf.cli.refused import read_words
from warpnerf.cli.render import render_command
from warpnerf.cli.runs import runs_command
from warpnerf.cli.train import train_command
from warpnerf.cli.view import view_command
from warpnerf.presets import PRESETS
from warpnerf.runtime import process
from warpnerf.runtime.signals import Stopped, raise_when_asked
from warpnerf.runtime.terminal import UntilClosed

BAD_INPUT = 2

Call = Callable[[], int]
"""A subcommand with its options."""

COMMANDS: dict[str, Callable[..., int]] = {
    "demo": demo_command,
    "compare": compare_command,
    "inspect": inspect_command,
    "pose": pose_command,
    "train": train_command,
    "blocks": blocks_command,
    "train-blocks": train_blocks_command,
    "eval": eval_command,
    "render": render_command,
    "export": export_command,
    "view": view_command,
    "runs": runs_command,
    "check": check_command,
    "warmup": warmup_command,
}

PATHS = ("--output", "--resume", "--config", "--scene", "--masks", "--json", "--plots")
"""Options whose value may be any name."""

TAKES_A_SCENE = ("train", "inspect", "pose", "compare", "blocks")
"""Subcommands whose first word is a folder of a scene, or of photographs."""

NARROWEST = 24
"""Columns of a terminal; in fewer, laying out help would not end."""

HELP_ALL = "--help-all"
"""Lists all options of a subcommand, --help those that are used often."""

NO_NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.EISDIR, errno.ENOTDIR)
"""What the system says of names that cannot be those of files."""

LONGEST = 1200
"""Characters of a refusal."""

NOT_LOADED = re.compile("load the shared library|map segment|shared object|many open files")
"""What Warp and Python say where a library cannot be loaded."""

OUT_OF_MEMORY = re.compile("failed to allocate|can't start new thread", re.IGNORECASE)
"""What Warp and the standard library say in a RuntimeError where a MemoryError is meant."""


class _Printer(logging.Handler):
    """Prints what modules below have to say."""

    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), flush=True)


def _meant(option: str, word: str) -> str:
    """A word of the command line, looked at.

    Raises:
        InputError: It is empty, or None, by which Python's default would be meant.
    """
    if not word:
        raise InputError(
            "one of the arguments is empty, which variables that are not set are; give a value."
        )
    if option.startswith("--") and word == "None":
        raise InputError(f"{option} cannot be None; leave it out for what it is by default.")
    if option in PATHS and word.startswith("-") and word != "-":
        raise InputError(
            f"{option} has no value, as {word} may be an option: give a path, and one that begins "
            f"with - as {option}=./{word}."
        )
    joined = re.fullmatch(r"(--[\w.-]+)=(.*)", word)
    if joined:
        return f"{joined[1]}={_meant(joined[1], joined[2])}"
    return word


def _require_known(name: str, words: Sequence[str]) -> None:
    """Raise InputError where a word begins an option that a subcommand has not."""
    flags = flags_of(COMMANDS[name])
    for word in words:
        if word == "--":
            return
        flag = word.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in flags:
            known = {*flags, SCENE} if name in TAKES_A_SCENE else flags
            given, ours = word.partition("=")[0], meant_by(flag, known)
            if ours == SCENE:
                raise InputError(
                    f"{name} has no option {given}: its folder is a word without one, as in "
                    f"warpnerf {name} FOLDER."
                )
            hint = near_to(flag, sorted(flags)) if ours is None else f", here it is {ours}"
            raise InputError(
                f"{name} has no option {given}{hint}; warpnerf {name} "
                f"--help{'-all' if HELP_ALL in flags else ''} lists all."
            )


def call_of(words: list[str]) -> Call:
    """Read a line. Only its subcommand is looked at: the others are named.

    Args:
        words: After ``warpnerf``.

    Returns:
        The subcommand with its options, which is not called yet.

    Raises:
        InputError: The line cannot be read.
    """
    name = words[0] if words and not words[0].startswith("-") else None
    if name is not None and name not in COMMANDS:
        raise InputError(
            f"there is no command {name}{near_to(name, COMMANDS)}; warpnerf --help lists all."
        )
    everything = HELP_ALL in words or not {"--help", "-h"} & {*words}
    split = [part for word in words for part in word.split("=", maxsplit=1)]
    begin = PRESETS.get(dict(pairwise(split)).get("--preset", "fast"))
    if name == "train-blocks" and "--" in words:  # what follows is for another command
        at = words.index("--")
        words = [*words[:at], f"--train-options={shlex.join(words[at + 1 :])}"]
    if name is not None:
        _require_known(name, words[1:])
        words = ["--help" if word == HELP_ALL else word for word in words]

    def shown(command: Callable[..., int]) -> Callable[..., Call]:
        if command is COMMANDS.get(name or ""):
            return _later(with_help(command, begin, everything))

        def named() -> Call:
            raise AssertionError("it is only listed")

        named.__doc__ = (command.__doc__ or "").partition("\n\n")[0]
        return named

    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    with registry:
        commands = {name: shown(command) for name, command in COMMANDS.items()}
        call: Call = read_words(
            lambda: tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="warpnerf",
                description="Voxel-grid radiance fields from photographs, with fewer floaters.",
                args=words,
            ),
            name,
            shows_help=bool({"--help", "-h"} & {*words}),
        )
    return call


def _later(command: Callable[..., int]) -> Callable[..., Call]:
    """A subcommand that is called once all words are read."""

    @functools.wraps(command)
    def bound(*arguments: Any, **options: Any) -> Call:
        return functools.partial(command, *arguments, **options)

    bound.__annotations__ = {**command.__annotations__, "return": Call}
    return bound


def _one_line(sentence: str) -> str:
    """A sentence without characters that would steer a terminal, and without its middle where words
    of the command line make it long."""
    if len(sentence) > LONGEST:
        sentence = f"{sentence[: LONGEST - 400]} ... {sentence[-300:]}"
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in sentence
    )


def _not_loaded(error: Exception) -> str:
    """That a library cannot be loaded, as a sentence."""
    why = " ".join(str(error).split())[:200].rstrip(".")
    return (
        f"a library cannot be loaded ({why}); give the process more memory and more open files "
        "(ulimit -v, ulimit -n), or install warpnerf again."
    )


def _said(error: Exception) -> str:
    """An error of the system as a sentence."""
    if isinstance(error, OSError) and error.strerror:
        # Files that we write are named where they are opened: what has no name is a stream.
        place = "standard output" if error.filename is None else error.filename
        return f"{place}: {error.strerror}; {way_out(error)}."
    return str(error)


def main(arguments: list[str] | None = None) -> int:
    """Run the command.

    Returns:
        0; 2 for bad input; 1 where training failed; 129, 130, 143 after SIGHUP, Ctrl-C, SIGTERM.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"warpnerf {__version__}")
        return 0
    raise_when_asked()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed before Python began
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115
    process.make_own()
    warnings.filterwarnings("ignore", module="PIL")  # what matters in an image is refused
    logging.getLogger("PIL").setLevel(logging.CRITICAL)
    own = logging.getLogger("warpnerf")
    own.handlers, own.propagate = [_Printer()], False
    own.setLevel(logging.INFO)
    warnings.formatwarning = lambda message, *_: f"warpnerf: warning: {message}.\n"
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may hold anything
        sys.stdout = UntilClosed(sys.stdout)
    try:
        arguments = [_meant(arguments[at - 1], word) for at, word in enumerate(arguments)]
        return call_of(arguments)()
    except InputError as error:
        print(f"warpnerf: error: {_one_line(str(error))}", file=sys.stderr)
        return BAD_INPUT
    except (MemoryError, RuntimeError, ImportError) as error:
        if NOT_LOADED.search(str(error)):
            print(f"warpnerf: error: {_not_loaded(error)}", file=sys.stderr)
            return BAD_INPUT
        if not isinstance(error, MemoryError) and not OUT_OF_MEMORY.search(str(error)):
            raise
        why = f" ({error})" if str(error) else ""
        print(
            f"warpnerf: error: out of memory{why}; use fewer --voxels, or a larger --downscale.",
            file=sys.stderr,
        )
        return BAD_INPUT
    except (OSError, FloatingPointError) as error:
        print(f"warpnerf: error: {_one_line(_said(error))}", file=sys.stderr)
        return BAD_INPUT if getattr(error, "errno", None) in NO_NAMES else FAILED
    except Stopped as stopped:
        print("stopped", file=sys.stderr)
        return stopped.exit_code
