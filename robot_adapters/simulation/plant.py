"""The simulated arm's mechanics: MuJoCo dynamics of a URDF under the MIT law of its motors.

Needs the `sim` extra. Joint side is rad, rad/s and Nm; the motors' own torque unit differs from it by a
factor per joint, the same by which a driver multiplies the gravity torque before it feeds it forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription

_TOOL_CENTRE = (0.1594, 0.0, 0.0)  # m in the end link, where the real logs place it
_LOAD_RADIUS = 0.03  # m


@dataclass(frozen=True)
class PlantParameters:
    """What the URDF does not say about the arm, per joint from the base; see `identification` for the values'
    origin.

    torque_factors: motor torque per joint torque [Nm/Nm]. friction: Coulomb friction [Nm, motor]. damping:
    viscous friction [Nm s/rad, motor]. armature: reflected rotor inertia [kg m^2]. lag: time constant of each
    of the two first-order lags between command and motor [s], 0 for none. dead_time: delay before them [s].
    payload: mass at the gripper's tool centre [kg], which the driver does not know of.
    """

    torque_factors: tuple[float, ...] = (0.6, 0.6, 0.6, 1.6, 1.25, 1.5)
    friction: tuple[float, ...] = (0.2471, 0.3427, 0.2602, 0.0659, 0.0673, 0.0726)
    damping: tuple[float, ...] = (0.03, 0.03, 0.03, 0.0983, 0.0625, 0.075)
    armature: tuple[float, ...] = (0.01, 0.01, 0.01, 0.01, 0.03, 0.01)
    lag: tuple[float, ...] = (0.1037, 0.1011, 0.103, 0.1189, 0.1198, 0.1229)
    dead_time: float = 0.01
    timestep: float = 0.001
    payload: float = 0.0

    def without_lag(self) -> PlantParameters:
        """The same arm with commands that take effect at once, as bare motors in MIT mode do."""
        return replace(self, lag=(0.0,) * len(self.lag), dead_time=0.0)


class ArmPlant:
    """Joint state under MIT commands, advanced in fixed steps. Joint order is the description's
    `joint_names`.
    """

    def __init__(self, description: ArmDescription, parameters: PlantParameters, q: ArrayLike) -> None:
        """Starts at rest at `q` [rad] (dof,) with motors that give no torque.

        Raises ModuleNotFoundError without MuJoCo and ValueError when a parameter does not have one value per
        joint.
        """
        self.parameters = parameters
        self.dof = len(description.joint_names)
        for name in ("torque_factors", "friction", "damping", "armature", "lag"):
            count = len(getattr(parameters, name))
            if count != self.dof:
                raise ValueError(f"{name} has {count} values for {self.dof} joints")
        self._mujoco = import_mujoco()
        self.model = _compile(self._mujoco, description, parameters)
        self.data = self._mujoco.MjData(self.model)
        self._scratch = self._mujoco.MjData(self.model)
        self._q_at = np.array([self.model.joint(name).qposadr[0] for name in description.joint_names])
        self._v_at = np.array([self.model.joint(name).dofadr[0] for name in description.joint_names])
        lag = np.asarray(parameters.lag)
        self._blend = np.where(lag > 0, 1.0 - np.exp(-parameters.timestep / np.where(lag > 0, lag, 1.0)), 1.0)
        self._delay = round(parameters.dead_time / parameters.timestep)
        self.data.qpos[self._q_at] = np.asarray(q, dtype=float)
        self._mujoco.mj_forward(self.model, self.data)
        # Per joint: position, velocity; as commanded, after the dead time, after one lag and after both.
        self._target = np.stack([self.q, np.zeros(self.dof)])
        self._queue = [self._target.copy() for _ in range(self._delay)]
        self._cursor = 0
        self._lagged = [self._target.copy(), self._target.copy()]
        self._gains = np.zeros((3, self.dof))  # kp, kd, feed-forward torque; joint side
        self._bias = self.model.actuator_biasprm

    @property
    def q(self) -> NDArray[np.float64]:
        """Joint angles [rad] (dof,)."""
        return self.data.qpos[self._q_at].copy()

    @property
    def dq(self) -> NDArray[np.float64]:
        """Joint velocities [rad/s] (dof,)."""
        return self.data.qvel[self._v_at].copy()

    @property
    def feed_forward(self) -> NDArray[np.float64]:
        """Torque that is fed forward [Nm, joint] (dof,)."""
        return self._gains[2].copy()

    def joint_state(self, joint: int) -> tuple[float, float, float]:
        """Angle [rad], velocity [rad/s] and motor torque [Nm, motor] of one joint."""
        data = self.data
        torque = float(data.actuator_force[joint]) * self.parameters.torque_factors[joint]
        return float(data.qpos[self._q_at[joint]]), float(data.qvel[self._v_at[joint]]), torque

    def command(
        self, joint: int, position: float, velocity: float, torque: float, kp: float, kd: float
    ) -> None:
        """Set the MIT law of one joint [rad, rad/s, Nm motor, Nm/rad, Nm s/rad]; it holds until the next one.

        Position and velocity reach the motor through its dead time and lags, gains and torque at once.
        """
        if self._gains[0, joint] == 0.0:
            # A joint that was free may have moved: its lags begin where it is.
            self.reset_lag(joint)
        self._target[:, joint] = position, velocity
        self._set_gains(joint, kp, kd, torque)

    def release(self, joint: int, damping: float = 0.0) -> None:
        """Let a joint go, braked by `damping` [Nm s/rad, motor] only."""
        self._set_gains(joint, 0.0, damping, 0.0)
        self.reset_lag(joint)
        self._target[1, joint] = 0.0

    def reset_lag(self, joint: int) -> None:
        """Forget commands still under way to a joint: it is where it is."""
        for stage in (self._target, *self._queue, *self._lagged):
            stage[:, joint] = self.data.qpos[self._q_at[joint]], 0.0

    def shift_lag(self, joint: int, offset: float) -> None:
        """Move the commands still under way to a joint by `offset` [rad], as a motor does whose zero moves."""
        for stage in (self._target, *self._queue, *self._lagged):
            stage[0, joint] += offset

    def step(self, count: int = 1) -> None:
        """Advance by `count` timesteps."""
        for _ in range(count):
            # The actuators' affine bias is the MIT law; MuJoCo integrates its velocity term implicitly.
            self._bias[:, 0] = (self._gains[:2] * self._shaped()).sum(axis=0) + self._gains[2]
            self._mujoco.mj_step(self.model, self.data)

    def _set_gains(self, joint: int, kp: float, kd: float, torque: float) -> None:
        factor = self.parameters.torque_factors[joint]
        self._gains[:, joint] = kp / factor, kd / factor, torque / factor
        self._bias[joint, 1:3] = -kp / factor, -kd / factor

    def inverse_dynamics(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> NDArray[np.float64]:
        """Joint torques [Nm] (dof,) that a motion takes, friction, damping and rotors included."""
        data = self._scratch
        data.qpos[self._q_at], data.qvel[self._v_at], data.qacc[self._v_at] = q, dq, ddq
        self._mujoco.mj_inverse(self.model, data)
        return data.qfrc_inverse[self._v_at].copy()

    def _shaped(self) -> NDArray[np.float64]:
        arrived = self._target
        if self._delay:
            arrived, self._queue[self._cursor] = self._queue[self._cursor], self._target.copy()
            self._cursor = (self._cursor + 1) % self._delay
        first, second = self._lagged
        first += self._blend * (arrived - first)
        second += self._blend * (first - second)
        return second


def import_mujoco() -> ModuleType:
    """The `mujoco` module; ModuleNotFoundError that names the extra when it is not installed."""
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "the simulated arm needs MuJoCo: install the extra with pip install 'lerobot_policy_mimicik[sim]'"
        ) from error
    return mujoco


def _compile(mujoco: ModuleType, description: ArmDescription, parameters: PlantParameters):
    spec = mujoco.MjSpec.from_string(description.urdf)
    for geom in list(spec.geoms):
        # The arm's links cannot touch within its joint limits: their shapes only cost time.
        geom.contype = geom.conaffinity = 0
    for name in description.joint_names:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    if parameters.payload > 0.0:
        load = spec.body(description.tip_link).add_body(name="payload", pos=_TOOL_CENTRE)
        load.mass, load.ipos, load.explicitinertial = parameters.payload, (0.0, 0.0, 0.0), True
        load.inertia = (0.4 * parameters.payload * _LOAD_RADIUS**2,) * 3  # a ball's
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = parameters.timestep
    model = spec.compile()
    factors = np.asarray(parameters.torque_factors)
    at = np.array([model.joint(name).dofadr[0] for name in description.joint_names])
    model.dof_frictionloss[at] = np.asarray(parameters.friction) / factors
    model.dof_damping[at] = np.asarray(parameters.damping) / factors
    model.dof_armature[at] = parameters.armature
    return model
