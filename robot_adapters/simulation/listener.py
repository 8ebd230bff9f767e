"""An independent witness on the bus: it reads every command frame and judges it by itself.

It shares nothing with the driver but the codec of single frames: not its limits, its state or its word.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import can
import numpy as np
from numpy.typing import ArrayLike

from robot_adapters.airbot.protocol import DM_JOINTS, OD_JOINTS, DmMotor, Motor, MotorFeedback, OdMotor
from robot_adapters.clock import Clock, Schedule, SimulatedClock

FRAME = 0.05  # s
MAX_STEP = 0.1  # rad per frame
MAX_KP, MAX_KD = 101.0, 11.0
STILL = 0.02  # rad that a command may move by while the arm is to keep still
# Position codes have a quantum, and two frames 50 ms apart may come a little closer to each other.
POSITION_MARGIN, TIME_MARGIN = 0.001, 0.0045
# A frame that stays in force lets the joint rest at position + kd/kp velocity: velocities have a quantum too.
REST_MARGIN = 0.002


@dataclass
class HeardMotor:
    """The commands of one joint that were seen on the bus."""

    motor: Motor
    lower: float
    upper: float
    measured: float | None = None
    still_at: float | None = None
    last: float | None = None
    recent: deque[tuple[float, float]] = field(default_factory=deque)


class BusListener:
    """Counts command frames and collects violations of the limits as sentences."""

    def __init__(self, bus: can.BusABC, clock: Clock, lower: ArrayLike, upper: ArrayLike) -> None:
        """Joint limits `lower`, `upper` [rad] (6,); the bus is the listener's own and stays the caller's to
        close.
        """
        self.bus, self.clock = bus, clock
        limits = zip((*OD_JOINTS, *DM_JOINTS), np.asarray(lower), np.asarray(upper), strict=True)
        self.joints = {
            i: HeardMotor(OdMotor(i) if i in OD_JOINTS else DmMotor(i), float(low), float(high))
            for i, low, high in limits
        }
        self.commands = 0
        self.largest_step = 0.0
        self.violations: list[str] = []
        self.others: set[tuple[int, bytes]] = set()  # frames that somebody else sent, not judged
        self._schedule: Schedule | None = None

    def start(self) -> BusListener:
        """Listen on a simulated clock every 2 ms; on a real one call `poll` often enough."""
        if isinstance(self.clock, SimulatedClock) and self._schedule is None:
            self._schedule = self.clock.every(0.002, self.poll)
        return self

    def stop(self) -> None:
        """Stop listening; stopping twice is harmless."""
        if self._schedule is not None:
            self._schedule.cancel()
            self._schedule = None

    def expect_stillness(self) -> None:
        """From now on every joint's command must stay where it is, until `expect_motion`."""
        for witness in self.joints.values():
            if witness.still_at is None:
                witness.still_at = witness.last

    def expect_motion(self) -> None:
        """Commands may move again."""
        for witness in self.joints.values():
            witness.still_at = None

    def poll(self) -> None:
        """Judge the frames that came since the last call."""
        now = self.clock.monotonic()
        while (message := self.bus.recv(0.0)) is not None:
            self.judge(message, now if self.clock.simulated else message.timestamp)

    def judge(self, message: can.Message, now: float) -> None:
        """Judge one frame that came now [s]."""
        if self.others and (message.arbitration_id, bytes(message.data)) in self.others:
            return
        witness = self.joints.get(message.arbitration_id)
        command = witness.motor.decode_mit(message) if witness else None
        if witness is None or command is None:
            self._note_feedback(message)
            return
        self.commands += 1
        name = f"joint{witness.motor.id} at {now:.3f} s"
        if command.kp > MAX_KP or command.kd > MAX_KD:
            self.violations.append(f"{name}: gains kp {command.kp:.0f}, kd {command.kd:.1f}")
        witness.last = command.position
        if (
            witness.still_at is not None
            and abs(command.position - witness.still_at) > STILL + POSITION_MARGIN
        ):
            moved = command.position - witness.still_at
            self.violations.append(f"{name}: the command moved by {moved:.4f} rad after an event")
            witness.still_at = None
        if command.kp == 0.0:
            witness.recent.clear()
            return
        if not witness.lower - POSITION_MARGIN <= command.position <= witness.upper + POSITION_MARGIN:
            self.violations.append(f"{name}: position {command.position:.4f} rad outside the joint limits")
        rest = command.position + command.kd / command.kp * command.velocity
        if not witness.lower - REST_MARGIN <= rest <= witness.upper + REST_MARGIN:
            self.violations.append(f"{name}: left acting, the joint would rest at {rest:.3f} rad, outside")
        if not witness.recent and witness.measured is not None:
            witness.recent.append((now, witness.measured))
        while len(witness.recent) > 1 and witness.recent[0][0] < now - FRAME + TIME_MARGIN:
            witness.recent.popleft()
        step = max((abs(command.position - before) for _, before in witness.recent), default=0.0)
        self.largest_step = max(self.largest_step, step)
        if step > MAX_STEP + POSITION_MARGIN:
            self.violations.append(f"{name}: a step of {step:.4f} rad within a frame")
        witness.recent.append((now, command.position))

    def _note_feedback(self, message: can.Message) -> None:
        # OD motors answer under their own id, DM motors under 0x700 | id.
        witness = self.joints.get(message.arbitration_id & 0x0F)
        feedback = witness.motor.decode(message) if witness else None
        if witness is None or not isinstance(feedback, MotorFeedback) or witness.recent:
            return
        if witness.measured is None:
            # An arm that stands a little outside its limits may be held where it stands.
            witness.lower = min(witness.lower, feedback.position)
            witness.upper = max(witness.upper, feedback.position)
        witness.measured = feedback.position
