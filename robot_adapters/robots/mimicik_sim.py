"""Any shipped arm or URDF as a LeRobot robot in joint space, simulated: lag, sag and noise of its servos included."""

from __future__ import annotations

import logging
import math
import time
from functools import cached_property

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from robot_adapters.arm_page import ArmPage
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig
from robot_adapters.robots.spelling import own_keys
from robot_adapters.robots.units import JointUnits
from robot_adapters.simulation.servo_arm import ServoArm, ServoParameters

_log = logging.getLogger(__name__)
GRIPPER = "gripper.pos"
_OPEN = 50.0  # of 0 to 100, where the gripper starts
_FRAME = 1 / 30  # s between two pictures on the page
_MOST_CATCH_UP = (
    0.5  # s that pass at once after the process was held up: the arm has long come to rest by then
)


class MimicIKSim(Robot):
    """One simulated arm; its time passes in `get_observation` and `send_action`.

    Attributes:
        description: The arm, with the joints in the order of all q.
        servos: The arm behind the features, between `connect` and `disconnect`.
    """

    config_class = MimicIKSimConfig
    name = "mimicik_sim"

    def __init__(self, config: MimicIKSimConfig) -> None:
        """Raises UrdfError for an arm or link that does not exist, ValueError for a start or servos that cannot be."""
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self.description: ArmDescription = describe_arm(
            config.arm, config.base_link or None, config.tip_link or None
        )
        self.servos: ServoArm | None = None
        self._parameters = ServoParameters(config.lag, config.sag, config.noise)
        joints = self.description.joints()
        # A joint that turns on and on is counted from half a turn to half a turn.
        self.ranges = (
            np.array([max(joint.lower, -math.pi) for joint in joints]),
            np.array([min(joint.upper, math.pi) for joint in joints]),
        )
        self._units = JointUnits(config.joint_units, *self.ranges)
        self._gripper = self._gripper_target = _OPEN
        self._seen = self._shown = 0.0
        self._page: ArmPage | None = None

    @property
    def joint_keys(self) -> list[str]:
        """Keys of the joints, in the arm's order."""
        return [f"{name}.pos" for name in self.description.joint_names]

    @property
    def _motors_ft(self) -> dict[str, type]:
        return dict.fromkeys([*self.joint_keys, *([GRIPPER] if self.config.gripper else [])], float)

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        """Positions, and the cameras' images."""
        images = {name: (each.height, each.width, 3) for name, each in self.cameras.items()}
        return {**self._motors_ft, **images}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Positions to go to."""
        return self._motors_ft

    @property
    def is_connected(self) -> bool:
        """Whether arm and cameras run."""
        return self.servos is not None and all(camera.is_connected for camera in self.cameras.values())

    @property
    def is_calibrated(self) -> bool:
        """A simulated arm knows its zero."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Build the arm, which then hangs on its servos. Raises ModuleNotFoundError without MuJoCo."""
        try:
            self.servos = ServoArm(
                self.description, self.config.start or None, self._parameters, self.config.seed
            )
            if self.config.view:
                self._page = ArmPage(self.description, self.config.view_port)
                _log.warning("%s is shown at %s", self.config.arm, self._page.address)
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self._close()
            raise
        self._gripper = self._gripper_target = _OPEN
        self._seen = time.monotonic()

    @check_if_not_connected
    def disconnect(self) -> None:
        """Let go of the arm."""
        self._close()

    def _close(self) -> None:
        self.servos = None
        if self._page is not None:
            self._page.close()
            self._page = None
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Measured joints in the configured units, the gripper (0 to 100), and images."""
        assert self.servos is not None
        if self.config.real_time:
            self._let_time_pass()
        self._show()
        measured = self._positions(self.servos.measure(), self._gripper)
        return measured | {name: camera.async_read() for name, camera in self.cameras.items()}

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Move towards joint positions; returns what was sent, within the joints' limits.

        Raises:
            KeyError: A joint is missing.
            ValueError: A number is not finite.
        """
        assert self.servos is not None
        action = own_keys(action, self._motors_ft)
        missing = [key for key in self._motors_ft if key not in action]
        if missing:
            raise KeyError(f"the action lacks {missing}; {self.name} takes {list(self._motors_ft)}")
        given = np.array([float(action[key]) for key in self._motors_ft])
        if not np.isfinite(given).all():
            raise ValueError(
                f"the action is not finite: {dict(zip(self._motors_ft, given.tolist(), strict=True))}"
            )
        if self.config.real_time:
            self._let_time_pass()
        count = len(self.joint_keys)
        sent = self.servos.command(self._units.to_rad(given[:count]))
        if self.config.gripper:
            self._gripper_target = float(np.clip(given[count], 0.0, 100.0))
        if not self.config.real_time:
            self._advance(1 / self.config.fps)
        return self._positions(sent, self._gripper_target)

    def _show(self) -> None:
        if self._page is not None and self.servos is not None and time.monotonic() - self._shown > _FRAME:
            self._shown = time.monotonic()
            self._page.show(self.servos.q)

    def _let_time_pass(self) -> None:
        now = time.monotonic()
        self._advance(min(now - self._seen, _MOST_CATCH_UP))
        self._seen = now

    def _advance(self, seconds: float) -> None:
        assert self.servos is not None
        self.servos.advance(seconds)
        self._gripper += (self._gripper_target - self._gripper) * -math.expm1(-seconds / self.config.lag)

    def _positions(self, q: np.ndarray, gripper: float) -> dict[str, float]:
        positions = dict(zip(self.joint_keys, self._units.from_rad(q).tolist(), strict=True))
        return positions | ({GRIPPER: gripper} if self.config.gripper else {})
