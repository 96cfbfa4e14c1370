"""Words that the parser cannot read are refused in one sentence, as everything else is."""

import errno

import pytest

from warpnerf.cli import main as command
from warpnerf.cli.main import BAD_INPUT, main
from warpnerf.cli.refused import sentence


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("train x y", "train does not take the word y; warpnerf train --help lists"),
        ("pose", "pose needs SOURCE and --output PATH; warpnerf pose --help says"),
        ("render", "render needs RUN;"),
        ("pose x --output y --lenses foo", "--lenses must be one of auto, one, each, not 'foo'."),
        ("train x --output", "--output needs a value;"),
        ("train x --box 1 2", "--box needs 6 values;"),
        ("view r --port abc", "--port must be a whole number, not 'abc'."),
        ("render r --size 3 x", "--size must be numbers, not '3', 'x'."),
        ("train x --view=3", "train does not take the word 3;"),
        ("--steps 3", "the first word must be a command, not --steps, 3;"),
        ("", "no command is given; warpnerf --help lists all."),
    ],
)
@pytest.mark.parametrize("columns", ["24", "200"])
def test_one_sentence(
    words: str,
    says: str,
    columns: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the width of the terminal."""
    monkeypatch.setenv("COLUMNS", columns)
    assert main(words.split()) == BAD_INPUT
    captured = capsys.readouterr()
    assert captured.err.startswith(f"warpnerf: error: {says}") and not captured.out
    assert captured.err.count("\n") == 1 and captured.err.endswith(".\n")


def test_what_is_not_foreseen_is_a_sentence_too() -> None:
    box = " Title \n --------- \n  Something else\n  happened. \n ---------\n For full helptext\n"
    assert sentence(box, "train") == (
        "Something else happened; warpnerf train --help lists all options."
    )


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Failed to load the shared library '/x/warp.so'"),
        ImportError("/x/_core.so: failed to map segment from shared object"),
    ],
)
def test_a_library_that_cannot_be_loaded(
    error: Exception, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the process may have too little memory."""

    def fail(words: list[str]) -> int:
        raise error

    monkeypatch.setattr(command, "call_of", fail)
    assert main(["runs"]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("warpnerf: error: a library cannot be loaded (") and "ulimit -v" in said


@pytest.mark.parametrize(("number", "code"), [(errno.ENAMETOOLONG, 2), (errno.EIO, 1)])
def test_names_that_cannot_be_those_of_files(
    number: int, code: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(words: list[str]) -> int:
        raise OSError(number, "so", "x")

    monkeypatch.setattr(command, "call_of", fail)
    assert main(["runs"]) == code
    assert capsys.readouterr().err.startswith("warpnerf: error: x: so; ")


def test_refusals_are_short_and_steer_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever words they quote."""
    assert main(["inspect", "\u202e\x1b[2J" + "x" * 70_000]) == BAD_INPUT
    said = capsys.readouterr().err
    assert len(said) < 1300 and said[:-1].isprintable() and "\\u202e\\x1b[2J" in said
    assert main(["eval", "run", "--device", "x" * 70_000]) == BAD_INPUT
    assert len(capsys.readouterr().err) < 1300
