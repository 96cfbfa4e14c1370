"""Options of other programs lead to ours."""

from __future__ import annotations

import pytest

from warpnerf.cli.arguments import flags_of
from warpnerf.cli.foreign import _MEANT, SCENE, meant_by
from warpnerf.cli.main import COMMANDS, main

FLAGS = {name: set(flags_of(command)) for name, command in COMMANDS.items()}


def test_each_leads_to_an_option_that_there_is() -> None:
    known = set().union(*FLAGS.values())
    assert {ours for ours in _MEANT if ours != SCENE} <= known
    theirs = [flag for flags in _MEANT.values() for flag in flags]
    assert not known.intersection(set(theirs) - {"--path", "--scene"})


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("train --max-num-iterations 9", "here it is --steps"),
        ("train --num-voxels 9", "here it is --voxels"),
        ("train --data x", "a word without one, as in warpnerf train FOLDER"),
        ("pose --input x", "a word without one, as in warpnerf pose FOLDER"),
        ("eval run --data x", "here it is --scene"),
    ],
)
def test_the_command_says_so(line: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    assert says in capsys.readouterr().err


def test_what_is_in_no_program_leads_nowhere() -> None:
    assert meant_by("--frobnicate", FLAGS["train"]) is None
