"""Identification of the simulated arm's friction, inertia and lag from a log of a moving real arm.

`PlantParameters`' defaults are what `identify` finds in 25 s of multi-sine motion of a real AIRBOT Play.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.signal import lfilter, savgol_filter

from lerobot_mimicik.kinematics.arms import ArmDescription
from robot_adapters.can.gravity import GravityModel
from robot_adapters.simulation.plant import ArmPlant, PlantParameters

_STRIDE = 4
# Velocity [rad/s] at which Coulomb friction counts as fully reversed, a few velocity quanta.
_REVERSAL = 0.03
# A log of slow motion cannot tell less damping [Nm s/rad, joint] from none, and hardly shows the rotors'
# inertia [kg m^2]: outside this range it is the noise that was fitted.
_LEAST_DAMPING = 0.05
_LEAST_ARMATURE, _MOST_ARMATURE = 0.01, 0.03


@dataclass(frozen=True)
class MotionLog:
    """A moving arm: times [s] (n,), measured and commanded angles [rad] and velocities [rad/s], motor torques
    [Nm] (n, dof).
    """

    time: NDArray[np.float64]
    q: NDArray[np.float64]
    dq: NDArray[np.float64]
    torque: NDArray[np.float64]
    q_commanded: NDArray[np.float64]
    dq_commanded: NDArray[np.float64]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            shape = getattr(self, field.name).shape
            if shape != self.q.shape or len(shape) != 2 or shape[0] != len(self.time):
                raise ValueError(f"{field.name} has shape {shape}, expected ({len(self.time)}, dof) as q")


@dataclass(frozen=True)
class Tracking:
    """How a simulated arm follows a log: root mean square difference per joint [rad] (dof,), at the fitted
    delay [s] (dof,).
    """

    rms: NDArray[np.float64]
    delay: NDArray[np.float64]


def identify(
    description: ArmDescription, log: MotionLog, start: PlantParameters | None = None
) -> PlantParameters:
    """Fit friction, damping, armature and the two lags per joint; the rest stays as in `start`.

    Torques: least squares of what inverse dynamics leaves on acceleration, velocity and its sign. Lags: the
    time constant that makes two equal first-order lags after the dead time map commanded onto measured
    angles.
    """
    start = start or PlantParameters()
    period = float(np.mean(np.diff(log.time)))
    grid = np.arange(log.time[0], log.time[-1], period)
    q, torque, commanded = (_resampled(grid, log.time, x) for x in (log.q, log.torque, log.q_commanded))
    window = 2 * round(0.1 / period) + 1
    velocity = savgol_filter(q, window, 3, deriv=1, delta=period, axis=0)
    acceleration = savgol_filter(q, window, 3, deriv=2, delta=period, axis=0)
    # Neighbouring samples of a slow motion say the same twice.
    q_few, velocity, acceleration, torque = (x[::_STRIDE] for x in (q, velocity, acceleration, torque))
    rigid = _inverse_dynamics(description, start, q_few, velocity, acceleration)
    friction, damping, armature, lag = [], [], [], []
    for joint, factor in enumerate(start.torque_factors):
        left = torque[:, joint] - factor * rigid[:, joint]
        v = velocity[:, joint]
        terms = np.stack(
            [np.tanh(v / _REVERSAL), v, factor * acceleration[:, joint], np.ones_like(v)], axis=1
        )
        coulomb, viscous, inertia, _ = np.linalg.lstsq(terms, left, rcond=None)[0]
        friction.append(max(coulomb, 0.0))
        damping.append(max(viscous, _LEAST_DAMPING * factor))
        armature.append(min(max(inertia, _LEAST_ARMATURE), _MOST_ARMATURE))
        lag.append(_fitted_lag(commanded[:, joint], q[:, joint], period, start.dead_time))
    found = dataclasses.replace(
        start,
        friction=_rounded(friction),
        damping=_rounded(damping),
        armature=_rounded(armature),
        lag=_rounded(lag),
    )
    # Friction under the MIT law delays the arm further: the lags give back what it takes.
    delay = tracking(log, *follow(description, found, log)).delay
    lag = [max(value + extra / 2.0, 0.0) for value, extra in zip(found.lag, delay, strict=True)]
    return dataclasses.replace(found, lag=_rounded(lag))


def follow(
    description: ArmDescription,
    parameters: PlantParameters,
    log: MotionLog,
    kp: tuple[float, ...] = (100.0, 100.0, 100.0, 20.0, 20.0, 20.0),
    kd: tuple[float, ...] = (3.0, 3.0, 3.0, 1.0, 1.0, 1.0),
    rate: float = 250.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times [s] (m,) and joint angles [rad] (m, dof) of the plant under the log's commands and gravity
    feed-forward.
    """
    plant = ArmPlant(description, parameters, log.q[0])
    gravity = GravityModel(description)
    factors = np.asarray(parameters.torque_factors)
    times = np.arange(log.time[0], log.time[-1], 1.0 / rate)
    position = _resampled(times, log.time, log.q_commanded)
    velocity = _resampled(times, log.time, log.dq_commanded)
    steps = round(1.0 / rate / parameters.timestep)
    angles = np.empty_like(position)
    for index in range(len(times)):
        angles[index] = plant.q
        torque = factors * gravity.torques(plant.q)
        for joint in range(plant.dof):
            plant.command(
                joint, position[index, joint], velocity[index, joint], torque[joint], kp[joint], kd[joint]
            )
        plant.step(steps)
    return times, angles


def tracking(
    log: MotionLog, times: NDArray[np.float64], angles: NDArray[np.float64], span: float = 0.3
) -> Tracking:
    """Compare angles (m, dof) at `times` with a log's, shifted by the delay within +-`span` [s] that fits
    each joint best.
    """
    delays = np.arange(-span, span, 0.002)
    inside = (log.time > log.time[0] + span) & (log.time < log.time[-1] - span)
    at, q = log.time[inside], log.q[inside]
    rms = np.array(
        [
            [
                np.sqrt(np.mean((np.interp(at - delay, times, angles[:, j]) - q[:, j]) ** 2))
                for j in range(q.shape[1])
            ]
            for delay in delays
        ]
    )
    return Tracking(rms.min(axis=0), delays[rms.argmin(axis=0)])


def _resampled(grid: NDArray, time: NDArray, values: NDArray) -> NDArray:
    return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)


def _rounded(values: list[float]) -> tuple[float, ...]:
    return tuple(round(float(value), 4) for value in values)


def _inverse_dynamics(
    description: ArmDescription,
    parameters: PlantParameters,
    q: NDArray,
    velocity: NDArray,
    acceleration: NDArray,
) -> NDArray:
    """Joint torques (n, dof) that the rigid body alone asks for, without friction or rotors."""
    zeros = (0.0,) * q.shape[1]
    bare = dataclasses.replace(parameters, friction=zeros, damping=zeros, armature=zeros)
    plant = ArmPlant(description, bare, q[0])
    return np.stack([plant.inverse_dynamics(*row) for row in zip(q, velocity, acceleration, strict=True)])


def _fitted_lag(commanded: NDArray, measured: NDArray, period: float, dead_time: float) -> float:
    delay = max(round(dead_time / period), 0)
    late = np.concatenate([np.full(delay, commanded[0]), commanded[: len(commanded) - delay]])

    def error(lag: NDArray) -> float:
        blend = 1.0 - np.exp(-period / max(float(lag[0]), 1e-4))
        out = late - late[0]
        for _ in range(2):
            out = lfilter([blend], [1.0, blend - 1.0], out)
        return float(np.mean((out + late[0] - measured) ** 2))

    return float(minimize(error, [0.1], method="Nelder-Mead", options={"xatol": 1e-4}).x[0])
