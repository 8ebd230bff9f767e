"""Opening a CAN bus through python-can, and asking something on it."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from typing import Any

import can

from robot_adapters.clock import Clock

BITRATE = 1_000_000
INTERFACES = ("socketcan", "slcan", "virtual", "udp_multicast")
_BUS_OFF = 0x40  # SocketCAN's error class of a controller that has left the bus


class BusError(OSError):
    """A bus that cannot be opened or used; the message names interface, channel and remedy."""


class NoAnswerError(BusError, TimeoutError):
    """A motor or board that did not answer in time."""


_REMEDIES = {
    "socketcan": "bring the interface up: ip link set {channel} up type can bitrate 1000000",
    "slcan": "check that {channel} is the adapter's serial port and that you may open it",
    "virtual": "a virtual bus exists within one process only",
    "udp_multicast": "check the multicast address {channel}, the network, and that msgpack is installed",
}
_DEFAULT_CHANNELS = {"socketcan": "can0", "virtual": "airbot", "udp_multicast": "239.74.163.2"}


def open_bus(interface: str, channel: str | None = None, **options: Any) -> can.BusABC:
    """Open a classic CAN bus at 1 Mbit/s.

    `interface` is any of python-can's, `INTERFACES` are the usual ones; `channel` defaults to can0, to a bus
    called airbot or to a local multicast group. `options` go to python-can. Raises BusError with the remedy
    when it cannot be opened.
    """
    channel = channel if channel is not None else _DEFAULT_CHANNELS.get(interface)
    if channel is None:
        raise BusError(f"interface {interface!r} needs a channel")
    if interface in ("socketcan", "udp_multicast"):
        options.setdefault("fd", False)
    else:
        options.setdefault("bitrate", BITRATE)
    _quieten()
    try:
        if interface == "slcan" and os.name == "posix":
            from robot_adapters.can.serial_line import SerialLineBus

            return SerialLineBus(channel, **options)
        return can.Bus(interface=interface, channel=channel, receive_own_messages=False, **options)
    except (can.CanError, OSError, ImportError, ValueError) as error:
        remedy = _REMEDIES.get(interface, f"usual interfaces are {', '.join(INTERFACES)}").format(
            channel=channel
        )
        raise BusError(f"cannot open CAN bus {interface}:{channel} ({error}); {remedy}") from error


def _quieten() -> None:
    """Keep python-can from logging each of the thousands of frames a second, unless its level was chosen.

    LeRobot sets the root logger to let everything through, so that a record would be made of every frame and
    thrown away by the handlers.
    """
    logger = logging.getLogger("can")
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.INFO)


def reports_bus_off(message: can.Message) -> bool:
    """Whether a frame is the controller's report that it has left the bus."""
    return bool(message.is_error_frame and message.arbitration_id & _BUS_OFF)


def bus_off_report() -> can.Message:
    """The frame that reports a controller off the bus."""
    return can.Message(arbitration_id=_BUS_OFF, is_error_frame=True, is_extended_id=False, data=bytes(8))


def receive(bus: can.BusABC, clock: Clock, until: float) -> can.Message | None:
    """The next frame, or None when none came until the clock shows `until` [s]."""
    while True:
        message = bus.recv(0.0)
        left = until - clock.monotonic()
        if message is not None or left <= 0:
            return message
        if clock.simulated:
            clock.sleep(min(left, 0.0005))
        elif (message := bus.recv(left)) is not None:
            return message


def ask[Answer](
    bus: can.BusABC,
    clock: Clock,
    question: can.Message,
    accept: Callable[[can.Message], Answer | None],
    what: str,
    timeout: float = 0.05,
    attempts: int = 4,
) -> Answer:
    """Send `question` and return the first answer that `accept` takes.

    Frames that it does not take are dropped. The question is repeated up to `attempts` times, each waiting
    `timeout` [s]. Raises NoAnswerError, which names `what`, when no answer came, and BusError when the bus is
    off.
    """
    for _ in range(attempts):
        send(bus, question)
        until = clock.monotonic() + timeout
        while (message := receive(bus, clock, until)) is not None:
            if reports_bus_off(message):
                raise BusError("the CAN controller is off the bus; check wiring, termination and power")
            answer = accept(message)
            if answer is not None:
                return answer
    raise NoAnswerError(
        f"no answer about {what} in {attempts} x {timeout * 1e3:.0f} ms; "
        "check power, emergency stop and CAN wiring"
    )


def send(bus: can.BusABC, message: can.Message) -> None:
    """Send a frame, waiting shortly when the transmit buffer is full; BusError when it cannot be sent."""
    try:
        bus.send(message, timeout=0.002)
    except (can.CanError, OSError, ValueError) as error:
        raise BusError(f"cannot send on the CAN bus ({error})") from error


def unread(bus: can.BusABC) -> int:
    """Frames that have come and were not read, where the interface can tell, else 0."""
    queue = getattr(bus, "queue", None)
    return queue.qsize() if queue is not None else 0


def drain(bus: can.BusABC, limit: int = 10_000) -> int:
    """Throw away what has come; the number of frames."""
    count = 0
    deadline = time.monotonic() + 1.0
    while count < limit and time.monotonic() < deadline and bus.recv(0.0) is not None:
        count += 1
    return count
