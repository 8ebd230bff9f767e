"""Who else commands our motors: other masters' orders on the bus, and answers to questions we never asked."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import can

from robot_adapters.can.bus import receive
from robot_adapters.can.mit_frames import payload
from robot_adapters.can.motor import Motor
from robot_adapters.clock import Clock
from robot_adapters.safety import ForeignMaster

# Frames of ours to one id that are recognised when an interface gives them back: 0.1 s at 250 Hz. An interface
# that echoes does so within milliseconds.
_REMEMBERED = 25
# Frames of ours after which answers in excess are forgotten, and of which answers may be under way: 0.5 s at
# 250 Hz.
_WINDOW = 125
# Answers in excess that are still no proof: somebody may have looked at the motors without commanding them.
_EXCESS = 4
# How long answers to frames sent before we opened the bus, by a predecessor that has just ended, may take [s].
_STRAYS = 0.1


class MasterWatch:
    """Tells our own traffic from another master's.

    A frame that orders one of our motors and is none of ours is proof. Where the interface does not show the
    other's frames, the motors' answers are: a motor answers each command once, so that answers beyond what we
    asked for were asked for by somebody else. An answer that repeats the one before byte for byte, without a
    question of ours between them, does not count: it may be a doubled frame.
    """

    def __init__(self, motors: Sequence[Motor], excess: int = _EXCESS) -> None:
        """`excess`: answers beyond those to our own frames that a motor may give."""
        self._by_order: dict[int, list[Motor]] = {}
        for motor in motors:
            for arbitration_id in motor.order_ids:
                self._by_order.setdefault(arbitration_id, []).append(motor)
        self._by_answer = {motor.answer_id: motor.id for motor in motors}
        self._own: dict[int, deque[bytes]] = {i: deque(maxlen=_REMEMBERED) for i in self._by_order}
        self._outstanding = dict.fromkeys((motor.id for motor in motors), 0)
        self._sent = dict.fromkeys((motor.id for motor in motors), 0)
        self._last: dict[int, bytes] = {}  # answers since which nothing was sent
        self._excess = excess

    def sent(self, message: can.Message, motor_id: int) -> None:
        """Note a frame that we sent to one of the motors."""
        self._own[message.arbitration_id].append(bytes(message.data))
        self._last.pop(motor_id, None)
        self._sent[motor_id] += 1
        if self._sent[motor_id] % _WINDOW == 0:
            self._outstanding[motor_id] = max(self._outstanding[motor_id], 0)
        self._outstanding[motor_id] = min(self._outstanding[motor_id] + 1, _WINDOW)

    def heard(self, message: can.Message) -> ForeignMaster | None:
        """The event, if a frame proves another master."""
        data = payload(message)
        if data is None:
            return None
        for motor in self._by_order.get(message.arbitration_id, ()):
            order = motor.order(message)
            if order is None:
                continue
            if data in self._own[message.arbitration_id]:
                return None  # an interface that gives back what we sent
            return ForeignMaster(f"somebody else sent motor {motor.id} a {order}")
        return self._count(message.arbitration_id, data)

    def _count(self, arbitration_id: int, data: bytes) -> ForeignMaster | None:
        motor_id = self._by_answer.get(arbitration_id)
        if motor_id is None or data == self._last.get(motor_id):
            return None
        self._last[motor_id] = data
        self._outstanding[motor_id] -= 1
        if self._outstanding[motor_id] >= -self._excess:
            return None
        return ForeignMaster(f"motor {motor_id} answers commands that this driver did not send")


def find_master(
    bus: can.BusABC, clock: Clock, motors: Sequence[Motor], seconds: float
) -> ForeignMaster | None:
    """Listen for `seconds` without sending anything; the event, if somebody commands the motors."""
    start = clock.monotonic()
    watch, strays = MasterWatch(motors, excess=0), MasterWatch(motors, excess=10_000)
    while clock.monotonic() < start + seconds:
        message = receive(bus, clock, start + seconds)
        if message is None:
            break
        event = (strays if clock.monotonic() < start + _STRAYS else watch).heard(message)
        if event is not None:
            return event
    return None
