"""Codec of the OD motors, joints 1 to 3 of the AIRBOT Play."""

from __future__ import annotations

import enum

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

# As public drivers of ENCOS motors name them, whose frames these are; the maker's document V1.14 numbers three anew.
OD_ERRORS = {
    1: "motor over-temperature",
    2: "over-current",
    3: "under-voltage (newer firmware: over-voltage)",
    4: "encoder error (newer firmware: under-voltage)",
    5: "encoder error",
    6: "brake over-voltage",
    7: "driver error",
}


# The frames to this id: motor id (two bytes, big-endian), 0, then for example 0x03, which sets the zero.
_CONFIGURATION_ID = 0x7FF


class OdRegister(enum.IntEnum):
    """Registers of an OD motor; those above 0x80 answer in one frame from the motor's own id."""

    BOARD_ID = 0x00
    FIRMWARE = 0x02
    SERIAL = 0x03
    POSITION = 0xE1
    VELOCITY = 0xE2
    TORQUE = 0xE3
    TIMEOUT = 0xF3


_OD_KINDS = {
    OdRegister.BOARD_ID: "<B",
    OdRegister.SERIAL: "text",
    OdRegister.POSITION: ">f",
    OdRegister.VELOCITY: ">f",
    OdRegister.TORQUE: ">f",
    OdRegister.TIMEOUT: ">I",
}


class OdMotor:
    """Codec of one OD motor. It needs no enabling and reports no MOSFET temperature (always 0).

    OD registers up to 0x80 answer from 0x100 | id in segments of four bytes, those above in one frame whose
    floats are big-endian; the position among them is in degrees.
    """

    family = "od"
    # s, the unit of the register TIMEOUT. Deduced: the vendor's public driver expects 500 in it, which can only
    # be milliseconds.
    timeout_tick = 1e-3
    position_range = FixedPoint(-12.5, 12.5, 16)
    velocity_range = FixedPoint(-18.0, 18.0, 12)
    torque_range = FixedPoint(-30.0, 30.0, 12)
    kd_range = FixedPoint(0.0, 50.0, 9)

    def __init__(self, motor_id: int) -> None:
        self.id = check_motor_id(motor_id)

    def encode_mit(
        self, position: float, velocity: float, torque: float, kp: float, kd: float
    ) -> can.Message:
        """The MIT command frame; each number is clamped to its range, ValueError when one is not finite."""
        check_finite(position=position, velocity=velocity, torque=torque, kp=kp, kd=kd)
        bits = (
            KP.encode(kp) << 49 | self.kd_range.encode(kd) << 40 | self.position_range.encode(position) << 24
        )
        bits |= self.velocity_range.encode(velocity) << 12 | self.torque_range.encode(torque)
        return frame(self.id, bits.to_bytes(8, "big"))

    def decode_mit(self, message: can.Message) -> MitCommand | None:
        """What `encode_mit` put into the frame, as the motor reads it."""
        data = payload(message)
        if data is None or message.arbitration_id != self.id or len(data) != 8 or data[0] >> 5:
            return None
        bits = int.from_bytes(data, "big")
        return MitCommand(
            self.id,
            self.position_range.decode(bits >> 24 & 0xFFFF),
            self.velocity_range.decode(bits >> 12 & 0xFFF),
            self.torque_range.decode(bits & 0xFFF),
            KP.decode(bits >> 49 & 0xFFF),
            self.kd_range.decode(bits >> 40 & 0x1FF),
        )

    def decode(self, message: can.Message) -> MotorFeedback | ParameterReply | None:
        """Feedback or a parameter of this motor; None for any other frame."""
        data = payload(message)
        if data is None:
            return None
        if message.arbitration_id == 0x100 | self.id and len(data) >= 3:
            register = data[0]
            value = unpack(_OD_KINDS[OdRegister(register)], data[2:6]) if register in _OD_KINDS else None
            return ParameterReply(self.id, register, data[2:6], value, segment=data[1])
        if message.arbitration_id != self.id or len(data) < 6:
            return None
        kind = data[0] >> 5
        if kind == 5 and len(data) == 6:
            register = (0xE0 + data[1]) & 0xFF
            value = unpack(_OD_KINDS[OdRegister(register)], data[2:6]) if register in _OD_KINDS else None
            return ParameterReply(self.id, register, data[2:6], value)
        # Eight bytes that end in binary 01 under the same top bits are a position-velocity request on its way
        # in.
        if kind != 1 or len(data) < 7 or (len(data) == 8 and data[7] & 3 == 1):
            return None
        bits = int.from_bytes(data[1:6], "big")
        return MotorFeedback(
            self.id,
            self.position_range.decode(bits >> 24),
            self.velocity_range.decode(bits >> 12 & 0xFFF),
            self.torque_range.decode(bits & 0xFFF),
            data[0] & 0x1F,
            max(0, (data[6] - 50) // 2),
            0,
        )

    def encode_feedback(self, feedback: MotorFeedback) -> can.Message:
        """The frame with which the motor reports; temperatures are clamped to what the byte can hold."""
        bits = self.position_range.encode(feedback.position) << 24
        bits |= self.velocity_range.encode(feedback.velocity) << 12 | self.torque_range.encode(
            feedback.torque
        )
        temperature = min(max(round(feedback.motor_temperature * 2 + 50), 0), 255)
        head = bytes([0x20 | feedback.error & 0x1F])
        return frame(self.id, head + bits.to_bytes(5, "big") + bytes([temperature]))

    @property
    def answer_id(self) -> int:
        """Id of the frames with which the motor answers commands: that of the commands."""
        return self.id

    @property
    def reply_ids(self) -> tuple[int, ...]:
        """Ids of all frames that the motor sends: feedback and registers above 0x80, registers below."""
        return self.id, 0x100 | self.id

    def fault(self, code: int) -> str | None:
        """Why a motor that reports this error code does not run; None when it runs."""
        return None if code == 0 else OD_ERRORS.get(code, f"unknown error {code}")

    @property
    def order_ids(self) -> tuple[int, ...]:
        """Ids of the frames that may tell the motor to do something."""
        return self.id, 0x80 | self.id, _CONFIGURATION_ID

    def order(self, message: can.Message) -> str | None:
        """What a frame tells the motor to do, in words; None when it leaves the motor as it is.

        Commands of its velocity and current modes have the length of an answer. A damaged answer must not be
        taken for one, so that they are none here.
        """
        data = payload(message)
        if data is None:
            return None
        if message.arbitration_id == 0x80 | self.id and len(data) >= 3:
            return f"write of register 0x{data[0]:02X}"
        if (
            message.arbitration_id == _CONFIGURATION_ID
            and data[:3] == bytes([0, self.id, 0])
            and len(data) >= 4
        ):
            return f"configuration frame 0x{data[3]:02X}"
        if message.arbitration_id != self.id or len(data) not in (6, 8):
            return None
        kind = data[0] >> 5
        if len(data) == 6:
            return "configuration frame" if kind == 6 else None
        if kind == 0:
            return "MIT command"
        return "position-velocity command" if kind == 1 and data[7] & 3 == 1 else None

    def request(self, register: int) -> can.Message:
        """The frame that asks for a register; the answer is a `ParameterReply`."""
        if register > 0x80:
            return frame(self.id, bytes([0xE0, register - 0xE0 & 0xFF]))
        return frame(self.id, bytes([register]))

    def write(self, register: int, value: int) -> can.Message:
        """The frame that writes a whole number into a register.

        The form is documented for registers up to 0x80; that those above take it is to be confirmed on a real
        arm: read the register afterwards.
        """
        return frame(0x80 | self.id, bytes([register, 1]) + int(value).to_bytes(4, "big"))

    def decode_request(self, message: can.Message) -> ParameterRequest | None:
        """The register that a frame asks this motor for, or wants written; None for any other frame."""
        data = payload(message)
        if data is None:
            return None
        if message.arbitration_id == 0x80 | self.id and len(data) >= 3:
            return ParameterRequest(self.id, data[0], data[2:6], segment=data[1])
        if message.arbitration_id != self.id:
            return None
        if len(data) == 1:
            return ParameterRequest(self.id, data[0])
        if len(data) == 2 and data[0] == 0xE0:
            return ParameterRequest(self.id, (0xE0 + data[1]) & 0xFF)
        return None

    def encode_parameter(self, register: int, data: bytes, segment: int = 1) -> can.Message:
        """The motor's answer to a request: four bytes for a register above 0x80, up to four of one segment
        below.
        """
        if register > 0x80:
            return frame(self.id, bytes([0xA0, register - 0xE0 & 0xFF]) + data[:4].ljust(4, b"\0"))
        return frame(0x100 | self.id, bytes([register, segment]) + data[:4])
