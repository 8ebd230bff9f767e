"""Any LeRobot robot with joint positions in end-effector space: the adapter stands before it."""

from __future__ import annotations

import logging
import math
import time
from functools import cached_property, partial
from typing import Any

from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.decorators import check_if_not_connected

from robot_adapters.robots.config_mimicik_ee import MimicIKEEConfig
from robot_adapters.robots.end_effector import DELTA, EndEffectorFace, PoseKeys
from robot_adapters.robots.inner_arm import InnerArm, sides_of

_log = logging.getLogger(__name__)
_QUIET = 1.0  # s in which the same warning is not repeated
_FRESH = 0.25  # s that an observation counts as now: LeRobot's loops observe, then act


class MimicIKEE(Robot):
    """Poses out and in; joints, units, gripper, cameras and calibration are those of the robot inside.

    Attributes:
        arm: The robot inside.
        sides: Its one or two arms by the prefix of their keys, each with its face.
    """

    config_class = MimicIKEEConfig
    name = "mimicik_ee"

    def __init__(self, config: MimicIKEEConfig) -> None:
        """Raises ValueError for what neither the robot inside nor the options say."""
        self.config = config
        if config.arm.id is None:
            config.arm.id = config.id
        self.arm: Robot = make_robot_from_config(config.arm)
        super().__init__(config)
        self.cameras: dict[str, Any] = getattr(self.arm, "cameras", {})
        self.sides: dict[str, tuple[InnerArm, EndEffectorFace]] = {}
        self._warned: dict[str, float] = {}
        self._seen: RobotObservation = {}
        self._seen_at = -math.inf
        for prefix in sides_of(self.arm):
            inner = InnerArm(self.arm, prefix, config.arm_description, config.joints, config.joint_units)
            spelling = "lerobot" if config.keys == "lerobot" else "pos"
            keys = PoseKeys(config.form, spelling, config.gripper and inner.gripper_key is not None, prefix)
            load = partial(config.ik.load, inner.description)
            face = EndEffectorFace(load, keys, config.tool, self._warn)
            face.delta_step = config.delta_step
            face.gripper_range = (config.gripper_range[0], config.gripper_range[1])
            self.sides[prefix] = inner, face

    def _load_calibration(self, fpath: Any = None) -> None:
        """The calibration is the inner robot's."""

    @property
    def results(self) -> dict[str, Any]:
        """What became of each arm's last pose, by prefix."""
        return {prefix: face.result for prefix, (_, face) in self.sides.items()}

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        """Poses and grippers; all that the robot inside measures beside joints: cameras, a mobile base."""
        return {**self._poses_ft, **self._others_ft(self.arm.observation_features)}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Poses and grippers to go to, or a keyboard's steps; what else the robot inside takes."""
        poses = self._poses_ft
        if self.config.keys == "delta":
            poses = {}
            for prefix, (_, face) in self.sides.items():
                names = [*DELTA, *(["gripper"] if face.keys.gripper else [])]
                poses |= dict.fromkeys([prefix + name for name in names], float)
        return {**poses, **self._others_ft(self.arm.action_features)}

    @property
    def _poses_ft(self) -> dict[str, type]:
        return {key: float for _, face in self.sides.values() for key in face.keys.all}

    def _others_ft(self, features: dict[str, Any]) -> dict[str, Any]:
        own = {key for inner, _ in self.sides.values() for key in (*inner.joint_keys, inner.gripper_key)}
        # Velocities and torques of the joints are not passed on: they are not of the tool.
        moving = tuple(key.removesuffix("pos") for key in own if key is not None)
        return {key: kind for key, kind in features.items() if not key.startswith(moving)}

    @property
    def is_connected(self) -> bool:
        """Whether the robot inside is."""
        return self.arm.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the robot inside is."""
        return self.arm.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the robot inside; `mimicik calibrate` measures how its joints differ from the URDF's."""
        self.arm.calibrate()

    def configure(self) -> None:
        """Configure the robot inside."""
        self.arm.configure()

    def connect(self, calibrate: bool = True) -> None:
        """Load the inverse kinematics, then connect the robot inside.

        Raises:
            ValueError: A checkpoint for another arm, or units that nobody says.
        """
        for inner, face in self.sides.values():
            mine, theirs = inner.description.joint_names, face.adapter.joint_names
            if mine != theirs:
                source = self.config.ik.path or self.config.ik.address
                raise ValueError(f"{source} drives joints {theirs}, the arm of this robot has {mine}")
            face.reset()
        self._seen_at = -math.inf
        self.arm.connect(calibrate)
        try:
            for inner, _ in self.sides.values():
                _ = inner.units
        except ValueError:
            self.arm.disconnect()
            raise

    def disconnect(self) -> None:
        """Disconnect the robot inside."""
        self.arm.disconnect()

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """The measured poses `T_base_tool`, grippers in the robot's unit, and what else the robot inside measures."""
        seen = self._observe()
        poses: RobotObservation = {}
        for inner, face in self.sides.values():
            poses |= face.observed(inner.joints(seen), inner.gripper(seen))
        return poses | {key: seen[key] for key in self.observation_features if key not in poses}

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Move towards poses; returns the poses of the joints that the robot inside took.

        Raises:
            KeyError: A number is missing; then no arm moves.
            ValueError: The measured joints are far outside their limits: another unit, another arm.
        """
        others = self._others_ft(self.arm.action_features)
        missing = [key for key in others if key not in action]
        if missing:
            raise KeyError(f"the action lacks {missing}; {self.name} takes {list(self.action_features)}")
        seen = self._seen if time.monotonic() - self._seen_at < _FRESH else self._observe()
        joints: RobotAction = {key: action[key] for key in others}
        for _, face in self.sides.values():
            face.check(action)
        for inner, face in self.sides.values():
            q, gripper = face.solve(action, inner.joints(seen), inner.gripper(seen))
            joints |= inner.action(q, gripper)
        taken = joints | self.arm.send_action(joints)
        sent: RobotAction = {key: taken[key] for key in others}
        for inner, face in self.sides.values():
            sent |= face.sent(inner.joints(taken), inner.gripper(taken))
        return sent

    def _observe(self) -> RobotObservation:
        self._seen = self.arm.get_observation()
        self._seen_at = time.monotonic()
        return self._seen

    def _warn(self, name: str, message: str) -> None:
        """Log a warning, the same kind at most once a second."""
        now = time.monotonic()
        if now - self._warned.get(name, -math.inf) > _QUIET:
            self._warned[name] = now
            _log.warning("%s: %s", self, message)
