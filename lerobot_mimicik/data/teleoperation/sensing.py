"""What a recording adds to a motion: a follower's lag, encoder steps, noise and pose-label errors."""

import math

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import Array

ENCODER_QUANTUM_RAD = 25.0 / 65535.0  # 16 bits over -12.5..12.5 rad: 0.381 mrad, as on the AIRBOT Play


def follow(commands: Array, lag_s: float, fps: float) -> Array:
    """Joint positions (n, dof) of an arm that follows `commands` (n, dof) with a first-order lag.

    A command given at frame t acts until frame t + 1; the arm starts at rest on the first command. With no
    lag the position at t + 1 is the command of t; with a lag the rest of the way after one frame is
    exp(-1 / (fps lag_s)).
    """
    remaining = lag_remainder(lag_s, fps)
    held = np.concatenate([commands[:1], commands[:-1]])
    rest = remaining * commands[:1]
    return lfilter([1.0 - remaining], [1.0, -remaining], held, axis=0, zi=rest)[0]


def lag_remainder(lag_s: float, fps: float) -> float:
    """Share of a step command that is left after one frame at a first-order lag of `lag_s`."""
    if lag_s < 0:
        raise ValueError(f"lag_s must not be negative, got {lag_s}")
    return math.exp(-1.0 / (fps * lag_s)) if lag_s > 0 else 0.0


def quantise(values: Array, quantum: float) -> Array:
    """`values` rounded to the nearest multiple of `quantum` (same unit); unchanged when `quantum` is 0."""
    return np.round(values / quantum) * quantum if quantum > 0 else values


def wander(
    shape: tuple[int, ...], scale: float, seconds: float, fps: float, rng: np.random.Generator
) -> Array:
    """Slow noise (n, dof) of standard deviation `scale`, correlated over `seconds`: Ornstein-Uhlenbeck.

    It stands for friction and backlash, which leave a joint a little beside the same place each time.
    """
    keep = float(np.exp(-1.0 / (seconds * fps)))
    noise = rng.normal(size=shape) * scale
    noise[1:] *= np.sqrt(1 - keep**2)
    return lfilter([1.0], [1.0, -keep], noise, axis=0)


def perturb_poses(
    poses: Array, offset: Array, noise_m: float, noise_rad: float, rng: np.random.Generator
) -> Array:
    """Pose labels (n, 7) as an imperfectly calibrated recording gives them.

    `offset` (6,) is a constant translation (m) and rotation vector (rad) in the base frame, `noise_m` and
    `noise_rad` standard deviations per axis and frame. Quaternions xyzw, w >= 0.
    """
    n = len(poses)
    out = np.empty_like(poses)
    out[:, :3] = poses[:, :3] + offset[:3] + rng.normal(size=(n, 3)) * noise_m
    turn = Rotation.from_rotvec(offset[3:] + rng.normal(size=(n, 3)) * noise_rad)
    out[:, 3:] = (turn * Rotation.from_quat(poses[:, 3:])).as_quat(canonical=True)
    return out
