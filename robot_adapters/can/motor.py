"""What the control loop needs of a motor's codec, whatever its family."""

from __future__ import annotations

from typing import Protocol

import can

from robot_adapters.can.mit_frames import FixedPoint, MitCommand, MotorFeedback, ParameterReply


class Motor(Protocol):
    """Codec of one motor that takes MIT commands and answers each with its feedback."""

    id: int
    torque_range: FixedPoint

    @property
    def answer_id(self) -> int:
        """Id of the frames with which the motor answers commands."""
        ...

    @property
    def reply_ids(self) -> tuple[int, ...]:
        """Ids of all frames that the motor sends."""
        ...

    @property
    def order_ids(self) -> tuple[int, ...]:
        """Ids of the frames that may tell it to do something."""
        ...

    def order(self, message: can.Message) -> str | None:
        """What a frame tells the motor to do, in words; None when it leaves the motor as it is."""
        ...

    def encode_mit(
        self, position: float, velocity: float, torque: float, kp: float, kd: float
    ) -> can.Message:
        """The MIT command frame [rad, rad/s, Nm, Nm/rad, Nm s/rad]; ValueError for a number that is not finite."""
        ...

    def decode_mit(self, message: can.Message) -> MitCommand | None:
        """What `encode_mit` put into the frame; None for any other frame."""
        ...

    def decode(self, message: can.Message) -> MotorFeedback | ParameterReply | None:
        """Feedback or a parameter of this motor; None for any other frame."""
        ...

    def fault(self, code: int) -> str | None:
        """Why a motor that reports this error code does not run; None when it runs."""
        ...
