"""What the command line says of its options, and how it reads their words."""

import inspect
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tyro

import warpnerf
from warpnerf.cli.arguments import registry, with_help
from warpnerf.cli.main import COMMANDS, main

ROOT = Path(__file__).parents[2]


def command(
    steps: int | None = None,
    far: float | None = None,
    distance: float | Literal["auto"] | None = None,
    how: Literal["fast", "slow"] | None = None,
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None,
    name: str = "fox",
    plain: bool = False,
) -> Any:
    """Do something.

    Args:
        steps: As many as there are, or
            as time allows.
        far: How far: in metres.
        distance: Of something.
        how: One way or the other.
        size: Pixels.
        name: Of it.
        plain: Whether.

    Returns:
        All of it.
    """
    return steps, far, distance, how, size, name, plain


def run(*words: str) -> Any:
    with registry:
        return tyro.cli(with_help(command), args=list(words))


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stop:
        run(*words)
    assert stop.value.code == 2
    return " ".join(capsys.readouterr().err.split())


WORDS = "--steps=3 --far=1e3 --distance=2 --how=slow --size 4 5"


def test_words_become_values() -> None:
    assert run() == (None, None, None, None, None, "fox", False)
    given = run(
        *["--steps", "3", "--far", "1e3", "--distance", "2", "--how", "slow", "--size", "4", "5"]
    )
    assert given == (3, 1000.0, 2.0, "slow", (4, 5), "fox", False)
    given = run("--distance", "auto", "--name", "None", "--plain")
    assert given == (None, None, "auto", None, None, "None", True)


@pytest.mark.parametrize(
    "words, sentence",
    [
        (("--steps", "many"), "--steps: must be a whole number, not 'many'."),
        (("--steps", "1.5"), "--steps: must be a whole number, not '1.5'."),
        (("--far", "near"), "--far: must be a number, not 'near'."),
        (("--distance", "none"), "--distance: must be FLOAT|{auto}, not 'none'."),
        (("--how", "None"), "invalid choice 'None' for argument '--how'"),
    ],
)
def test_a_word_that_is_no_value(
    words: tuple[str, ...], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sentence in refused(capsys, *words)


@pytest.mark.parametrize(
    "words",
    [("train", "builtin:room", "--output", "-x"), ("train", "--resume", "--steps", "5")],
    ids=["a name that begins with -", "forgotten"],
)
def test_a_path_that_looks_like_an_option(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(list(words)) == 2
    option, word = words[-2:] if words[-1] == "-x" else words[1:3]
    assert f"{option} has no value, as {word} may be an option" in capsys.readouterr().err


def test_help_is_what_the_docstring_says(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert "--steps INT As many as there are, or as time allows. --far" in text
    assert "--far FLOAT How far: in metres. --distance FLOAT|{auto} Of something." in text
    assert "--how {fast,slow} One way or the other. --size WIDTH HEIGHT Pixels." in text
    assert "--name STR Of it. (default: fox)" in text
    assert text.endswith("--plain, --no-plain Whether.")


@pytest.mark.parametrize(
    "line", ["--help", "train --help", "train --help-all", "train x --output y --optim.decay fast"]
)
def test_what_does_not_train_loads_no_warp(line: str) -> None:
    code = (
        "import sys\nfrom warpnerf.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "loaded = {'warp', 'torch'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(loaded)) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code, *line.split()], capture_output=True)
    assert done.returncode == 0, done.stderr


def test_no_more_is_promised_than_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    """Fewer floaters; there are some left."""
    with pytest.raises(SystemExit):
        main(["--help"])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for text in (capsys.readouterr().out, warpnerf.__doc__, project["description"]):
        assert text is not None and "with fewer floaters" in " ".join(text.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_all_options_have_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "None" not in text
    shown = inspect.signature(with_help(COMMANDS[name])).parameters
    for parameter in shown.values():
        told = [how for how in parameter.annotation.__metadata__ if getattr(how, "help", None)]
        assert told, parameter.name
