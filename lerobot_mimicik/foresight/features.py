"""What foresight sees: steps towards the last targets, the last commands' steps, the joints.

    targets (H, 7) ──damped least squares at q──> joint steps (H, dof) ──Legendre──> H coefficients a joint ┐
                   └─relative to the last one ──Legendre──> log energies of high orders                    ├─> (n,)
    last commands ──> S steps (S, dof);   joints ──> -1..1 between the limits                              ┘

A motion of a hand is smooth over half a second: its targets fill the low orders of the discrete Legendre basis, and a
tremor fills all of them. In this basis both have their own numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.kinematics_kernels import steps_towards
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain, quaternion_from_matrix
from lerobot_mimicik.kinematics.plausibility import joint_limits

Array = NDArray[np.float64]

PAST_STEPS = 3
"""Steps of the last commands: velocity, acceleration and its change."""
_LEVER = 0.13  # metres per radian as a fraction of the reach, as in `guidance.model`
_DAMPING = 4e-3
"""Of the least squares step, as a fraction of the reach: 3 mm on an arm of 0.76 m."""
_ORDERS = ((2, 4), (4, 6), (6, 9), (9, None))
"""Bands of Legendre orders whose energies are told, for translation and for rotation."""
_QUIET_M = 1e-5  # energies below are none


class Features:
    """Of one arm, for any number of configurations at once.

    Attributes:
        history: Targets H that are looked at, the present one included.
        dof: Number of joints.
        lower, upper: Joint limits (dof,) [rad, m].
        width: Numbers of an observation, the present least squares step not counted.
    """

    def __init__(self, description: ArmDescription, history: int) -> None:
        """ValueError for fewer than 5 targets, which show no tremor."""
        if history < 5:
            raise ValueError(f"history={history}: expected at least 5 targets")
        self.history = history
        self._chain = array_chain(description)
        self.dof = self._chain.dof
        self.lower, self.upper = (bound.copy() for bound in joint_limits(description))
        turns = np.clip(self.lower, -np.pi, None), np.clip(self.upper, None, np.pi)
        self._middle, self._half = (turns[1] + turns[0]) / 2, np.maximum((turns[1] - turns[0]) / 2, 1e-3)
        reach = max(self._chain.stretched_length(0), 1e-6)
        self._lever = _LEVER * reach
        self._damping = _DAMPING * reach
        self._kernel = arm_model(description).chain
        self._basis = legendre(history)
        self._bands = [(low, high) for low, high in _ORDERS if low < history]
        self.width = (history + PAST_STEPS + 1) * self.dof + 2 * len(self._bands)

    def __call__(self, q: Array, targets: Array, steps: Array) -> tuple[Array, Array]:
        """What the network is told.

        Args:
            q: Last commands (B, dof) [rad, m].
            targets: `T_base_tool` (B, H, 7), oldest first.
            steps: The last commands' steps (B, S, dof), oldest first.

        Returns:
            The damped least squares step to the present target (B, dof), and observations (B, width): coefficients
            (H, dof), steps (S, dof), joints (dof,), energies.
        """
        if len(q) == 1:  # a robot's own query: compiled, it takes a tenth of the time
            found = steps_towards(q[0], targets[0], self._kernel, self._lever, self._damping)
            towards, error = found[0][None], found[1][None]
        else:
            towards, error = self._towards(q, targets)
        many = len(q)
        observation = np.concatenate(
            [
                (self._basis @ towards).reshape(many, -1),
                steps.reshape(many, -1),
                (q - self._middle) / self._half,
                self._energies(self._basis @ error),
            ],
            axis=1,
        )
        return towards[:, -1], observation

    def _towards(self, q: Array, targets: Array) -> tuple[Array, Array]:
        """Damped least squares steps (B, H, dof) and pose errors (B, H, 6); many at once."""
        rotation, position, jacobian = self._chain.forward_and_jacobian(q)
        jacobian[:, 3:] *= self._lever
        here = quaternion_from_matrix(rotation) * _CONJUGATE
        error = np.concatenate(
            [targets[..., :3] - position[:, None], self._lever * _turn(targets[..., 3:], here[:, None])],
            axis=-1,
        )
        square = jacobian @ jacobian.transpose(0, 2, 1) + self._damping**2 * np.eye(6)
        towards = np.linalg.solve(square, error.transpose(0, 2, 1)).transpose(0, 2, 1) @ jacobian
        return towards, error

    def _energies(self, coefficients: Array) -> Array:
        """Logarithms of the root energies of each band, (B, 2 bands), of coefficients (B, H, 6)."""
        squares = coefficients**2
        halves = np.stack([squares[..., :3].sum(axis=2), squares[..., 3:].sum(axis=2)], axis=1)
        bands = [halves[..., low:high].sum(axis=2) for low, high in self._bands]
        return np.log(_QUIET_M + np.sqrt(np.concatenate(bands, axis=1)))


_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def legendre(length: int) -> Array:
    """Orthonormal polynomials on so many equidistant points, (order, point)."""
    powers = np.vander(np.linspace(-1.0, 1.0, length), length, increasing=True)
    basis, triangle = np.linalg.qr(powers)
    return (basis * np.sign(np.diag(triangle))).T


def _turn(to: Array, back: Array) -> Array:
    """Rotation vectors (*, 3) of the product of unit quaternions xyzw."""
    ax, ay, az, aw = np.moveaxis(to, -1, 0)
    bx, by, bz, bw = np.moveaxis(back, -1, 0)
    w = aw * bw - ax * bx - ay * by - az * bz
    vector = np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
    sine = np.sqrt((vector**2).sum(axis=-1))
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return vector * (np.where(w < 0, -1.0, 1.0) * scale)[..., None]
