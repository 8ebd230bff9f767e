"""Read-only checks of an installation, a bus, an arm and a checkpoint, each with a remedy for its failure.

Checks run in layers, from the computer to the arm; what rests on a failed one is skipped. Nothing is enabled,
moved or written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import IDENTITY, PoseFormat, compose, decode_pose, pose_distance
from robot_adapters.arm import SimulatedArmCell
from robot_adapters.checks import ArmChecks, Check, CheckFailed, CheckOutcome, Finding
from robot_adapters.clock import RealClock
from robot_adapters.drivers import arm_checks, driver_of, simulated_cell
from robot_adapters.safety import SafetyLimits

_LIKELY_POSITION, _LIKELY_ROTATION = 0.005, 0.03  # m, rad: between FK and another's word on the same pose


@dataclass
class DoctorOptions:
    """What to check.

    Attributes:
        arm: The name of the arm, one of `DRIVERS`.
        interface, channel: That of python-can; empty: no bus and no arm. `virtual` is a simulated arm of its own.
        policy_path: A MimicIK checkpoint; empty: none.
        reported_pose: `T_base_tool` that the vendor's software or a ruler reports for the arm as it stands,
            (7,); empty: not compared.
        tool: Pose of that tool in the end link, (7,); empty: the end link itself.
    """

    arm: str = "airbot_play"
    interface: str = ""
    channel: str | None = None
    policy_path: str = ""
    reported_pose: Sequence[float] = ()
    tool: Sequence[float] = ()


class Doctor:
    """Runs the checks in order; `findings` grows as they end. ValueError for an arm that is not driven here."""

    def __init__(self, options: DoctorOptions) -> None:
        self.options = options
        self.findings: list[Finding] = []
        driver_of(options.arm)
        self._description = describe_arm(options.arm)
        self._policy: Any = None
        self._arm: ArmChecks | None = None
        self._cell: SimulatedArmCell | None = None
        self._clock = RealClock()

    def run(self, report: Callable[[Finding], None] = lambda finding: None) -> list[Finding]:
        """All checks; `report` is told of each as it ends."""
        options = self.options
        # What needs no LeRobot comes first: importing it takes seconds.
        checks = [Check("URDF and joint order", self._urdf), Check("plugin", self._plugin)]
        if options.policy_path:
            checks += [
                Check("checkpoint", self._checkpoint, "plugin"),
                Check("checkpoint against robot", self._match, "checkpoint"),
            ]
        try:
            if options.interface:
                checks += self._on_the_bus()
            for check in checks:
                finding = self._run(check)
                self.findings.append(finding)
                report(finding)
        finally:
            self._close()
        return self.findings

    def _on_the_bus(self) -> list[Check]:
        """The arm's own checks, and what its joints must fit."""
        options, channel = self.options, self.options.channel
        if options.interface == "virtual":
            try:
                self._cell = simulated_cell(options.arm, self._clock)
            except ModuleNotFoundError as error:
                said = str(error)

                def missing() -> str:
                    raise CheckFailed(said, "uv pip install 'lerobot_policy_mimicik[sim]'")

                return [Check("bus", missing)]
            channel = self._cell.channel
        self._arm = arm_checks(options.arm, options.interface, channel, self._clock)
        checks = [*self._arm.checks(), Check("joint limits", self._limits, "motors")]
        if len(options.reported_pose):
            checks.append(Check("FK against the reported pose", self._pose, "motors"))
        return checks

    def _run(self, check: Check) -> Finding:
        name = check.name
        if any(f.check == check.needs and f.outcome is not CheckOutcome.OK for f in self.findings):
            return Finding(name, CheckOutcome.SKIPPED, f"needs: {check.needs}")
        try:
            return Finding(name, CheckOutcome.OK, check.run())
        except CheckFailed as failed:
            return Finding(name, CheckOutcome.FAILED, failed.detail, failed.remedy)
        except Exception as error:  # a doctor that dies of what it finds helps nobody
            return Finding(name, CheckOutcome.FAILED, f"{type(error).__name__}: {error}")

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
        assert self._arm is not None  # "motors" has passed
        return self._arm.joints()

    def _close(self) -> None:
        if self._arm is not None:
            self._arm.close()
        if self._cell is not None:
            self._cell.close()


def _forward(description: Any, q: np.ndarray) -> np.ndarray:
    from lerobot_mimicik.kinematics.array_chain import array_chain

    return array_chain(description).pose(q)[0]
