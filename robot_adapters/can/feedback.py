"""What the driver knows of its motors: the latest plausible feedback of each, its age, errors and
temperatures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_adapters.airbot.protocol import DmMotor, Motor, MotorFeedback, error_name
from robot_adapters.safety import MotorFault, OverTemperature, SafetyEvent, SafetyLimits

# A joint cannot be further from its last position than this [rad] plus what it does at the speed [rad/s].
_JUMP, _SPEED = 0.05, 10.0
# Frames in a row before an error or a temperature counts, and before an implausible position is believed: some
# damaged frames must neither stop the arm nor tell it to hold elsewhere.
_STREAK, _BELIEVED = 5, 8
_TROUBLED = 25  # frames in a row that report trouble, be it each time another
_WARMING = 2  # degrees C that a motor can become hotter from one frame to the next


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
    _bad_state: int = 0
    _too_hot: int = 0
    _troubled: int = 0
    _doubted: int = 0
    _doubted_position: float = float("nan")

    def update(self, feedback: MotorFeedback, now: float, limits: SafetyLimits) -> None:
        """Take a feedback frame; a position that the joint cannot have reached is counted and left out."""
        if self.frames and not self._believable(feedback.position, now):
            self.implausible += 1
            return
        self._doubted = 0
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
        # Damaged frames in a row do not say the same; a motor in trouble does.
        bad, hot = self._bad(), self._hot(limits)
        self._bad_state = (self._bad_state if same_error else 0) + 1 if bad else 0
        self._too_hot = (self._too_hot if warming <= _WARMING else 0) + 1 if hot else 0
        self._troubled = self._troubled + 1 if bad or hot else 0

    def trouble(self, limits: SafetyLimits) -> SafetyEvent | None:
        """The event that this motor's state asks for, if any."""
        lasting = self._troubled >= _TROUBLED
        if self._bad_state >= _STREAK or (lasting and self._bad()):
            what = error_name(self.motor, self.error) or "disabled"
            return MotorFault(f"motor {self.motor.id} reports {what} (code {self.error})")
        if self._too_hot >= _STREAK or lasting:
            temperatures = f"{self.motor_temperature} C, its MOSFETs at {self.mosfet_temperature} C"
            most = f"{limits.max_motor_temperature:.0f} and {limits.max_mosfet_temperature:.0f} C"
            return OverTemperature(f"motor {self.motor.id} at {temperatures}; limits {most}")
        return None

    def _believable(self, position: float, now: float) -> bool:
        reach = _JUMP + _SPEED * min(now - self.stamp, 1.0)
        if abs(position - self.position) <= reach:
            return True
        same = abs(position - self._doubted_position) <= 2 * _JUMP
        self._doubted = self._doubted + 1 if same else 1
        self._doubted_position = position
        return self._doubted >= _BELIEVED

    def _bad(self) -> bool:
        if error_name(self.motor, self.error) is not None:
            return True
        return isinstance(self.motor, DmMotor) and self.error == 0

    def _hot(self, limits: SafetyLimits) -> bool:
        return (
            self.motor_temperature > limits.max_motor_temperature
            or self.mosfet_temperature > limits.max_mosfet_temperature
        )


class FeedbackTable:
    """The records of all motors of an arm, joints first, and what they say together."""

    def __init__(
        self, motors: list[Motor], dof: int, limits: SafetyLimits, positions: Sequence[float]
    ) -> None:
        """`motors` in joint order, the gripper's last; the first `dof` of them are joints.

        `positions` [rad] are those read when the motors were started, known until they report.
        """
        self.records = {
            motor.id: MotorRecord(motor, float(position))
            for motor, position in zip(motors, positions, strict=True)
        }
        self._joints = [self.records[motor.id] for motor in motors[:dof]]
        self._limits = limits

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

    def oldest(self, now: float) -> tuple[float, int]:
        """Age [s] of the oldest feedback, the gripper's included, and its motor's id."""
        record = min(self.records.values(), key=lambda record: record.stamp)
        return now - record.stamp, record.motor.id

    def troubles(self) -> list[SafetyEvent]:
        """The events that the motors' states ask for, joints first."""
        found = (record.trouble(self._limits) for record in self.records.values())
        return [event for event in found if event is not None]
