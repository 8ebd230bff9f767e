"""What a joint's motor reports when its sensors fail, in place of what its body does.

But for SLIPPED_ZERO the motor itself still acts on the truth: only its word is false. The velocity is that of the
reported angle, as if both came from one encoder; LYING_VELOCITY is the fault that parts them.
"""

from __future__ import annotations

import math

import numpy as np

from robot_adapters.simulation.faults import Fault, FaultInjector, FaultKind

Reading = tuple[float, float, float]
"""Angle [rad], velocity [rad/s] and torque [Nm]."""


class SensorFaults:
    """The faulty sensors of one motor."""

    def __init__(self, faults: FaultInjector, motor_id: int, random: np.random.Generator) -> None:
        self._faults, self._id, self._random = faults, motor_id, random
        self._frozen: float | None = None

    def active(self, kind: FaultKind, now: float) -> Fault | None:
        """The fault of a kind that strikes this motor now."""
        return self._faults.active(kind, self._id, now) if self._faults.faults else None

    def report(self, truth: Reading, neighbour: Reading, now: float) -> Reading:
        """What the motor says of `truth`; `neighbour` is the reading of the joint beside it.

        `magnitude` of the fault: the offset [rad] of JUMPED_ENCODER, the rate [rad/s] of DRIFTING_ENCODER, the
        standard deviation [rad] of NOISY_ENCODER, what SCALED_ENCODER adds to the factor 1, the offset [rad/s]
        of LYING_VELOCITY; the sign of SATURATED_ENCODER says at which end of its code the angle is stuck.
        """
        if not self._faults.faults:
            return truth
        position, velocity, torque = truth
        if self.active(FaultKind.SWAPPED_FEEDBACK, now):
            position, velocity, torque = neighbour
        if self.active(FaultKind.STUCK_ENCODER, now):
            self._frozen = position if self._frozen is None else self._frozen
            position, velocity = self._frozen, 0.0
        if fault := self.active(FaultKind.JUMPED_ENCODER, now):
            position += fault.magnitude
        if fault := self.active(FaultKind.SATURATED_ENCODER, now):
            # Codecs clamp to the ends of their ranges.
            position, velocity = math.copysign(100.0, fault.magnitude), 0.0
        if fault := self.active(FaultKind.DRIFTING_ENCODER, now):
            position += fault.magnitude * (now - fault.start)
            velocity += fault.magnitude
        if fault := self.active(FaultKind.NOISY_ENCODER, now):
            position += abs(fault.magnitude) * float(self._random.standard_normal())
        if self.active(FaultKind.FLIPPED_SIGN, now):
            position, velocity = -position, -velocity
        if fault := self.active(FaultKind.SCALED_ENCODER, now):
            position, velocity = position * (1.0 + fault.magnitude), velocity * (1.0 + fault.magnitude)
        if fault := self.active(FaultKind.LYING_VELOCITY, now):
            velocity += fault.magnitude
        if self.active(FaultKind.LYING_TORQUE, now):
            torque = 0.0
        return position, velocity, torque
