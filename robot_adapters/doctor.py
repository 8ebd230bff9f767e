"""Read-only checks of an installation, a bus, an arm and a checkpoint, each with a remedy for its failure.

Checks run in layers, from the computer to the arm; what rests on a failed one is skipped. Nothing is enabled,
moved or written.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import IDENTITY, PoseFormat, compose, decode_pose, pose_distance
from robot_adapters.airbot.protocol import DmMotor, MotorFeedback
from robot_adapters.airbot.startup import ArmIdentity, RangeError, identify, other_master
from robot_adapters.can.bus import ask, open_bus
from robot_adapters.can.dm_motor import DM_ERRORS
from robot_adapters.clock import RealClock
from robot_adapters.safety import SafetyLimits

_LIKELY_POSITION, _LIKELY_ROTATION = 0.005, 0.03  # m, rad: between FK and another's word on the same pose


class Outcome(enum.StrEnum):
    """How a check ended."""

    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Finding:
    """One check: its name, how it ended, what was seen, and what to do where it failed."""

    check: str
    outcome: Outcome
    detail: str
    remedy: str = ""


class CheckFailed(Exception):  # noqa: N818 - the outcome of a check, not an error of the program
    """A check did not pass: what was seen, and the remedy."""

    def __init__(self, detail: str, remedy: str) -> None:
        super().__init__(detail)
        self.detail, self.remedy = detail, remedy


@dataclass
class DoctorOptions:
    """What to check.

    Attributes:
        interface, channel: python-can's; empty: no bus and no arm. `virtual` is a simulated arm of its own.
        policy_path: a MimicIK checkpoint; empty: none.
        reported_pose: `T_base_tool` that the vendor's software or a ruler reports for the arm as it stands,
            (7,); empty: not compared.
        tool: pose of that tool in the end link, (7,); empty: the end link itself.
    """

    interface: str = ""
    channel: str | None = None
    policy_path: str = ""
    reported_pose: Sequence[float] = ()
    tool: Sequence[float] = ()


class Doctor:
    """Runs the checks in order; `findings` grows as they end."""

    def __init__(self, options: DoctorOptions) -> None:
        self.options = options
        self.findings: list[Finding] = []
        self._description = describe_arm("airbot_play")
        self._policy: Any = None
        self._bus: Any = None
        self._simulation: Any = None
        self._identity: ArmIdentity | None = None
        self._clock = RealClock()

    def run(self, report: Callable[[Finding], None] = lambda finding: None) -> list[Finding]:
        """All checks; `report` is told of each as it ends."""
        options = self.options
        bus, arm, policy = bool(options.interface), "motors", bool(options.policy_path)
        checks: list[tuple[str, Callable[[], str], bool, str]] = [
            ("plugin", self._plugin, True, ""),
            ("URDF and joint order", self._urdf, True, ""),
            ("checkpoint", self._checkpoint, policy, "plugin"),
            ("checkpoint against robot", self._match, policy, "checkpoint"),
            ("bus", self._open, bus, ""),
            ("other masters", self._alone, bus, "bus"),
            ("boards", self._boards, bus, "bus"),
            ("motors", self._motors, bus, "boards"),
            ("ranges", self._ranges, bus, arm),
            ("errors and temperatures", self._health, bus, arm),
            ("joint limits", self._limits, bus, arm),
            ("FK against the reported pose", self._pose, bus and len(options.reported_pose) > 0, arm),
        ]
        try:
            for name, check, wanted, needs in checks:
                if wanted:
                    finding = self._run(name, check, needs)
                    self.findings.append(finding)
                    report(finding)
        finally:
            self._close()
        return self.findings

    def _run(self, name: str, check: Callable[[], str], needs: str) -> Finding:
        if any(f.check == needs and f.outcome is not Outcome.OK for f in self.findings):
            return Finding(name, Outcome.SKIPPED, f"needs: {needs}")
        try:
            return Finding(name, Outcome.OK, check())
        except CheckFailed as failed:
            return Finding(name, Outcome.FAILED, failed.detail, failed.remedy)
        except Exception as error:  # a doctor that dies of what it finds helps nobody
            return Finding(name, Outcome.FAILED, f"{type(error).__name__}: {error}")

    def _plugin(self) -> str:
        from lerobot.configs import PreTrainedConfig
        from lerobot.robots.config import RobotConfig
        from lerobot.utils.import_utils import register_third_party_plugins

        register_third_party_plugins()
        known = [*PreTrainedConfig.get_known_choices(), *RobotConfig.get_known_choices()]
        missing = [name for name in ("mimicik", "airbot_play_can", "airbot_play_can_ee") if name not in known]
        if missing:
            raise CheckFailed(
                f"LeRobot does not know {', '.join(missing)}",
                'install it beside LeRobot (uv pip install -e .); python -c "import lerobot_policy_mimicik" says '
                "what is wrong",
            )
        return "LeRobot knows the policy mimicik and the robots airbot_play_can, airbot_play_can_ee"

    def _urdf(self) -> str:
        joints = self._description.joints()
        for joint in joints:
            if not joint.lower < joint.upper:
                raise CheckFailed(
                    f"{joint.name} has limits {joint.lower}, {joint.upper}", "reinstall the package"
                )
        return f"{self._description.base_link} to {self._description.tip_link}: " + ", ".join(
            f"{joint.name} [{joint.lower:.2f}, {joint.upper:.2f}]" for joint in joints
        )

    def _checkpoint(self) -> str:
        from lerobot_mimicik.checkpoints import CheckpointError, load_policy

        try:
            self._policy = load_policy(self.options.policy_path, "cpu")
        except CheckpointError as error:
            raise CheckFailed(
                str(error), "copy the checkpoint's folder again from where it was trained, or train it again"
            ) from error
        except (ValueError, OSError, RuntimeError) as error:
            raise CheckFailed(
                str(error), "give the folder of a checkpoint, of a training run, or a Hub repository"
            ) from error
        config = self._policy.config
        return f"{config.type}, {config.dof} joints in {config.joint_units}, tool offset {config.tool_offset or 'none'}"

    def _match(self) -> str:
        theirs, mine = self._policy.config.arm_description(), self._description
        if theirs.joint_names != mine.joint_names:
            raise CheckFailed(
                f"the checkpoint drives {theirs.joint_names}, the robot has {mine.joint_names}",
                "train with --policy.joint_names in the robot's order, or use the checkpoint of this arm",
            )
        for ours, other in zip(mine.joints(), theirs.joints(), strict=True):
            if abs(ours.lower - other.lower) > 0.05 or abs(ours.upper - other.upper) > 0.05:
                raise CheckFailed(
                    f"{ours.name}: limits [{other.lower:.2f}, {other.upper:.2f}] in the checkpoint, "
                    f"[{ours.lower:.2f}, {ours.upper:.2f}] on the robot",
                    "the checkpoint was trained for another arm or URDF",
                )
        home = np.array([mine.home])
        distance, angle = pose_distance(_forward(mine, home), _forward(theirs, home))
        offset = len(theirs.tool_offset) > 0
        if not offset and (distance > 1e-3 or angle > 1e-3):
            raise CheckFailed(
                f"at the home configuration its kinematics differ by {distance * 1e3:.1f} mm, {angle:.4f} rad",
                "the checkpoint was trained for another arm or URDF",
            )
        return "same joints, limits and kinematics" + (", with a tool" if offset else "")

    def _open(self) -> str:
        options = self.options
        try:
            if options.interface == "virtual":
                from robot_adapters.simulation.simulated_arm import SimulatedArm

                channel = f"doctor-{id(self)}"
                self._simulation = SimulatedArm(open_bus("virtual", channel), self._clock).start()
                self._bus = open_bus("virtual", channel)
            else:
                self._bus = open_bus(options.interface, options.channel)
        except ModuleNotFoundError as error:
            raise CheckFailed(str(error), "uv pip install 'lerobot_policy_mimicik[sim]'") from error
        except OSError as error:
            detail, _, remedy = str(error).partition("; ")
            raise CheckFailed(detail, remedy or "check the interface and the channel") from error
        return f"{options.interface} {options.channel or ''} is open".replace("  ", " ")

    def _alone(self) -> str:
        other = other_master(self._bus, self._clock)
        if other is not None:
            raise CheckFailed(other.detail, other.remedy)
        return "nobody else commands the motors"

    def _boards(self) -> str:
        from robot_adapters.airbot.startup import read_tool

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
        assert self._identity is not None
        ranges = [
            f"{each.motor.id}: ±{each.motor.position_range.high:g} rad"
            for each in self._identity.motors
            if isinstance(each.motor, DmMotor)
        ]
        return "reported and plausible, " + ", ".join(ranges)

    def _health(self) -> str:
        assert self._identity is not None
        limits, seen = SafetyLimits(), []
        for each in self._identity.motors:
            if not isinstance(each.motor, DmMotor):
                continue  # OD motors tell their temperature only when commanded
            feedback = ask(
                self._bus, self._clock, each.motor.ping(), _feedback_of(each.motor), f"motor {each.motor.id}"
            )
            if feedback.error > 1:
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

    def _limits(self) -> str:
        q, margin = self._joints(), SafetyLimits().start_margin
        for joint, value in zip(self._description.joints(), q, strict=True):
            if not joint.lower - margin <= value <= joint.upper + margin:
                raise CheckFailed(
                    f"{joint.name} stands at {value:.3f} rad, outside [{joint.lower:.2f}, {joint.upper:.2f}]",
                    "move the arm back by hand while it is off; if it looks right, its zero is wrong: calibrate it",
                )
        return "joints at " + ", ".join(f"{value:.3f}" for value in q) + " rad"

    def _pose(self) -> str:
        tool = decode_pose(self.options.tool or IDENTITY, PoseFormat.QUATERNION)
        reported = decode_pose(self.options.reported_pose, PoseFormat.QUATERNION)
        computed = compose(_forward(self._description, np.array([self._joints()])), tool)
        distance, angle = pose_distance(computed, reported)
        said = f"{distance * 1e3:.1f} mm and {math.degrees(angle):.2f} deg apart"
        if distance > _LIKELY_POSITION or angle > _LIKELY_ROTATION:
            raise CheckFailed(
                f"FK of the measured joints and the reported pose are {said}",
                "check --tool (the AIRBOT gripper's is 0.1594 m ahead of the end link), the base frame, the zero",
            )
        return said

    def _joints(self) -> list[float]:
        assert self._identity is not None
        return [each.position for each in self._identity.motors[: len(self._description.joint_names)]]

    def _close(self) -> None:
        if self._simulation is not None:
            self._simulation.stop()
            self._simulation.bus.shutdown()
        if self._bus is not None:
            self._bus.shutdown()


def _forward(description: Any, q: np.ndarray) -> np.ndarray:
    from lerobot_mimicik.kinematics.array_chain import array_chain

    return array_chain(description).pose(q)[0]


def _feedback_of(motor: DmMotor) -> Callable[[Any], MotorFeedback | None]:
    def accept(message: Any) -> MotorFeedback | None:
        reply = motor.decode(message)
        return reply if isinstance(reply, MotorFeedback) else None

    return accept
