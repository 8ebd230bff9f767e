"""Faults of a CAN bus and its motors, on request or drawn from a seed, for the simulated arm to suffer."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import can
import numpy as np


class FaultKind(enum.StrEnum):
    """What can go wrong."""

    DROPPED = "dropped"
    DELAYED = "delayed"
    DUPLICATED = "duplicated"
    CORRUPTED = "corrupted"
    SILENT_MOTOR = "silent_motor"
    MOTOR_ERROR = "motor_error"
    BUS_OFF = "bus_off"
    OVER_TEMPERATURE = "over_temperature"
    WRONG_RANGES = "wrong_ranges"
    CONTROL_MODE = "control_mode"
    OTHER_MASTER = "other_master"  # somebody else commands a motor
    LIMP_MASTER = "limp_master"  # somebody else takes a motor's stiffness
    HIDDEN_MASTER = (
        "hidden_master"  # somebody else commands a motor behind a filter: only its answers are seen
    )
    ONE_ORDER = "one_order"  # somebody else sends one command, lifecycle frame or write
    REPLAYED = "replayed"  # somebody sends our own commands again, 0.3 s late
    SECOND_DRIVER = "second_driver"
    BUSY_BUS = "busy_bus"  # foreign traffic for nobody here fills the bus
    REBOOTED = "rebooted"  # a motor restarts
    FROZEN = "frozen"  # the driver's process stands still, then goes on
    KILLED = "killed"
    # What a joint's sensors report; see `sensor_faults`.
    STUCK_ENCODER = "stuck_encoder"
    JUMPED_ENCODER = "jumped_encoder"
    SATURATED_ENCODER = "saturated_encoder"
    DRIFTING_ENCODER = "drifting_encoder"
    NOISY_ENCODER = "noisy_encoder"
    FLIPPED_SIGN = "flipped_sign"
    SCALED_ENCODER = "scaled_encoder"
    SLIPPED_ZERO = "slipped_zero"
    SWAPPED_FEEDBACK = "swapped_feedback"
    LYING_VELOCITY = "lying_velocity"
    LYING_TORQUE = "lying_torque"
    HEATING = "heating"


# What happens around the arm and its frames: acted out by `disturbances`.
DISTURBANCES = (
    FaultKind.OTHER_MASTER,
    FaultKind.LIMP_MASTER,
    FaultKind.HIDDEN_MASTER,
    FaultKind.ONE_ORDER,
    FaultKind.REPLAYED,
    FaultKind.SECOND_DRIVER,
    FaultKind.BUSY_BUS,
    FaultKind.REBOOTED,
    FaultKind.FROZEN,
    FaultKind.KILLED,
)


@dataclass(frozen=True)
class Fault:
    """One fault.

    It lasts from `start` for `duration` [s, the arm's clock]. `motor_id` None means every motor. `rate` is
    the fraction of frames that a frame fault strikes. `magnitude` is the delay [s] of DELAYED, the error code of
    MOTOR_ERROR, the temperature of OVER_TEMPERATURE, the mode that a DM motor is in for CONTROL_MODE, the
    commands per second of another master and, for WRONG_RANGES, the factor on the ranges that a motor reports;
    for the kinds that strike sensors `sensor_faults` says what it is.
    """

    kind: FaultKind
    motor_id: int | None = None
    start: float = 0.0
    duration: float = math.inf
    rate: float = 1.0
    magnitude: float = 0.0

    def strikes(self, motor_id: int, now: float) -> bool:
        """Whether the fault is on for a motor at a time."""
        return self.motor_id in (None, motor_id) and self.start <= now < self.start + self.duration


class FaultInjector:
    """Applies faults to the frames of a simulated arm; the same seed strikes the same frames."""

    def __init__(self, faults: Iterable[Fault] = (), seed: int = 0) -> None:
        self.faults = list(faults)
        self._random = np.random.default_rng(seed)

    def active(self, kind: FaultKind, motor_id: int, now: float) -> Fault | None:
        """The first fault of a kind that strikes a motor now."""
        for fault in self.faults:
            if fault.kind is kind and fault.strikes(motor_id, now):
                return fault
        return None

    def bus_off(self, now: float) -> bool:
        """Whether no frame crosses the bus now."""
        return any(fault.kind is FaultKind.BUS_OFF and fault.strikes(0, now) for fault in self.faults)

    def hears(self, motor_id: int, now: float) -> bool:
        """Whether a frame on the bus reaches a motor now."""
        if not self.faults:
            return True
        if self.bus_off(now) or self.active(FaultKind.SILENT_MOTOR, motor_id, now):
            return False
        return not self._struck(FaultKind.DROPPED, motor_id, now)

    def replies(
        self, message: can.Message, motor_id: int, due: float, now: float
    ) -> list[tuple[float, can.Message]]:
        """What becomes of a frame that a motor sends at `due`: (time, frame) of each that reaches the bus."""
        if not self.faults:
            return [(due, message)]
        if self._struck(FaultKind.DROPPED, motor_id, now):
            return []
        late = self._struck(FaultKind.DELAYED, motor_id, now)
        if late:
            due += late.magnitude
        if self._struck(FaultKind.CORRUPTED, motor_id, now):
            message = self._corrupted(message)
        return [(due, message)] * (2 if self._struck(FaultKind.DUPLICATED, motor_id, now) else 1)

    def _struck(self, kind: FaultKind, motor_id: int, now: float) -> Fault | None:
        fault = self.active(kind, motor_id, now)
        return fault if fault and self._random.random() < fault.rate else None

    def _corrupted(self, message: can.Message) -> can.Message:
        """One to eight bits flipped, or the frame cut short."""
        data = bytearray(message.data)
        if self._random.random() < 0.3:
            data = data[: self._random.integers(len(data))]
        else:
            for bit in self._random.integers(8 * len(data), size=self._random.integers(1, 9)):
                data[bit // 8] ^= 1 << bit % 8
        return can.Message(arbitration_id=message.arbitration_id, data=bytes(data), is_extended_id=False)


MOTOR_ERRORS = {"od": (1, 2, 3, 4, 6, 7), "dm": (8, 9, 10, 11, 12, 13, 14)}

# Of the faults drawn from a seed, up to their sign.
SENSOR_MAGNITUDES = {
    FaultKind.STUCK_ENCODER: (1.0, 1.0),
    FaultKind.JUMPED_ENCODER: (0.1, 3.0),
    FaultKind.SATURATED_ENCODER: (1.0, 1.0),
    FaultKind.DRIFTING_ENCODER: (0.15, 1.0),
    FaultKind.NOISY_ENCODER: (0.01, 0.5),
    FaultKind.FLIPPED_SIGN: (1.0, 1.0),
    FaultKind.SCALED_ENCODER: (0.1, 0.4),
    FaultKind.SLIPPED_ZERO: (0.1, 1.0),
    FaultKind.SWAPPED_FEEDBACK: (1.0, 1.0),
    FaultKind.LYING_VELOCITY: (0.3, 3.0),
    FaultKind.LYING_TORQUE: (1.0, 1.0),
    FaultKind.HEATING: (100.0, 300.0),
}
SENSOR_FAULTS = tuple(SENSOR_MAGNITUDES)
"""The kinds that strike what a joint's motor reports, for good."""


def random_fault(
    random: np.random.Generator, start: float, kinds: Sequence[FaultKind] = tuple(FaultKind)
) -> Fault:
    """Draw a fault of one of `kinds` that begins at `start`: mild to severe, 20 ms to 1.15 s long."""
    kind = kinds[int(random.integers(len(kinds)))]
    motor_id: int | None = int(random.integers(1, 7))
    duration = float(random.choice((0.02, 0.06, 0.15, 0.4, 1.15)))
    rate, magnitude = 1.0, 0.0
    if kind in (FaultKind.DROPPED, FaultKind.DELAYED, FaultKind.DUPLICATED, FaultKind.CORRUPTED):
        rate = float(random.uniform(0.05, 1.0))
        motor_id = motor_id if random.random() < 0.5 else None
        magnitude = float(random.uniform(0.002, 0.2)) if kind is FaultKind.DELAYED else 0.0
    elif kind is FaultKind.SILENT_MOTOR:
        motor_id = int(random.integers(1, 8))  # the gripper's too
    elif kind is FaultKind.MOTOR_ERROR:
        magnitude = float(random.choice(MOTOR_ERRORS["od" if motor_id in (1, 2, 3) else "dm"]))
        duration = math.inf
    elif kind is FaultKind.OVER_TEMPERATURE:
        magnitude, duration = float(random.uniform(90.0, 100.0)), math.inf
    elif kind is FaultKind.WRONG_RANGES:
        motor_id = int(random.integers(4, 7))
        magnitude = float(random.choice((math.nan, 0.0, -1.0, 0.5, 0.7, 1.4, 2.0)))
        start, duration = 0.0, math.inf
    elif kind is FaultKind.CONTROL_MODE:
        motor_id, magnitude = int(random.integers(4, 8)), float(random.integers(2, 5))
        duration = math.inf
    elif kind in DISTURBANCES:
        motor_id, magnitude, start, duration = _random_disturbance(random, kind, start, duration)
    elif kind is FaultKind.BUS_OFF:
        motor_id = None
    elif kind in SENSOR_FAULTS:
        duration = math.inf
        magnitude = float(random.choice((-1.0, 1.0)) * random.uniform(*SENSOR_MAGNITUDES[kind]))
    return Fault(kind, motor_id, start, duration, rate, magnitude)


def _random_disturbance(
    random: np.random.Generator, kind: FaultKind, start: float, duration: float
) -> tuple[int, float, float, float]:
    """Motor, frames a second, start and duration."""
    motor_id = int(random.integers(4 if kind is FaultKind.REBOOTED else 1, 8))
    rate = float(random.choice((20.0, 50.0, 250.0)))
    if kind in (FaultKind.OTHER_MASTER, FaultKind.HIDDEN_MASTER):
        # A third of them are there before the driver; one that only shows in answers takes its time to show.
        start = 0.0 if random.random() < 0.33 else start
        duration = 1.15
    elif kind is FaultKind.KILLED:
        duration = math.inf
    return motor_id, rate, start, duration
