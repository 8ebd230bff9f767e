"""One arm of any LeRobot robot in joint space: which of its numbers are joints, in which unit, and of which URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.motors import MotorNormMode
from lerobot.robots.robot import Robot
from numpy.typing import NDArray

from lerobot_mimicik.columns import canonical_name
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, ArmDescription, describe_arm
from lerobot_mimicik.kinematics.shipped import arm_of_robot_type
from robot_adapters.robots.config_mimicik_ee import types_of
from robot_adapters.robots.joint_offsets import offsets_file, read_offsets
from robot_adapters.robots.units import JointUnits

Array = NDArray[np.float64]

SIDES = ("left_", "right_")
_DEGREES = ("rebot_b601_follower", "bi_rebot_b601_follower")
"""Robots of LeRobot that say nowhere but in their documentation that they count in degrees."""


class InnerArm:
    """Joints [rad] of one arm from a robot's observation and into its action.

    Attributes:
        part: The robot, or the one of its two arms that this is.
        prefix: Of the arm's keys, `left_`, `right_` or nothing.
        description: The arm, with the joints in the order of all q.
        joint_keys: The robot's keys of these joints, in this order.
        gripper_key: The robot's key of the gripper; None without one.
        offsets: What is added to the robot's joints to have the URDF's [rad] (dof,).
    """

    def __init__(
        self,
        robot: Robot,
        prefix: str = "",
        arm: str = "",
        joints: Sequence[str] = (),
        unit: str = "auto",
        calibrated: bool = True,
    ) -> None:
        """Finds out what is left open.

        Args:
            robot: The whole robot.
            prefix: Of the arm's keys.
            arm: A shipped arm or a URDF; empty: known by the robot.
            joints: The robot's joints, without `.pos`, in the URDF's order; empty: found by their names.
            unit: Of the robot's joints; `auto`: known by the robot.
            calibrated: Whether the offsets that are kept for it count; false where they are measured anew.

        Raises:
            ValueError: What is not known; the message names the option that says it.
        """
        self.part: Any = getattr(robot, f"{prefix}arm", robot) if prefix else robot
        self.prefix = prefix
        self.robot_type = robot.config.type if hasattr(robot, "config") else robot.name
        names = [
            key.removeprefix(prefix).removesuffix(".pos")
            for key in robot.action_features
            if key.startswith(prefix) and key.endswith(".pos")
        ]
        self.description = _describe(robot, self.part, self.robot_type, prefix, arm)
        found = _match(names, self.description.joint_names, joints, self.robot_type)
        self.joint_keys = [f"{prefix}{name}.pos" for name in found]
        self._names = found
        rest = [name for name in names if name not in found]
        grippers = [name for name in rest if "gripper" in name] or (rest if len(rest) == 1 else [])
        self.gripper_key = f"{prefix}{grippers[0]}.pos" if grippers else None
        self._unit = unit
        self._units: JointUnits | None = None
        self.offsets: Array = np.zeros(len(found))
        self.offsets_path: Path | None = offsets_file(self.part)
        if self.offsets_path is not None and calibrated:
            self.offsets = read_offsets(self.offsets_path, self.description.joint_names)

    @property
    def units(self) -> JointUnits:
        """Units of the joints; those of a normalised robot are known once it is calibrated.

        Raises:
            ValueError: The robot does not say.
        """
        if self._units is None:
            self._units = _units(self.part, self._names, self._unit, self.robot_type)
        return self._units

    def joints(self, observation: Mapping[str, Any]) -> Array:
        """The URDF's joints [rad] (dof,) of what the robot measured or sent. KeyError for a missing one."""
        missing = [key for key in self.joint_keys if key not in observation]
        if missing:
            raise KeyError(f"{self.robot_type} gave no {missing}; it gave {sorted(observation)}")
        return self.units.to_rad([float(observation[key]) for key in self.joint_keys]) + self.offsets

    def gripper(self, observation: Mapping[str, Any]) -> float | None:
        """The gripper in the robot's unit; None without one."""
        return None if self.gripper_key is None else float(observation[self.gripper_key])

    def action(self, q: Array, gripper: float | None) -> dict[str, float]:
        """The robot's action that brings it to joints [rad] (dof,) of the URDF."""
        values = self.units.from_rad(q - self.offsets)
        action = dict(zip(self.joint_keys, values.tolist(), strict=True))
        if self.gripper_key is not None and gripper is not None:
            action[self.gripper_key] = gripper
        return action


def sides_of(robot: Robot) -> tuple[str, ...]:
    """Prefixes of the robot's arms: one empty, or those of both sides.

    Raises:
        ValueError: The robot takes no joint positions.
    """
    positions = [key for key in robot.action_features if key.endswith(".pos") and not key.startswith("ee.")]
    if not positions:
        raise ValueError(
            f"{robot.name} takes no joint positions (keys that end in .pos), it takes {list(robot.action_features)}"
        )
    both = all(any(key.startswith(side) for key in positions) for side in SIDES)
    return SIDES if both else ("",)


def _describe(robot: Robot, part: Any, robot_type: str, prefix: str, arm: str) -> ArmDescription:
    if arm:
        return describe_arm(arm)
    known = getattr(part, "description", None)
    if isinstance(known, ArmDescription):
        return known
    names = types_of(type(robot.config)) if hasattr(robot, "config") else []
    if robot_type in names and len({arm_of_robot_type(name) for name in names}) > 1:
        raise ValueError(
            f"{type(robot.config).__name__} is {' and '.join(names)}: arm_description="
            f"{' or '.join(str(arm_of_robot_type(name)) for name in names)} says which arm it is"
        )
    side = prefix.removesuffix("_") or getattr(getattr(part, "config", None), "side", None)
    name = arm_of_robot_type(robot_type, side)
    if name is None:
        raise ValueError(
            f"which arm is {robot_type!r}? --robot.arm_description=URDF says it, or the name of a shipped arm "
            f"({', '.join(SHIPPED_ARMS)})"
        )
    return describe_arm(name)


def _match(names: Sequence[str], wanted: Sequence[str], given: Sequence[str], robot_type: str) -> list[str]:
    """The robot's names of the URDF's joints: as given, else equal, else the end of them (`joint1`, `left_joint1`)."""
    if given:
        unknown = [name for name in given if name not in names]
        if unknown or len(given) != len(wanted):
            raise ValueError(
                f"--robot.joints={list(given)}: expected {len(wanted)} of {list(names)}, in the order of "
                f"{list(wanted)}" + (f"; unknown: {unknown}" if unknown else "")
            )
        return list(given)
    short = {canonical_name(name): name for name in names}
    found = [short.get(canonical_name(joint)) for joint in wanted]
    if None in found:
        ends = [
            [name for key, name in short.items() if canonical_name(joint).endswith(key)] for joint in wanted
        ]
        found = [each[0] if len(each) == 1 else None for each in ends]
    if None in found or len(set(found)) != len(wanted):
        raise ValueError(
            f"{robot_type} has the joints {list(names)}, its arm's description {list(wanted)}: name the robot's in "
            f"the description's order, --robot.joints=[{','.join(names[: len(wanted)])}], or another arm, "
            "--robot.arm_description=..."
        )
    return [name for name in found if name is not None]


def _units(part: Any, names: Sequence[str], unit: str, robot_type: str) -> JointUnits:
    config, bus = getattr(part, "config", None), getattr(part, "bus", None)
    own = (
        getattr(config, "joint_units", "")
        or _unit_of_bus(bus, names)
        or ("deg" if robot_type in _DEGREES else "")
    )
    if own and unit not in ("auto", own):
        raise ValueError(f"--robot.joint_units={unit}: {robot_type} counts its joints in {own}; leave it out")
    if unit == "auto":
        unit = own
        if not unit:
            raise ValueError(
                f"{robot_type} does not say in which unit its joints are: --robot.joint_units=deg, rad or normalised"
            )
    if unit != "normalised":
        return JointUnits(unit)
    if hasattr(part, "ranges"):
        return JointUnits(unit, *part.ranges)
    return JointUnits(unit, *_ranges_of_bus(part, bus, names, robot_type))


def _unit_of_bus(bus: Any, names: Sequence[str]) -> str:
    motors = getattr(bus, "motors", {})
    if any(name not in motors for name in names):
        return ""
    modes = {motors[name].norm_mode for name in names}
    if modes == {MotorNormMode.DEGREES}:
        return "deg"
    return "normalised" if modes == {MotorNormMode.RANGE_M100_100} else ""


def _ranges_of_bus(part: Any, bus: Any, names: Sequence[str], robot_type: str) -> tuple[Array, Array]:
    """What -100 and 100 are [rad], from the calibration of a LeRobot bus: it counts them from the middle."""
    calibration = getattr(part, "calibration", None) or {}
    if bus is None or any(name not in calibration for name in names):
        raise ValueError(
            f"{robot_type} counts its joints from -100 to 100 and is not calibrated: lerobot-calibrate says what that is"
        )
    half = []
    for name in names:
        entry = calibration[name]
        turn = bus.model_resolution_table[bus.motors[name].model] - 1
        turned = -1 if getattr(bus, "apply_drive_mode", False) and entry.drive_mode else 1
        half.append(turned * (entry.range_max - entry.range_min) / turn * math.pi)
    return -np.array(half), np.array(half)
