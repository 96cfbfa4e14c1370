"""What the command sets for its whole process, and what stays as the user has it."""

import os

import pytest

from tests.project.test_init import in_fresh_python
from warpnerf.runtime import process


@pytest.mark.parametrize("given", [None, "active"])
def test_threads_of_openmp_do_not_spin(given: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_own", False)
    monkeypatch.setenv("OMP_WAIT_POLICY", given or "")
    if given is None:
        monkeypatch.delenv("OMP_WAIT_POLICY")
    process.make_own()
    assert process.is_own() and os.environ["OMP_WAIT_POLICY"] == (given or "passive")


def test_the_command_says_so_before_such_a_library_is_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    code = (
        "import sys, os, warpnerf.runtime.process as process\n"
        "make_own, loaded = process.make_own, []\n"
        "def at_this_moment():\n"
        "    loaded.extend({'torch', 'flip_evaluator', 'warp'} & set(sys.modules))\n"
        "    make_own()\n"
        "process.make_own = at_this_moment\n"
        "from warpnerf.cli.main import main\n"
        "code = main(['eval', 'no such run'])\n"
        "print(code, os.environ.get('OMP_WAIT_POLICY'), loaded)"
    )
    assert in_fresh_python(code) == "2 passive []"
