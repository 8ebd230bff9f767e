"""Codecs of the AIRBOT Play's CAN bus: pure functions between values and `can.Message`.

`OdMotor` (joints 1 to 3) and `DmMotor` (joints 4 to 6 and the G2 gripper) have the same face: `encode_mit`
and the other commands make frames, `decode` reads what the motor sent. `Board` reads the base and end boards.
The motors' own side of the talk, `decode_mit`, `decode_request`, `encode_feedback` and the like, serves the
simulated arm and listeners on the bus. No decoder raises on any byte string of any length: what it does not
know is None.
"""

from __future__ import annotations

from robot_adapters.airbot.boards import BASE_BOARD_ID, END_BOARD_ID, Board, BoardRegister, Tool
from robot_adapters.airbot.gripper import motor_angle_from_opening, opening_from_motor_angle
from robot_adapters.airbot.od_motor import OdMotor, OdRegister
from robot_adapters.can.dm_motor import MIT_MODE, DmLifecycle, DmMotor, DmRegister
from robot_adapters.can.mit_frames import MitCommand, MotorFeedback, ParameterReply, ParameterRequest

__all__ = [
    "BASE_BOARD_ID",
    "END_BOARD_ID",
    "MIT_MODE",
    "OD_JOINTS",
    "Board",
    "BoardRegister",
    "DmLifecycle",
    "DmMotor",
    "DmRegister",
    "MitCommand",
    "Motor",
    "MotorFeedback",
    "OdMotor",
    "OdRegister",
    "ParameterReply",
    "ParameterRequest",
    "Tool",
    "all_motors",
    "motor_angle_from_opening",
    "opening_from_motor_angle",
]

Motor = OdMotor | DmMotor
OD_JOINTS, DM_JOINTS, GRIPPER_ID = (1, 2, 3), (4, 5, 6), 7


def all_motors() -> list[Motor]:
    """Codecs of every motor that an arm may have, with documented ranges."""
    return [*(OdMotor(i) for i in OD_JOINTS), *(DmMotor(i) for i in (*DM_JOINTS, GRIPPER_ID))]
