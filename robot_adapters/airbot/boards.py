"""Codec of the base board and the end board: registers read in segments of four bytes, and the light."""

from __future__ import annotations

import enum

import can

from robot_adapters.can.mit_frames import (
    ParameterReply,
    ParameterRequest,
    check_motor_id,
    frame,
    payload,
    unpack,
)

BASE_BOARD_ID, END_BOARD_ID = 0x00, 0x08


class BoardRegister(enum.IntEnum):
    """Registers of the boards: TOOL_TYPE on the end board, the others from 0x04 on the base board."""

    FIRMWARE = 0x02
    SERIAL = 0x03
    PRODUCT_SERIAL = 0x04
    TOOL_TYPE = 0x05
    NAME = 0x07
    ZERO_POSITION = 0x0C
    VOLTAGE = 0x12
    LIGHT = 0x15
    GRAVITY_FACTORS = 0x17


class Tool(enum.IntEnum):
    """What the end board reports to be mounted."""

    NONE = 0
    E2B = 2
    G2 = 3


SEGMENTS = {
    BoardRegister.FIRMWARE: 1,
    BoardRegister.SERIAL: 4,
    BoardRegister.PRODUCT_SERIAL: 4,
    BoardRegister.TOOL_TYPE: 1,
    BoardRegister.NAME: 6,
    BoardRegister.ZERO_POSITION: 6,
    BoardRegister.VOLTAGE: 1,
    BoardRegister.GRAVITY_FACTORS: 24,
}
_KINDS = {
    BoardRegister.SERIAL: "text",
    BoardRegister.PRODUCT_SERIAL: "text",
    BoardRegister.TOOL_TYPE: "<I",
    BoardRegister.NAME: "text",
    BoardRegister.ZERO_POSITION: "<f",
    BoardRegister.VOLTAGE: "<f",
    BoardRegister.GRAVITY_FACTORS: "<f",
}
# Where the six gravity factors of a tool begin among the 24; the last six serve any other tool.
GRAVITY_FACTOR_OFFSET = {Tool.NONE: 0, Tool.E2B: 6, Tool.G2: 12}


class Board:
    """Codec of one board. Values of several segments come as one `ParameterReply` per segment, numbered from
    1.
    """

    def __init__(self, board_id: int) -> None:
        self.id = check_motor_id(board_id)

    def request(self, register: int) -> can.Message:
        """The frame that asks for a register."""
        return frame(self.id, bytes([register]))

    def light(self, effect: int) -> can.Message:
        """The frame that sets the light's effect, 0 to 255."""
        return frame(0x80 | self.id, bytes([BoardRegister.LIGHT, 1, effect & 0xFF]))

    def decode(self, message: can.Message) -> ParameterReply | None:
        """One segment of a register of this board; None for any other frame."""
        data = payload(message)
        if data is None or message.arbitration_id != 0x100 | self.id or len(data) < 3:
            return None
        kind = _KINDS.get(data[0])  # type: ignore[call-overload]
        value = unpack(kind, data[2:6]) if kind else None
        return ParameterReply(self.id, data[0], data[2:6], value, segment=data[1])

    def decode_request(self, message: can.Message) -> ParameterRequest | None:
        """The register that a frame asks this board for, or wants written; None for any other frame."""
        data = payload(message)
        if data is None:
            return None
        if message.arbitration_id == self.id and len(data) == 1:
            return ParameterRequest(self.id, data[0])
        if message.arbitration_id == 0x80 | self.id and len(data) >= 3:
            return ParameterRequest(self.id, data[0], data[2:6], segment=data[1])
        return None

    def encode_parameter(self, register: int, data: bytes) -> list[can.Message]:
        """The board's answer to a request: as many segments of four bytes as `data` needs."""
        pieces = [data[start : start + 4] for start in range(0, max(len(data), 1), 4)]
        return [
            frame(0x100 | self.id, bytes([register, number]) + piece)
            for number, piece in enumerate(pieces, start=1)
        ]
