"""The AIRBOT Play as a LeRobot robot, in joint space and in end-effector space."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.poses import PoseFormat
from robot_adapters.adapter import IKResult, MimicIKAdapter
from robot_adapters.airbot.arm import AirbotArm, CommandResult
from robot_adapters.airbot.gripper import MAX_OPENING
from robot_adapters.clock import PatientClock, RealClock
from robot_adapters.robots.config_airbot_play import AirbotConnection, AirbotPlayConfig, AirbotPlayEEConfig
from robot_adapters.robots.end_effector import EndEffectorFace, PoseKeys
from robot_adapters.robots.spelling import own_keys
from robot_adapters.safety import ArmStopped, CommandStatus

_log = logging.getLogger(__name__)
_QUIET = 1.0  # s in which the same warning is not repeated
GRIPPER = "gripper.pos"


class ArmStoppedError(ConnectionError):
    """The arm has stopped for a reason that the message gives; it must be reconnected."""


class AirbotPlay(Robot):
    """One arm in joint space; with `interface=virtual` a simulated one that it starts itself."""

    config_class = AirbotPlayConfig
    name = "airbot_play"

    def __init__(self, config: AirbotPlayConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self.result: CommandResult | None = None
        self._arm: AirbotArm | None = None
        self._cell: Any = None
        self._last_target: NDArray[np.float64] | None = None
        self._warned: dict[str, float] = {}

    # --- What it measures and takes ---

    @property
    def joint_keys(self) -> list[str]:
        """Keys of the joints, in the arm's order."""
        return [f"joint{i}.pos" for i in range(1, 7)]

    @property
    def _motors_ft(self) -> dict[str, type]:
        return dict.fromkeys([*self.joint_keys, *([GRIPPER] if self.config.gripper else [])], float)

    @property
    def _cameras_ft(self) -> dict[str, tuple]:
        return {name: (each.height, each.width, 3) for name, each in self.cameras.items()}

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        """Positions, and the cameras' images."""
        return {**self._motors_ft, **self._cameras_ft}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Positions to go to."""
        return self._motors_ft

    # --- Life ---

    @property
    def is_connected(self) -> bool:
        """Whether arm and cameras run."""
        arm = self._arm is not None and self._arm.is_connected
        return arm and all(camera.is_connected for camera in self.cameras.values())

    @property
    def is_calibrated(self) -> bool:
        """The motors' zero is kept in the arm: always true."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do: the driver configures the motors when it connects."""

    @property
    def arm(self) -> AirbotArm:
        """The driver. Raises ConnectionError before `connect`."""
        if self._arm is None:
            raise ConnectionError(f"{self} is not connected: call connect() first")
        return self._arm

    @property
    def simulation(self) -> Any:
        """The simulated arm of `interface=virtual`, else None."""
        return self._cell.simulation if self._cell is not None else None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Open bus and cameras; the arm then holds where it stands. What fails closes all again."""
        try:
            self._arm, self._cell = open_arm(self.config)
            self._arm.connect()
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self._close()
            raise

    @check_if_not_connected
    def disconnect(self) -> None:
        """Let the arm down softly, and close bus and cameras."""
        self._close()

    def _close(self) -> None:
        arm, cell = self._arm, self._cell
        self._arm = self._cell = self._last_target = None
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()
        if arm is not None:
            arm.close()
        if cell is not None:
            cell.close()

    # --- Measuring and moving ---

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Measured joints in the configured units, the gripper's opening [m], and images."""
        self._let_time_pass()
        state = self.arm.read()
        return {**self._positions(state.q, state.gripper), **self._images()}

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Move towards joint positions; returns the target in force, after the safety limits.

        Raises:
            KeyError: A joint is missing.
            ArmStoppedError: The arm has stopped.
        """
        self._let_time_pass()
        self.check(action)
        action = own_keys(action, self._motors_ft)
        given = np.array([float(action[key]) for key in self.joint_keys])
        q = np.radians(given) if self.config.joint_units == "deg" else given
        opening = float(action[GRIPPER]) if self.config.gripper else None
        if self.config.max_relative_target is not None and np.isfinite(q).all():
            before = self.arm.read().q if self._last_target is None else self._last_target
            far = np.abs(q - before).max() / self.config.max_relative_target
            q = before + (q - before) / max(far, 1.0)
        sent = self.command(q, opening)
        return self._positions(sent.q_sent, opening)

    def command(self, q: NDArray[np.float64], opening: float | None) -> CommandResult:
        """Hand a target [rad] and an opening [m] to the driver, and say what it limited or refused."""
        self.result = sent = self.arm.command(q, opening)
        self._last_target = sent.q_sent
        for event in sent.events:
            self.warn(event.name, event.message)
        if sent.status is CommandStatus.REFUSED and any(isinstance(e, ArmStopped) for e in sent.events):
            raise ArmStoppedError("; ".join(event.message for event in sent.events))
        return sent

    def warn(self, name: str, message: str) -> None:
        """Log a warning, the same kind at most once a second."""
        now = time.monotonic()
        if now - self._warned.get(name, -math.inf) > _QUIET:
            self._warned[name] = now
            _log.warning("%s: %s", self, message)

    def _let_time_pass(self) -> None:
        """Run a simulated arm that waits for the computer; all others run by themselves."""
        if isinstance(self.arm.clock, PatientClock):
            self.arm.clock.catch_up()

    def _positions(self, q: NDArray[np.float64], opening: float | None) -> dict[str, float]:
        values = np.degrees(q) if self.config.joint_units == "deg" else q
        positions = dict(zip(self.joint_keys, values.tolist(), strict=True))
        if self.config.gripper:
            positions[GRIPPER] = _opening(opening)
        return positions

    def _images(self) -> dict[str, Any]:
        return {name: camera.async_read() for name, camera in self.cameras.items()}

    def check(self, action: RobotAction) -> None:
        """Raise KeyError unless the action has every number, in this or another plugin's spelling."""
        given = own_keys(action, self._motors_ft)
        missing = [key for key in self._motors_ft if key not in given]
        if missing:
            raise KeyError(f"the action lacks {missing}; {self.name} takes {list(self.action_features)}")


class AirbotPlayEE(AirbotPlay):
    """One arm in end-effector space: MimicIK turns the poses that it is sent into joints."""

    config_class = AirbotPlayEEConfig
    name = "airbot_play_ee"

    def __init__(self, config: AirbotPlayEEConfig) -> None:
        super().__init__(config)
        self.config: AirbotPlayEEConfig = config
        keys = PoseKeys(PoseFormat(config.rotation), gripper=config.gripper)
        self.face = EndEffectorFace(config.ik.load, keys, config.tool, self.warn)
        self.face.gripper_range = (0.0, MAX_OPENING)

    @property
    def pose_keys(self) -> list[str]:
        """Keys of the pose."""
        return self.face.keys.pose

    @property
    def _motors_ft(self) -> dict[str, type]:
        return dict.fromkeys(self.face.keys.all, float)

    @property
    def adapter(self) -> MimicIKAdapter:
        """The inverse kinematics, loaded at first use. Raises what `IKOptions.load` raises."""
        return self.face.adapter

    @property
    def ik_result(self) -> IKResult | None:
        """What became of the last pose; None before."""
        return self.face.result

    def connect(self, calibrate: bool = True) -> None:
        """Load the checkpoint, then connect as in joint space.

        Raises:
            ValueError: A checkpoint for another arm.
        """
        mine, theirs = tuple(key.removesuffix(".pos") for key in self.joint_keys), self.adapter.joint_names
        if mine != theirs:
            source = self.config.ik.path or self.config.ik.address
            raise ValueError(f"{source} drives joints {theirs}, this robot has {mine}")
        self.face.reset()
        super().connect(calibrate)

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """The measured pose `T_base_tool`, the gripper's opening [m], and images."""
        self._let_time_pass()
        state = self.arm.read()
        return {**self.face.observed(state.q, self._opening(state.gripper)), **self._images()}

    def check(self, action: RobotAction) -> None:
        """Raise KeyError unless the action has every number of the pose, in one of the accepted spellings."""
        self.face.check(action)

    def foresee(self, actions: Sequence[RobotAction]) -> None:
        """Say which poses follow the one that `send_action` is called with next, one a frame; it holds for that call.

        LeRobot's commands hand a robot one action at a time and say nothing of the next; a loop of one's own may know.

        Raises:
            KeyError: A number is missing.
        """
        self.face.foresee(actions)

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Move towards a pose; returns the pose of the joint target in force.

        Raises:
            KeyError: A number is missing.
            ArmStoppedError: The arm has stopped.
        """
        self._let_time_pass()
        state = self.arm.read()
        q, opening = self.face.solve(action, state.q, self._opening(state.gripper))
        return self.face.sent(self.command(q, opening).q_sent, opening)

    def _opening(self, opening: float | None) -> float | None:
        return _opening(opening) if self.config.gripper else None


def _opening(opening: float | None) -> float:
    """An opening [m] as the driver takes it: a closed gripper is measured some micrometres below zero."""
    return float("nan") if opening is None else min(max(float(opening), 0.0), MAX_OPENING)


def open_arm(connection: AirbotConnection) -> tuple[AirbotArm, Any]:
    """The driver for a connection, not yet connected, and the simulated cell around it, if any.

    Raises:
        ModuleNotFoundError: `virtual` without MuJoCo.
    """
    # Where LeRobot shuts down by itself on a signal, it also brings the arm home: leave that to it.
    handle_signals = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if connection.interface == "virtual":
        from robot_adapters.airbot.protocol import Tool
        from robot_adapters.simulation.cell import SimulatedCell

        cell = SimulatedCell(
            RealClock() if connection.real_time else PatientClock(),
            q=connection.start or None,
            tool=Tool.G2 if connection.gripper else Tool.NONE,
            handle_signals=handle_signals,
        )
        return cell.arm, cell
    return AirbotArm(connection.interface, connection.channel, handle_signals=handle_signals), None
