"""The AIRBOT Play: which motors it has, how they are started and let go, and its gripper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import can

from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from robot_adapters.airbot.boards import Tool
from robot_adapters.airbot.gripper import MAX_OPENING
from robot_adapters.airbot.protocol import all_motors
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import AirbotIdentity, bring_up, identify, release
from robot_adapters.arm import ArmMode, ArmState, CommandResult, NotConnectedError, StartRefusedError
from robot_adapters.can.driver import CanArm
from robot_adapters.can.motor import Motor
from robot_adapters.can.settings import GripperMotor
from robot_adapters.clock import Clock

__all__ = ["AirbotArm", "ArmMode", "ArmState", "CommandResult", "NotConnectedError", "StartRefusedError"]


class AirbotArm(CanArm[AirbotIdentity]):
    """One AIRBOT Play on one bus. A context manager: `with AirbotArm("socketcan", "can0") as arm`.

    At the end its DM motors are disabled; OD motors only brake.
    """

    def __init__(
        self,
        interface: str = "socketcan",
        channel: str | None = None,
        *,
        settings: AirbotSettings | None = None,
        description: ArmDescription | None = None,
        clock: Clock | None = None,
        handle_signals: bool = True,
        **bus_options: Any,
    ) -> None:
        """Nothing is opened before `connect`.

        `interface` and `channel` are python-can's, `bus_options` go to it. `handle_signals` makes SIGINT and
        SIGTERM leave the motors safe before they do what they did before.
        """
        self.settings = settings or AirbotSettings()
        super().__init__(
            interface,
            channel,
            settings=self.settings,
            description=description or describe_arm("airbot_play"),
            clock=clock,
            handle_signals=handle_signals,
            **bus_options,
        )

    @property
    def max_opening(self) -> float | None:
        """The gripper's largest opening [m]; None where the end board has reported no gripper."""
        return None if self.identity is not None and self.identity.tool is not Tool.G2 else MAX_OPENING

    def _all_motors(self) -> Sequence[Motor]:
        return all_motors()

    def _identify(self, bus: can.BusABC) -> AirbotIdentity:
        return identify(bus, self.clock, self.settings)

    def _bring_up(self, bus: can.BusABC, identity: AirbotIdentity) -> list[float]:
        return bring_up(bus, self.clock, identity, self.settings)

    def _let_go(self, bus: can.BusABC, identity: AirbotIdentity) -> None:
        release(bus, identity.codecs, (*self.settings.final_damping, 0.0))

    def _gripper(self, identity: AirbotIdentity) -> GripperMotor | None:
        return self.settings.gripper() if identity.tool is Tool.G2 else None
