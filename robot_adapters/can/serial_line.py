"""python-can's serial-line interface (slcan), reading and writing whole lines.

python-can asks the operating system for every byte, waits after every frame until the port has sent it, takes a process
that slept for a write that failed, and says that nothing came where an adapter's acknowledgement came first. An arm's
motors answer 1,500 times a second, 20 characters each: that is more than a small computer has time for.
"""

from __future__ import annotations

import contextlib
import os
import select
import time

import can
from can.exceptions import CanOperationError, error_check
from can.interfaces.slcan import slcanBus

_PATIENCE = 0.1  # s that a write may take where nobody says how long
_CLASSIC = 8  # most bytes of a frame


class SerialLineBus(slcanBus):
    """An slcan adapter on a POSIX serial port; python-can's in everything but how bytes come and go."""

    def shutdown(self) -> None:
        """Close the channel and the port, the latter also where the adapter is gone."""
        try:
            super().shutdown()
        except CanOperationError:
            self.serialPortOrig.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """The next frame. Acknowledgements, and lines that were damaged on their way, are passed over."""
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            line = self._read(None if until is None else until - time.monotonic())
            if line is None:
                return None, False
            self._queue.put(line)  # from where python-can takes a line before it reads one
            with contextlib.suppress(ValueError, IndexError):
                message, filtered = super()._recv_internal(0.0)
                if message is not None and message.dlc <= _CLASSIC:
                    return message, filtered

    def _write(self, string: str) -> None:
        line, port = string.encode() + self.LINE_TERMINATOR, self.fileno()
        until = time.monotonic() + (self.serialPortOrig.write_timeout or _PATIENCE)
        with error_check("Could not write to serial device", exception_type=CanOperationError):
            while line:
                try:
                    line = line[os.write(port, line) :]
                except BlockingIOError:
                    left = until - time.monotonic()
                    if left <= 0:
                        raise
                    select.select([], [port], [], left)

    def _read(self, timeout: float | None) -> str | None:
        """The next line, an adapter's bare OK or error included; None when none came in `timeout` [s]."""
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            ends = [end for end in map(self._buffer.find, (self._OK, self._ERROR)) if end >= 0]
            if ends:
                length = min(ends) + 1
                line = self._buffer[:length].decode("ascii", errors="replace")
                del self._buffer[:length]
                return line
            with error_check("Could not read from serial device", exception_type=CanOperationError):
                waiting = self.serialPortOrig.in_waiting
                if waiting:
                    self._buffer += self.serialPortOrig.read(waiting)
                    continue
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return None
            select.select([self.fileno()], [], [], left)
