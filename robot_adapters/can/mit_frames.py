"""What the frames of MIT motors carry: fixed-point numbers, feedback, parameters and requests.

Everything here is shared by the codecs of the motor families and of an arm's boards. Angles are radians,
velocities rad/s, torques Nm in the motor's own units, temperatures degrees Celsius.
"""

from __future__ import annotations

import functools
import math
import struct
from dataclasses import dataclass
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

# Distance from a code at which float32 and float64 are certain to round alike: float32 is off by three
# roundings of 2^-24 each, times 2^16 codes.
_SURE = 0.48


@functools.lru_cache(maxsize=64)
def _code_values(low: float, high: float, bits: int) -> NDArray[np.float32]:
    top = np.float32((1 << bits) - 1)
    span = np.float32(high) - np.float32(low)
    return np.arange(1 << bits, dtype=np.float32) / top * span + np.float32(low)


class FixedPoint:
    """A number sent as `bits` bits, linear from [`low`, `high`] to [0, 2^bits - 1].

    Computed in float32 like in the motors.
    """

    __slots__ = ("_codes", "_low", "_span", "_top", "_values", "bits", "high", "low")

    def __init__(self, low: float, high: float, bits: int) -> None:
        """Raises ValueError unless `low` < `high` are finite."""
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"a fixed-point range needs finite low < high, got [{low}, {high}]")
        self.low, self.high, self.bits = float(low), float(high), bits
        self._low = np.float32(low)
        self._span = np.float32(high) - self._low
        self._top = np.float32((1 << bits) - 1)
        self._codes = ((1 << bits) - 1) / (self.high - self.low)
        self._values = _code_values(self.low, self.high, bits)

    def encode(self, value: float) -> int:
        """The nearest code, clamped to the range; `value` must be finite."""
        # Called thousands of times a second: comparisons are cheaper than min() and max().
        clamped = self.low if value < self.low else self.high if value > self.high else value
        code = (clamped - self.low) * self._codes
        nearest = int(code + 0.5)
        if abs(code - nearest) < _SURE:
            return nearest
        # So near the middle between two codes, float32's rounding decides.
        return int(np.rint((np.float32(clamped) - self._low) / self._span * self._top))

    def decode(self, code: int) -> float:
        """The float32 value of a code."""
        return self._values.item(code)

    @property
    def quantum(self) -> float:
        """The distance between two neighbouring codes."""
        return (self.high - self.low) / ((1 << self.bits) - 1)


KP = FixedPoint(0.0, 500.0, 12)  # both families send kp alike


@dataclass(frozen=True, slots=True)
class MotorFeedback:
    """What a motor reports after each command."""

    motor_id: int
    position: float
    velocity: float
    torque: float
    error: int
    motor_temperature: int
    mosfet_temperature: int


@dataclass(frozen=True, slots=True)
class ParameterReply:
    """A parameter as a motor or board reported it; `segment` counts from 1 where a value comes in pieces,
    else 0.

    `data` holds the bytes as they came, `value` what they mean where the register is known (a float may be
    NaN: the reader must check), and `written` is True when the frame acknowledges a write.
    """

    motor_id: int
    register: int
    data: bytes
    value: float | int | str | None = None
    segment: int = 0
    written: bool = False


@dataclass(frozen=True, slots=True)
class MitCommand:
    """One MIT command: torque = kp (position - q) + kd (velocity - dq) + feed-forward torque."""

    motor_id: int
    position: float
    velocity: float
    torque: float
    kp: float
    kd: float


@dataclass(frozen=True, slots=True)
class ParameterRequest:
    """A request to read a register or, with `data`, to write it; `segment` as in `ParameterReply`."""

    motor_id: int
    register: int
    data: bytes = b""
    segment: int = 0


def payload(message: can.Message) -> bytes | None:
    """The data bytes of a plain 11-bit data frame, None for error, remote and extended frames."""
    if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
        return None
    return bytes(message.data or b"")


class _Frame(can.Message):
    """A message that nobody changes once it is made."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        # python-can's virtual bus copies each message for each receiver; copying the bytes piece by piece is
        # a sixth of the time of a simulated arm.
        return self.__copy__()


def frame(arbitration_id: int, data: bytes) -> can.Message:
    """A classic CAN data frame with an 11-bit id."""
    return _Frame(arbitration_id=arbitration_id, data=data, is_extended_id=False)


def check_motor_id(motor_id: int) -> int:
    """The id itself; ValueError outside 0..0x7F, where the families' id offsets would overlap."""
    if not isinstance(motor_id, int) or not 0 <= motor_id <= 0x7F:
        raise ValueError(f"a motor or board id lies in 0..127, got {motor_id!r}")
    return motor_id


def check_finite(**values: float) -> None:
    """Raises ValueError that names the first value that is not a finite number."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} must be a finite number, got {value}")


def unpack(kind: str, data: bytes) -> float | int | str | None:
    """The value of `data` read as `kind`: a struct format, or "text"; None when there are too few bytes."""
    if kind == "text":
        return data.split(b"\0")[0].decode("ascii", errors="replace")
    size = struct.calcsize(kind)
    return struct.unpack(kind, data[:size])[0] if len(data) >= size else None
