"""Running a safe stop when the process is asked to end, before whoever else handles the signal."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class SignalGuard:
    """Calls back on SIGINT and SIGTERM, then does what would have happened without it.

    Only the main thread can install handlers: elsewhere the guard does nothing.
    """

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback = callback
        self._previous: dict[int, Any] = {}
        self._active = False

    def install(self) -> None:
        """Put the guard before the present handlers; a signal that the process ignores stays ignored."""
        if threading.current_thread() is not threading.main_thread():
            return
        self._active = True
        for number in _SIGNALS:
            if number not in self._previous and signal.getsignal(number) != signal.SIG_IGN:
                self._previous[number] = signal.signal(number, self._handle)

    def remove(self) -> None:
        """Put the former handlers back; where somebody came after the guard, it stays and only passes on."""
        self._active = False
        if threading.current_thread() is not threading.main_thread():
            return
        for number in [n for n in self._previous if signal.getsignal(n) == self._handle]:
            previous = self._previous.pop(number)
            signal.signal(number, previous if previous is not None else signal.SIG_DFL)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        previous = self._previous.get(number)
        if self._active:
            self._callback()
        if callable(previous):
            previous(number, frame)
        else:
            raise SystemExit(128 + number)
