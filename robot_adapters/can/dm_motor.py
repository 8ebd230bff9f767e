"""Codec of the DM (Damiao) motors."""

from __future__ import annotations

import enum
import struct

import can

from robot_adapters.can.mit_frames import (
    KP,
    FixedPoint,
    MitCommand,
    MotorFeedback,
    ParameterReply,
    ParameterRequest,
    check_finite,
    check_motor_id,
    frame,
    payload,
    unpack,
)

DM_DISABLED, DM_ENABLED = 0, 1  # the two values of the error field that are states, not errors
# As public drivers of Damiao motors name them; some call 5 a sensor error.
DM_ERRORS = {
    3: "output encoder error",
    4: "sensor error",
    5: "encoder error",
    6: "parameter error",
    8: "over-voltage",
    9: "under-voltage",
    10: "over-current",
    11: "MOSFET over-temperature",
    12: "coil over-temperature",
    13: "communication lost",
    14: "overload",
}
_REQUEST_ID = 0x7FF
_READ, _WRITE, _SAVE, _PING = 0x33, 0x55, 0xAA, 0xCC
_OTHER_MODES = (0x100, 0x200, 0x300)  # offsets of the commands of the control modes beside MIT
MIT_MODE = 1


class DmRegister(enum.IntEnum):
    """Registers of a DM motor."""

    TIMEOUT = 0x09
    CONTROL_MODE = 0x0A
    FIRMWARE = 0x0E
    GEAR_RATIO = 0x14
    POS_MAX = 0x15
    VEL_MAX = 0x16
    TORQUE_MAX = 0x17


_DM_KINDS = {
    DmRegister.TIMEOUT: "<I",
    DmRegister.CONTROL_MODE: "<I",
    DmRegister.FIRMWARE: "text",
    DmRegister.GEAR_RATIO: "<f",
    DmRegister.POS_MAX: "<f",
    DmRegister.VEL_MAX: "<f",
    DmRegister.TORQUE_MAX: "<f",
}


class DmLifecycle(enum.IntEnum):
    """The last byte of a DM lifecycle frame."""

    CLEAR_ERROR = 0xFB
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE


class DmMotor:
    """Codec of one DM motor, whose ranges scale both its commands and its feedback.

    `pos_max` [rad], `vel_max` [rad/s] and `torque_max` [Nm] are what the motor reports in its registers of
    those names: read them from the motor, a wrong range silently scales every number. ValueError unless they
    are finite and positive. `answer_id` is the id of the frames with which the motor answers commands.
    """

    family = "dm"
    timeout_tick = 50e-6  # s, the unit of the register TIMEOUT, as public drivers of Damiao motors have it
    kd_range = FixedPoint(0.0, 5.0, 12)

    def __init__(
        self,
        motor_id: int,
        pos_max: float = 12.5,
        vel_max: float = 30.0,
        torque_max: float = 10.0,
        answer_id: int | None = None,
    ) -> None:
        """`answer_id` is what the motor is configured to answer under (its master id); by default 0x700 | `motor_id`."""
        self.id = check_motor_id(motor_id)
        self.answer_id = 0x700 | self.id if answer_id is None else answer_id
        self.position_range = FixedPoint(-pos_max, pos_max, 16)
        self.velocity_range = FixedPoint(-vel_max, vel_max, 12)
        self.torque_range = FixedPoint(-torque_max, torque_max, 12)

    def encode_mit(
        self, position: float, velocity: float, torque: float, kp: float, kd: float
    ) -> can.Message:
        """The MIT command frame; each number is clamped to its range, ValueError when one is not finite."""
        check_finite(position=position, velocity=velocity, torque=torque, kp=kp, kd=kd)
        bits = self.position_range.encode(position) << 48 | self.velocity_range.encode(velocity) << 36
        bits |= KP.encode(kp) << 24 | self.kd_range.encode(kd) << 12 | self.torque_range.encode(torque)
        return frame(self.id, bits.to_bytes(8, "big"))

    def decode_mit(self, message: can.Message) -> MitCommand | None:
        """What `encode_mit` put into the frame, as the motor reads it; None for a lifecycle frame."""
        data = payload(message)
        if data is None or message.arbitration_id != self.id or len(data) != 8:
            return None
        if self.decode_lifecycle(message) is not None:
            return None
        bits = int.from_bytes(data, "big")
        return MitCommand(
            self.id,
            self.position_range.decode(bits >> 48),
            self.velocity_range.decode(bits >> 36 & 0xFFF),
            self.torque_range.decode(bits & 0xFFF),
            KP.decode(bits >> 24 & 0xFFF),
            self.kd_range.decode(bits >> 12 & 0xFFF),
        )

    def decode(self, message: can.Message) -> MotorFeedback | ParameterReply | None:
        """Feedback or a parameter of this motor; None for any other frame.

        The two share an id. A frame that begins with the motor's id, 0x33 or 0x55 and a known register is a
        parameter: as feedback it would be a disabled motor at the very end of its position range.
        """
        data = payload(message)
        if data is None or message.arbitration_id != self.answer_id or len(data) != 8:
            return None
        if data[0] == self.id and data[1] == 0 and data[2] in (_READ, _WRITE) and data[3] in _DM_KINDS:
            value = unpack(_DM_KINDS[DmRegister(data[3])], data[4:])
            return ParameterReply(self.id, data[3], data[4:], value, written=data[2] == _WRITE)
        bits = int.from_bytes(data[1:6], "big")
        return MotorFeedback(
            self.id,
            self.position_range.decode(bits >> 24),
            self.velocity_range.decode(bits >> 12 & 0xFFF),
            self.torque_range.decode(bits & 0xFFF),
            data[0] >> 4,
            data[6],
            data[7],
        )

    def encode_feedback(self, feedback: MotorFeedback) -> can.Message:
        """The frame with which the motor reports; temperatures are clamped to a byte."""
        bits = self.position_range.encode(feedback.position) << 24
        bits |= self.velocity_range.encode(feedback.velocity) << 12 | self.torque_range.encode(
            feedback.torque
        )
        temperatures = (feedback.motor_temperature, feedback.mosfet_temperature)
        tail = bytes(min(max(value, 0), 255) for value in temperatures)
        head = bytes([(feedback.error & 0xF) << 4 | self.id & 0xF])
        return frame(self.answer_id, head + bits.to_bytes(5, "big") + tail)

    def lifecycle(self, action: DmLifecycle) -> can.Message:
        """The frame that enables, disables, zeroes the motor or clears its error."""
        return frame(self.id, b"\xff" * 7 + bytes([action]))

    def decode_lifecycle(self, message: can.Message) -> DmLifecycle | None:
        """The action of a lifecycle frame for this motor; None for any other frame."""
        data = payload(message)
        if data is None or message.arbitration_id != self.id or len(data) != 8 or data[:7] != b"\xff" * 7:
            return None
        return DmLifecycle(data[7]) if data[7] in DmLifecycle.__members__.values() else None

    @property
    def reply_ids(self) -> tuple[int, ...]:
        """Ids of all frames that the motor sends."""
        return (self.answer_id,)

    @property
    def order_ids(self) -> tuple[int, ...]:
        """Ids of the frames that may tell the motor to do something."""
        return self.id, *(offset | self.id for offset in _OTHER_MODES), _REQUEST_ID

    def order(self, message: can.Message) -> str | None:
        """What a frame tells the motor to do, in words; None when it leaves the motor as it is."""
        data = payload(message)
        if data is None:
            return None
        if message.arbitration_id == self.id and len(data) == 8:
            action = self.decode_lifecycle(message)
            return "MIT command" if action is None else f"{action.name} frame"
        if message.arbitration_id in self.order_ids[1:-1] and len(data) >= 4:
            return "command of another control mode"
        if message.arbitration_id == _REQUEST_ID and data[:2] == bytes([self.id, 0]) and len(data) >= 4:
            return f"write of register 0x{data[3]:02X}" if data[2] in (_WRITE, _SAVE) else None
        return None

    def fault(self, code: int) -> str | None:
        """Why a motor that reports this error code does not run; None when it runs."""
        if code == DM_ENABLED:
            return None
        return "disabled" if code == DM_DISABLED else DM_ERRORS.get(code, f"unknown error {code}")

    def ping(self) -> can.Message:
        """The frame that a motor answers with its feedback without moving."""
        return frame(_REQUEST_ID, bytes([self.id, 0, _PING, 0]))

    def request(self, register: int) -> can.Message:
        """The frame that asks for a register; the answer is a `ParameterReply`."""
        return frame(_REQUEST_ID, bytes([self.id, 0, _READ, register]))

    def write(self, register: DmRegister, value: float) -> can.Message:
        """The frame that writes a number into a register; ValueError for a register that holds text."""
        kind = _DM_KINDS[DmRegister(register)]
        if kind == "text":
            raise ValueError(f"register {DmRegister(register).name} holds text and is read only")
        packed = struct.pack(kind, value if kind == "<f" else int(value))
        return frame(_REQUEST_ID, bytes([self.id, 0, _WRITE, register]) + packed)

    def decode_request(self, message: can.Message) -> ParameterRequest | None:
        """The register that a frame asks this motor for, or wants written; None for any other frame."""
        data = payload(message)
        if (
            data is None
            or message.arbitration_id != _REQUEST_ID
            or len(data) < 4
            or data[:2] != bytes([self.id, 0])
        ):
            return None
        if data[2] == _READ:
            return ParameterRequest(self.id, data[3])
        return ParameterRequest(self.id, data[3], data[4:8]) if data[2] == _WRITE and len(data) == 8 else None

    def is_ping(self, message: can.Message) -> bool:
        """Whether the frame pings this motor."""
        data = payload(message)
        return (
            message.arbitration_id == _REQUEST_ID
            and data is not None
            and data[:3] == bytes([self.id, 0, _PING])
        )

    def encode_parameter(self, register: int, data: bytes, written: bool = False) -> can.Message:
        """The motor's answer to a request: the register's four bytes."""
        head = bytes([self.id, 0, _WRITE if written else _READ, register])
        return frame(self.answer_id, head + data[:4].ljust(4, b"\0"))
