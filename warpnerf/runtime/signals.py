"""Ctrl-C, SIGTERM, SIGHUP: how a program is asked to end, and what it then exits with."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""SIGHUP comes where a terminal or connection is closed; Windows has none."""


class Stopped(KeyboardInterrupt):
    """A signal asks the program to end here and now."""

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__()
        self.exit_code = 128 + number
        """130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP, as shells have it."""


def raise_when_asked() -> None:
    """From now on, signals raise Stopped in the main thread.

    SIGHUP stays ignored where it is, as under nohup.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise)
    sys.unraisablehook = _ask_again


class StopRequest:
    """Within it, the first signal is only noted, so that an update can be finished and saved."""

    def __init__(self, patience: float = 0.0) -> None:
        """Signals within so many seconds of the first one are the same request, for processes that
        a terminal and whoever started them both ask."""
        self._patience = patience
        self._asked_at = 0.0

    def __enter__(self) -> StopRequest:
        """Take the signals over."""
        self.exit_code: int | None = None
        heard = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(self, *error: object) -> None:
        """Give them back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def asked(self) -> bool:
        """Whether a signal came."""
        return self.exit_code is not None

    def _note(self, number: int, frame: object) -> None:
        if self.exit_code is None:
            self.exit_code, self._asked_at = Stopped(number).exit_code, time.monotonic()
            if self._patience == 0.0:
                raise_when_asked()  # who asks twice does not want to wait
        elif time.monotonic() - self._asked_at >= self._patience:
            raise Stopped(number)


def _raise(number: int, frame: object) -> None:
    raise Stopped(number)


def _ask_again(lost: sys.UnraisableHookArgs) -> None:
    """Let a signal that came in a finaliser, or a callback from C, come again when that has ended.

    Python drops what these raise.
    """
    if not isinstance(lost.exc_value, Stopped):
        sys.__unraisablehook__(lost)
        return
    number = lost.exc_value.exit_code - 128
    again = threading.Timer(0.01, _thread.interrupt_main, (number,))
    again.daemon = True
    again.start()
