"""Read-only checks of an AIRBOT Play on its bus: masters, boards, motors, ranges, errors and temperatures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from robot_adapters.airbot.startup import AirbotIdentity, RangeError, identify, other_master, read_tool
from robot_adapters.can.bus import ask, open_bus
from robot_adapters.can.dm_motor import DM_ENABLED, DM_ERRORS, DmMotor
from robot_adapters.can.mit_frames import MotorFeedback
from robot_adapters.checks import Check, CheckFailed
from robot_adapters.clock import Clock
from robot_adapters.safety import SafetyLimits


class AirbotChecks:
    """The checks of one arm; the bus is opened by the first."""

    def __init__(self, interface: str, channel: str | None, clock: Clock) -> None:
        self.interface, self.channel, self._clock = interface, channel, clock
        self._bus: Any = None
        self._identity: AirbotIdentity | None = None

    def checks(self) -> Sequence[Check]:
        """From the bus to the motors."""
        return [
            Check("bus", self._open),
            Check("other masters", self._alone, "bus"),
            Check("boards", self._boards, "bus"),
            Check("motors", self._motors, "boards"),
            Check("ranges", self._ranges, "motors"),
            Check("errors and temperatures", self._health, "motors"),
        ]

    def joints(self) -> list[float]:
        """The measured joints [rad], once the motors have answered."""
        return [each.position for each in self._known().motors if each.motor.id <= 6]

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.shutdown()

    def _known(self) -> AirbotIdentity:
        if self._identity is None:
            raise RuntimeError("the motors have not been identified")
        return self._identity

    def _open(self) -> str:
        try:
            self._bus = open_bus(self.interface, self.channel)
        except OSError as error:
            detail, _, remedy = str(error).partition("; ")
            raise CheckFailed(detail, remedy or "check the interface and the channel") from error
        return f"{self.interface} {self.channel or ''}".strip() + " is open"

    def _alone(self) -> str:
        other = other_master(self._bus, self._clock)
        if other is not None:
            raise CheckFailed(other.detail, other.remedy)
        return "nobody else commands the motors"

    def _boards(self) -> str:
        try:
            tool = read_tool(self._bus, self._clock)
        except (OSError, ValueError) as error:
            raise CheckFailed(
                str(error), "power the arm on; check cable, termination (120 Ohm) and the bitrate of 1 Mbit/s"
            ) from error
        return f"the end board answers; tool {tool.name}"

    def _motors(self) -> str:
        try:
            self._identity = identify(self._bus, self._clock)
        except RangeError as error:
            detail, _, remedy = str(error).partition("; ")
            raise CheckFailed(detail, remedy) from error
        except OSError as error:
            raise CheckFailed(
                str(error),
                "check the cable behind the last motor that answers, then power the arm off and on",
            ) from error
        found = self._identity
        return f"{len(found.motors)} motors; {found.name or 'unnamed'} {found.serial}, {found.voltage:.1f} V"

    def _ranges(self) -> str:
        ranges = [
            f"{each.motor.id}: ±{each.motor.position_range.high:g} rad"
            for each in self._known().motors
            if isinstance(each.motor, DmMotor)
        ]
        return "reported and plausible, " + ", ".join(ranges)

    def _health(self) -> str:
        limits, seen = SafetyLimits(), []
        for each in self._known().motors:
            if not isinstance(each.motor, DmMotor):
                continue  # OD motors tell their temperature only when commanded
            feedback = ask(
                self._bus, self._clock, each.motor.ping(), _feedback_of(each.motor), f"motor {each.motor.id}"
            )
            if feedback.error > DM_ENABLED:
                name = DM_ERRORS.get(feedback.error, f"error {feedback.error}")
                raise CheckFailed(
                    f"motor {each.motor.id} reports {name}", "clear the cause, then power the arm off and on"
                )
            hot = feedback.motor_temperature > limits.max_motor_temperature
            if hot or feedback.mosfet_temperature > limits.max_mosfet_temperature:
                raise CheckFailed(
                    f"motor {each.motor.id}: {feedback.motor_temperature} C, electronics "
                    f"{feedback.mosfet_temperature} C",
                    "let the arm cool down; reduce payload and outstretched poses",
                )
            seen.append(f"{each.motor.id}: {feedback.motor_temperature} C")
        return "no error; " + ", ".join(seen) + " (OD motors report theirs only when enabled)"


def _feedback_of(motor: DmMotor) -> Callable[[Any], MotorFeedback | None]:
    def accept(message: Any) -> MotorFeedback | None:
        reply = motor.decode(message)
        return reply if isinstance(reply, MotorFeedback) else None

    return accept
