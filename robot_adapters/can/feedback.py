"""What the driver knows of its motors: the latest plausible feedback of each, its age, errors and
temperatures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_adapters.can.mit_frames import MotorFeedback
from robot_adapters.can.motor import Motor
from robot_adapters.can.witness import MotionWitness
from robot_adapters.safety import (
    MotorFault,
    OverTemperature,
    SafetyEvent,
    SafetyGate,
    SafetyLimits,
    SensorFault,
)

# Frames in a row before an error or a temperature counts: some damaged frames must not stop the arm.
_STREAK = 5
_TROUBLED = 25  # frames in a row that report trouble, be it each time another
_WARMING = 2  # degrees C that a motor can become hotter from one frame to the next
# rad beyond its limits to which a joint may be pushed, mechanical stops and the tolerance of zeros included
_BEYOND_LIMITS = 0.2


@dataclass
class MotorRecord:
    """The state of one motor as last reported."""

    motor: Motor
    position: float = float("nan")
    velocity: float = 0.0
    torque: float = 0.0
    error: int = 0
    motor_temperature: int = 0
    mosfet_temperature: int = 0
    stamp: float = float("-inf")
    frames: int = 0
    implausible: int = 0
    witness: MotionWitness = field(default_factory=lambda: MotionWitness("motor"))
    _bad_state: int = 0
    _too_hot: int = 0
    _troubled: int = 0

    def update(self, feedback: MotorFeedback, now: float, limits: SafetyLimits) -> None:
        """Take a feedback frame; a position that the joint cannot have reached is counted and left out."""
        if not self.witness.believes(feedback.position, feedback.velocity, now):
            self.implausible += 1
            return
        self.position, self.velocity, self.torque = feedback.position, feedback.velocity, feedback.torque
        same_error = feedback.error == self.error
        warming = max(
            abs(feedback.motor_temperature - self.motor_temperature),
            abs(feedback.mosfet_temperature - self.mosfet_temperature),
        )
        self.error = feedback.error
        self.motor_temperature = feedback.motor_temperature
        self.mosfet_temperature = feedback.mosfet_temperature
        self.stamp = now
        self.frames += 1
        # Damaged frames in a row do not say the same; a motor with a fault does.
        bad, hot = self._bad(), self._hot(limits)
        self._bad_state = (self._bad_state if same_error else 0) + 1 if bad else 0
        self._too_hot = (self._too_hot if warming <= _WARMING else 0) + 1 if hot else 0
        self._troubled = self._troubled + 1 if bad or hot else 0

    def fault(self, limits: SafetyLimits) -> SafetyEvent | None:
        """The event that this motor's state asks for, if any."""
        if self.witness.objection:
            return SensorFault(self.witness.objection)
        lasting = self._troubled >= _TROUBLED
        if self._bad_state >= _STREAK or (lasting and self._bad()):
            what = self.motor.fault(self.error)
            return MotorFault(f"motor {self.motor.id} reports {what} (code {self.error})")
        if self._too_hot >= _STREAK or lasting:
            temperatures = f"{self.motor_temperature} C, its MOSFETs at {self.mosfet_temperature} C"
            most = f"{limits.max_motor_temperature:.0f} and {limits.max_mosfet_temperature:.0f} C"
            return OverTemperature(f"motor {self.motor.id} at {temperatures}; limits {most}")
        return None

    def _bad(self) -> bool:
        return self.motor.fault(self.error) is not None

    def _hot(self, limits: SafetyLimits) -> bool:
        return (
            self.motor_temperature > limits.max_motor_temperature
            or self.mosfet_temperature > limits.max_mosfet_temperature
        )


class FeedbackTable:
    """The records of all motors of an arm, joints first, and what they say together."""

    def __init__(
        self, motors: Sequence[Motor], gate: SafetyGate, positions: Sequence[float], now: float
    ) -> None:
        """`motors` in joint order, the gripper's last; the first ones are the joints of `gate`.

        `positions` [rad] are those read when the motors were started, just before `now` [s], known until they report.
        """
        dof = len(gate.joint_names)
        names = [*gate.joint_names, *(f"the gripper's motor {motor.id}" for motor in motors[dof:])]
        lower = [*(gate.lower - _BEYOND_LIMITS), *(-math.inf for _ in motors[dof:])]
        upper = [*(gate.upper + _BEYOND_LIMITS), *(math.inf for _ in motors[dof:])]
        witnesses = [
            MotionWitness(*row, now) for row in zip(names, lower, upper, map(float, positions), strict=True)
        ]
        self.records = {
            motor.id: MotorRecord(motor, float(position), witness=witness)
            for motor, position, witness in zip(motors, positions, witnesses, strict=True)
        }
        self._joints = [self.records[motor.id] for motor in motors[:dof]]
        self._limits = gate.limits

    def update(self, feedback: MotorFeedback, now: float) -> None:
        """Take a feedback frame of one of the motors."""
        self.records[feedback.motor_id].update(feedback, now, self._limits)

    @property
    def complete(self) -> bool:
        """Whether every motor has reported."""
        return all(record.frames for record in self.records.values())

    def joints(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position [rad], velocity [rad/s] and motor torque [Nm] of the joints, each (dof,)."""
        rows = np.array([(r.position, r.velocity, r.torque) for r in self._joints])
        return rows[:, 0], rows[:, 1], rows[:, 2]

    def distrust(self, reasons: Mapping[int, str]) -> None:
        """Note what is wrong with joints' feedback, by number of the joint; it is trouble for good."""
        for joint, reason in reasons.items():
            self._joints[joint].witness.object(reason)

    def timely(self, now: float) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which joints reported just now, and by how much their frames may be late [s], each (dof,)."""
        late = np.array([r.witness.lateness(now) for r in self._joints])
        return np.array([r.stamp == now for r in self._joints]), late

    def oldest(self, now: float) -> tuple[float, int]:
        """Age [s] of the oldest feedback, the gripper's included, and its motor's id."""
        record = min(self.records.values(), key=lambda record: record.stamp)
        return now - record.stamp, record.motor.id

    def faults(self) -> list[SafetyEvent]:
        """The events that the motors' states ask for, joints first."""
        found = (record.fault(self._limits) for record in self.records.values())
        return [event for event in found if event is not None]
