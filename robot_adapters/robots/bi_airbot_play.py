"""Two AIRBOT Plays as one LeRobot robot, each on a bus of its own."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property

from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.utils.bimanual import BimanualMixin
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from robot_adapters.robots.airbot_play import AirbotPlay, AirbotPlayEE
from robot_adapters.robots.config_airbot_play import (
    AirbotConnection,
    AirbotPlayConfig,
    AirbotPlayEEConfig,
    BiAirbotPlayConfig,
    BiAirbotPlayEEConfig,
)

SIDES = ("left", "right")


class BiAirbotPlay(BimanualMixin, Robot):
    """Two arms in joint space: left_joint1.pos ... right_gripper.pos."""

    config_class = BiAirbotPlayConfig
    name = "bi_airbot_play"

    def __init__(self, config: BiAirbotPlayConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self.left_arm, self.right_arm = (self._make_arm(side, getattr(config, side)) for side in SIDES)

    def _make_arm(self, side: str, connection: AirbotConnection) -> AirbotPlay:
        return AirbotPlay(AirbotPlayConfig(**self._identity(side), **asdict(connection)))

    def _identity(self, side: str) -> dict:
        return {
            "id": f"{self.config.id}_{side}" if self.config.id else side,
            "calibration_dir": self.config.calibration_dir,
        }

    @property
    def _arms(self) -> dict[str, AirbotPlay]:
        return {"left": self.left_arm, "right": self.right_arm}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Those of both arms."""
        return {
            f"{side}_{key}": kind for side, arm in self._arms.items() for key, kind in arm._motors_ft.items()
        }

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        """Those of both arms, and the cameras' images."""
        images = {name: (each.height, each.width, 3) for name, each in self.cameras.items()}
        return {**self.action_features, **images}

    @property
    def is_connected(self) -> bool:
        """Whether both arms and all cameras run."""
        arms = self.left_arm.is_connected and self.right_arm.is_connected
        return arms and all(camera.is_connected for camera in self.cameras.values())

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect both arms and the cameras. What fails closes all again."""
        try:
            for part in (self.left_arm, self.right_arm, *self.cameras.values()):
                part.connect()
        except BaseException:
            self._close()
            raise

    @check_if_not_connected
    def disconnect(self) -> None:
        """Let both arms down and close all."""
        self._close()

    def _close(self) -> None:
        try:
            for part in (*self.cameras.values(), self.left_arm):
                if part.is_connected:
                    part.disconnect()
        finally:
            if self.right_arm.is_connected:
                self.right_arm.disconnect()

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """What both arms measure, and images."""
        measured = {
            f"{side}_{key}": value
            for side, arm in self._arms.items()
            for key, value in arm.get_observation().items()
        }
        return measured | {name: camera.async_read() for name, camera in self.cameras.items()}

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Move both arms; returns the targets in force.

        Raises:
            KeyError: A number of either arm is missing; then neither moves.
            ArmStoppedError: An arm has stopped.
        """
        own = {
            side: {
                key.removeprefix(f"{side}_"): value
                for key, value in action.items()
                if key.startswith(f"{side}_")
            }
            for side in SIDES
        }
        for side, arm in self._arms.items():
            try:
                arm.check(own[side])
            except KeyError as error:
                raise KeyError(f"{side} arm: {error.args[0]}") from error
        sent: RobotAction = {}
        for side, arm in self._arms.items():
            sent |= {f"{side}_{key}": value for key, value in arm.send_action(own[side]).items()}
        return sent


class BiAirbotPlayEE(BiAirbotPlay):
    """Two arms in end-effector space: left_ee.x.pos ... right_ee.gripper.pos."""

    config_class = BiAirbotPlayEEConfig
    name = "bi_airbot_play_ee"
    config: BiAirbotPlayEEConfig

    def _make_arm(self, side: str, connection: AirbotConnection) -> AirbotPlay:
        return AirbotPlayEE(
            AirbotPlayEEConfig(
                **self._identity(side),
                **asdict(connection),
                ik=self.config.ik,
                rotation=self.config.rotation,
                tool=self.config.tool,
            )
        )
