"""From a hand path to joint motion: damped, speed-limited tracking as an arm's controller does it.

Tracking runs through time for a batch of episodes at once. It never jumps: each frame moves the joints by a
damped least-squares step from where they were, so that near a singularity, at a joint limit or out of
reach the arm lags behind the hand instead of swinging round.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array, cross
from lerobot_mimicik.data.slowing import stretched_clock

ROTATION_LENGTH_M = 0.15  # weighs rotation (rad) against translation (m)
_DAMPING_M = 0.02
_POSTURE_GAIN = 0.02  # fraction of the way home per frame that joints take where the pose leaves them free


def weighted(jacobian: Array) -> Array:
    """A Jacobian (n, 6, dof) with its angular rows in m per rad, so that singular values are comparable."""
    out = jacobian.copy()
    out[:, 3:] *= ROTATION_LENGTH_M
    return out


def damped_step(jacobian: Array, twist: Array, damping_m: float = _DAMPING_M) -> Array:
    """Joint steps (n, dof) for small tool displacements `twist` (n, 6: m, rad), damped least squares."""
    j = weighted(jacobian)
    error = twist * np.repeat([1.0, ROTATION_LENGTH_M], 3)
    square = j @ j.transpose(0, 2, 1) + damping_m**2 * np.eye(6)
    return (j.transpose(0, 2, 1) @ np.linalg.solve(square, error[..., None]))[..., 0]


def twist_between(current: Array, target: Array) -> Array:
    """Displacement (n, 6: m, rad) from poses `current` to `target` (n, 4, 4).

    The rotation part is axis times sine of the angle: exact enough for tracking, and without a branch cut.
    """
    out = np.empty((len(current), 6))
    out[:, :3] = target[:, :3, 3] - current[:, :3, 3]
    columns = (matrix[:, :3, :3].transpose(0, 2, 1) for matrix in (current, target))
    out[:, 3:] = 0.5 * cross(*columns).sum(axis=1)
    return out


def track(arm: ArmArrays, start: Array, targets: Array, max_step: float) -> Array:
    """Joint motion (batch, frames, dof) that follows hand poses `targets` (batch, frames, 4, 4).

    Starts at the joints `start` (batch, dof); no joint moves more than `max_step` rad per frame, none leaves
    its limits. Free directions (redundancy, singularities) drift towards the arm's home posture.
    """
    batch, frames = targets.shape[:2]
    q = np.clip(start, arm.lower, arm.upper)
    motion = np.empty((batch, frames, q.shape[1]))
    for t in range(frames):
        tool, jacobian = arm.tool_and_jacobian(q)
        twist = twist_between(tool, targets[:, t])
        homing = _POSTURE_GAIN * (arm.home - q)
        # Taking the homing motion's effect off the task leaves of it what the task does not feel.
        felt = (jacobian @ homing[..., None])[..., 0]
        step = damped_step(jacobian, twist - felt) + homing
        q = np.clip(q + limit_norm(step, max_step), arm.lower, arm.upper)
        motion[:, t] = q
    return motion


def solve_poses(arm: ArmArrays, start: Array, targets: Array, iterations: int = 40) -> tuple[Array, Array]:
    """Joints (n, dof) near `start` that reach poses (n, 4, 4), and the errors left (n, 2: m, rad)."""
    n = len(targets)
    q = track(arm, start, np.repeat(targets[:, None], iterations, axis=1), max_step=0.2)[:, -1]
    # The homing of `track` leaves a small error; a few plain steps take it out.
    for _ in range(4):
        tool, jacobian = arm.tool_and_jacobian(q)
        step = damped_step(jacobian, twist_between(tool, targets), 1e-3)
        q = np.clip(q + limit_norm(step, 0.1), arm.lower, arm.upper)
    tool = arm.matrix(q)
    twist = twist_between(tool, targets)
    errors = np.linalg.norm(twist.reshape(n, 2, 3), axis=2)
    # The sine vanishes at half a turn too: there the trace tells.
    opposed = np.einsum("nij,nij->n", tool[:, :3, :3], targets[:, :3, :3]) < 1.0
    errors[opposed, 1] = np.pi
    return q, errors


def limit_norm(step: Array, largest: float) -> Array:
    """Joint steps (n, dof) shortened, direction kept, so that no element exceeds `largest`."""
    size = np.abs(step).max(axis=-1, keepdims=True)
    return step * np.minimum(1.0, largest / np.maximum(size, 1e-12))


def smooth(motion: Array, sigma_frames: float) -> Array:
    """Zero-phase Gaussian low-pass of a joint motion (frames, dof)."""
    return gaussian_filter1d(motion, sigma_frames, axis=0, mode="nearest") if sigma_frames > 0 else motion


def limit_speed(motion: Array, max_step: float) -> Array:
    """The same joint path (frames, dof), slower where a joint would move over `max_step` rad per frame.

    Time is stretched locally and smoothly, as a person slows for a difficult passage: the result has more
    frames.
    """
    for attempt in range(20):
        steps = np.abs(np.diff(motion, axis=0)).max(initial=0.0)
        if steps <= max_step:
            return motion
        # Interpolation between the old frames may come out a little faster than their mean, at a sharp corner
        # again and again: the aim is lowered each time.
        clock = stretched_clock(motion, 0.97 ** (1 + attempt / 2) * max_step)
        motion = PchipInterpolator(np.arange(len(motion)), motion, axis=0)(clock)
    raise ValueError(f"a joint path still moves {steps:.4f} rad per frame after slowing it to {max_step} rad")
