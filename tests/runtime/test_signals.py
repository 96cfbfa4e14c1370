"""Signals: the first is noted, the second is obeyed at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from warpnerf.runtime.signals import SIGNALS, Stopped, StopRequest, raise_when_asked


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The test runner's, put back afterwards."""
    before, hook = {number: signal.getsignal(number) for number in SIGNALS}, sys.unraisablehook
    yield
    sys.unraisablehook = hook
    for number, handler in before.items():
        signal.signal(number, handler)


def ask(number: int) -> None:
    os.kill(os.getpid(), number)
    for _ in range(1000):  # handlers run between two instructions
        pass


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_the_first_signal_is_noted(number: int, code: int) -> None:
    with StopRequest() as stop:
        assert not stop.asked
        ask(number)
        assert stop.asked
        assert stop.exit_code == code


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_second_signal_is_obeyed(number: int, code: int) -> None:
    with StopRequest():
        ask(signal.SIGINT)
        with pytest.raises(Stopped) as stopped:
            ask(number)
    assert stopped.value.exit_code == code
    assert isinstance(stopped.value, KeyboardInterrupt)


def test_handlers_are_given_back() -> None:
    raise_when_asked()
    before = [signal.getsignal(number) for number in SIGNALS]
    with StopRequest():
        assert [signal.getsignal(number) for number in SIGNALS] != before
        ask(signal.SIGTERM)
    assert [signal.getsignal(number) for number in SIGNALS] == before
    with pytest.raises(Stopped):
        ask(signal.SIGTERM)


class Ending:
    """Asked to stop in its finaliser, as Warp's arrays are when they give their memory back."""

    def __del__(self) -> None:
        ask(signal.SIGTERM)


def test_a_signal_is_not_lost_in_a_finaliser() -> None:
    raise_when_asked()
    with pytest.raises(Stopped) as stopped:
        Ending()
        for _ in range(1000):
            time.sleep(0.01)
    assert stopped.value.exit_code == 143


def test_other_errors_of_finalisers_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    class Failing:
        def __del__(self) -> None:
            raise ValueError("of no signal")

    raise_when_asked()
    Failing()
    assert "ValueError: of no signal" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["warpnerf.cli.main", "tyro", "numpy"])
def test_ctrl_c_while_the_command_is_imported(name: str) -> None:
    """Whatever is imported at that moment, there is no traceback."""
    program = f"""
import os, signal, sys
from warpnerf.cli.start import start
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["warpnerf", "inspect", "builtin:room"]
sys.exit(start())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "stopped\n")
