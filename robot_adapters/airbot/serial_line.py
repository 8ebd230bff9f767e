"""python-can's serial-line interface (slcan), reading and writing whole lines.

python-can asks the operating system for every byte, waits after every frame until the port has sent it, and takes a
process that slept for a write that failed. An arm's motors answer 1,500 times a second, 20 characters each: that is
more than a small computer has time for.
"""

from __future__ import annotations

import contextlib
import os
import select
import time

import can
from can.exceptions import CanOperationError, error_check
from can.interfaces.slcan import slcanBus

_ENDS = b"\r\a"
_PATIENCE = 0.1  # s that a write may take where nobody says how long
_CLASSIC = 8  # most bytes of a frame


class SerialLineBus(slcanBus):
    """An slcan adapter; python-can's in everything but how bytes come and go."""

    def shutdown(self) -> None:
        """Close the channel and the port, the latter also where the adapter is gone."""
        try:
            super().shutdown()
        except CanOperationError:
            self.serialPortOrig.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """As python-can's, but a line that was damaged on its way is dropped like any damaged frame."""
        with contextlib.suppress(ValueError, IndexError):
            message, filtered = super()._recv_internal(timeout)
            if message is not None and message.dlc <= _CLASSIC:
                return message, filtered
        return None, False

    def _write(self, string: str) -> None:
        line = string.encode() + self.LINE_TERMINATOR
        until = time.monotonic() + (self.serialPortOrig.write_timeout or _PATIENCE)
        with error_check("Could not write to serial device", exception_type=CanOperationError):
            if self._file is None:
                self.serialPortOrig.write(line)
                return
            while line:
                try:
                    line = line[os.write(self._file, line) :]
                except BlockingIOError:
                    left = until - time.monotonic()
                    if left <= 0:
                        raise
                    select.select([], [self._file], [], left)

    def _read(self, timeout: float | None) -> str | None:
        """The next line, an adapter's bare OK or error included; None when none came in `timeout` [s]."""
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            end = next((i for i, byte in enumerate(self._buffer) if byte in _ENDS), None)
            if end is not None:
                line = self._buffer[: end + 1].decode("ascii", errors="replace")
                del self._buffer[: end + 1]
                return line
            with error_check("Could not read from serial device", exception_type=CanOperationError):
                waiting = self.serialPortOrig.in_waiting
                if waiting:
                    self._buffer += self.serialPortOrig.read(waiting)
                    continue
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return None
            if self._file is None:
                time.sleep(0.0005)
            else:
                select.select([self._file], [], [], left)

    @property
    def _file(self) -> int | None:
        """The port's descriptor; None where it is no file (Windows, a port in the network)."""
        try:
            return self.fileno()
        except NotImplementedError:
            return None
