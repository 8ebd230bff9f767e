"""Wrist, elbow and shoulder singularities of a serial arm: how near one is, where they are, what they cost.

Three numbers, all zero at the singularity and of the order of one far from it, are read off the joint axes of
any arm of revolute joints. The last three joints count as the wrist, those before as the arm:

- wrist: |a4 . (a5 x a6)| of the wrist's axes (|sin q5| of a spherical wrist);
- elbow: how fast the joints between shoulder and wrist can lengthen or shorten the arm;
- shoulder: distance of the wrist centre from the base joint's axis.

The last two are shares of the largest value the arm can have.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array, cross
from lerobot_mimicik.data.teleoperation.hand_tracking import ROTATION_LENGTH_M, weighted

KINDS = ("wrist", "elbow", "shoulder")
NEAR = 0.1  # a measure below this counts as near-singular


@dataclass(frozen=True)
class SingularityGauge:
    """Measures how near configurations are to the three kinds of singularity."""

    arm: ArmArrays
    scale: dict[str, float]

    @classmethod
    def for_arm(cls, arm: ArmArrays, rng: np.random.Generator) -> "SingularityGauge":
        """Calibrates the scales on random configurations."""
        q = rng.uniform(arm.lower, arm.upper, size=(2048, len(arm.lower)))
        raw = _raw_measures(arm, q)
        return cls(arm, {kind: max(float(np.max(raw[kind])), 1e-9) for kind in KINDS})

    def __call__(self, q: Array) -> dict[str, Array]:
        """Measures (n,) by kind for joints (n, dof)."""
        return {kind: value / self.scale[kind] for kind, value in _raw_measures(self.arm, q).items()}

    def nearest(self, q: Array) -> Array:
        """Smallest of the three measures, (n,)."""
        return np.min(np.stack(list(self(q).values())), axis=0)


def find_singular(gauge: SingularityGauge, kind: str, start: Array, iterations: int = 8) -> Array:
    """Configurations of `kind` near those of `start` (n, dof); the rows that found one, possibly none.

    Newton's method on the one number, along its gradient by finite differences, within the joint limits.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of singularity {kind!r}; known: {', '.join(KINDS)}")
    lower, upper = gauge.arm.lower, gauge.arm.upper
    q = np.clip(start, lower, upper)
    n, dof = q.shape
    probe = 1e-4
    for _ in range(iterations):
        around = q[:, None] + probe * np.concatenate([np.zeros((1, dof)), np.eye(dof)])
        value = gauge(around.reshape(-1, dof))[kind].reshape(n, dof + 1)
        slope = (value[:, 1:] - value[:, :1]) / probe
        step = -value[:, :1] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-6)
        q = np.clip(q + np.clip(step, -0.3, 0.3), lower, upper)
    return q[gauge(q)[kind] < 0.02]


def lost_directions(arm: ArmArrays, q: Array) -> Array:
    """The tool motion (n, 6: m, rad) that is hardest for the joints (n, dof), continuous along the path.

    Left singular vector of the smallest singular value, of unit length when rotation counts ROTATION_LENGTH_M
    per rad.
    """
    left = np.linalg.svd(weighted(arm.jacobian(q)))[0][:, :, -1]
    flips = np.where(np.sum(left[1:] * left[:-1], axis=1) < 0, -1.0, 1.0)
    left[1:] *= np.cumprod(flips)[:, None]
    return left / np.repeat([1.0, ROTATION_LENGTH_M], 3)


def _raw_measures(arm: ArmArrays, q: Array) -> dict[str, Array]:
    matrix, jacobian = arm.tool_and_jacobian(q)
    tool = matrix[:, :3, 3]
    columns = jacobian[:, :, arm.base_to_tip].transpose(0, 2, 1)
    axes = columns[..., 3:]
    # The foot of the perpendicular from the tool on a joint's axis, from what the joint does to the tool.
    feet = tool[:, None] + cross(axes, columns[..., :3])
    dof = q.shape[1]
    split = min(dof, max(3, dof - 3))
    centre = _wrist_centre(axes[:, split:], feet[:, split:], tool)
    moves = cross(axes[:, :split], centre[:, None] - feet[:, :split])
    return {
        "wrist": _twist(axes[:, split:]),
        "elbow": _stretching(moves, centre - feet[:, 1], axes[:, 1]),
        "shoulder": np.linalg.norm(moves[:, 0], axis=1),
    }


def _twist(wrist: Array) -> Array:
    """|a4 . (a5 x a6)| of the axes (n, 3, 3); wrists of fewer joints are never singular in this sense."""
    if wrist.shape[1] < 3:
        return np.ones(len(wrist))
    return np.abs(np.einsum("ni,ni->n", wrist[:, 0], cross(wrist[:, 1], wrist[:, 2])))


def _stretching(moves: Array, lever: Array, axis: Array) -> Array:
    """Largest speed (n,) at which a joint beyond the second changes the wrist centre's distance to its axis.

    `moves` (n, joints, 3): what each arm joint does to the wrist centre; `lever` (n, 3): to the wrist centre
    from a point of the second joint's axis, `axis` (n, 3).
    """
    if moves.shape[1] < 3:
        return np.ones(len(moves))
    radial = lever - axis * np.einsum("ni,ni->n", lever, axis)[:, None]
    radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-9)
    return np.abs(np.einsum("nji,ni->nj", moves[:, 2:], radial)).max(axis=1)


def _wrist_centre(axes: Array, feet: Array, tool: Array) -> Array:
    """The point (n, 3) nearest to the wrist's joint axes: their intersection in a spherical wrist."""
    if axes.shape[1] == 0:
        return tool
    # Each axis contributes the projector on its normal plane; where that leaves a line, stay near the tool.
    normal = np.eye(3) - axes[..., :, None] * axes[..., None, :]
    square = normal.sum(axis=1) + 1e-6 * np.eye(3)
    right = np.einsum("nkij,nkj->ni", normal, feet - tool[:, None])
    return tool + np.linalg.solve(square, right[..., None])[..., 0]
