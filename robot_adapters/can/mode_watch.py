"""Whether the motors are still in the control mode that they were started in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from robot_adapters.can.dm_motor import MIT_MODE, DmMotor, DmRegister
from robot_adapters.can.mit_frames import ParameterReply
from robot_adapters.safety import WrongControlMode

# Time between two questions [s], one motor in turn: 20 frames a second beside the loop's thousands, and each of
# four motors is looked at every 0.2 s.
_PERIOD = 0.05


class ModeWatch:
    """Reads the mode register of the Damiao motors in turn; a motor in another mode ignores MIT commands.

    An answer that is wrong is asked for again at once, and believed when it is the same again: a damaged frame
    must not stop the arm.
    """

    def __init__(self, motors: Sequence[Any]) -> None:
        """`motors` of any family; those that have no modes are left out."""
        self._motors = [motor for motor in motors if isinstance(motor, DmMotor)]
        self._turn = 0
        self._asked = -math.inf
        self._doubted: dict[int, int | float | str | None] = {}

    def due(self, now: float) -> DmMotor | None:
        """The motor to ask for its mode now [s], if any."""
        if not self._motors:
            return None
        doubtful = [motor for motor in self._motors if motor.id in self._doubted]
        if doubtful and now > self._asked:
            self._asked = now
            return doubtful[0]
        if now - self._asked < _PERIOD:
            return None
        self._asked, self._turn = now, (self._turn + 1) % len(self._motors)
        return self._motors[self._turn]

    def heard(self, reply: ParameterReply) -> WrongControlMode | None:
        """The event, if an answer proves a wrong mode."""
        if reply.register != DmRegister.CONTROL_MODE:
            return None
        if reply.value == MIT_MODE:
            self._doubted.pop(reply.motor_id, None)
            return None
        if self._doubted.get(reply.motor_id) != reply.value:
            self._doubted[reply.motor_id] = reply.value
            return None
        del self._doubted[reply.motor_id]
        return WrongControlMode(f"motor {reply.motor_id} is in control mode {reply.value}, not in MIT mode")
