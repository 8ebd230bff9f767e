"""Closed-loop rounds: the policy's own way along clean motion under a trembling target, with what it should have done.

Trained on recorded frames only, a policy never sees the small errors that it makes itself, and in closed loop is no
smoother than a solver. So it is driven, many pieces of motion side by side, as it will be at run time, and learns in
every frame what the clean motion says (DAgger, Ross et al. 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lerobot_mimicik.foresight.features import PAST_STEPS, Features
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.tremor import BAND_HZ, displaced, tremor

Array = NDArray[np.float64]
Step = Callable[[Array, Array], Array]
"""A network's joint steps (B, dof) [rad, m] of the answers of `Features`."""

_PIECE = 300  # frames; 15 s at 20 Hz: pieces of much different lengths would leave rows of a batch idle
_SHORTEST = 12  # frames
_LOST = 0.08  # rad from the clean motion, from which a rollout teaches nothing and is put back on it
_NARROW = 0.5  # fraction of hands that tremble in a band of their own, the others in all of it
_SLOW_HZ, _FALL_HZ = 0.3, 0.8  # movements on top of a motion: slowest, and what divides the energy by e
_WIDE = 3.0  # rad of range from which a joint moves as much as any
_HALVINGS = 4  # of what is added, until it keeps the limits
_CUT_S = 5.0  # shortest noise that is made, s: a short piece takes a part of it


@dataclass(frozen=True)
class Hand:
    """What is added to clean motion.

    Attributes:
        fps: Frames per second.
        tremor_mm: Largest root mean square of the tremor's translation [mm], half a degree per mm.
        steady: Fraction of pieces without any.
        pace: Largest factor by which a piece is made faster.
        liveliness: Largest root mean square of the joint velocity that is added to a piece [rad/s].
        max_step: Largest joint step of the faster motion [rad].
    """

    fps: float
    tremor_mm: float
    steady: float
    pace: float
    liveliness: float = 0.0
    max_step: float = 0.09


@dataclass(frozen=True)
class Samples:
    """What rollouts came to, N frames.

    Attributes:
        base: Damped least squares steps (N, dof).
        observation: As `Features` give them (N, width).
        q: Commands that the frames started from (N, dof) [rad, m].
        step: What should be done (N, dof).
    """

    base: Array
    observation: Array
    q: Array
    step: Array


def pieces(joints: Array, episodes: Array) -> list[Array]:
    """Clean motion (n, dof) in pieces that can be driven side by side.

    Args:
        joints: Target joints of all frames (N, dof).
        episodes: Their episodes (N,).
    """
    found = []
    bounds = np.flatnonzero(np.diff(episodes)) + 1
    for episode in np.split(joints, bounds):
        parts = np.array_split(episode, max(1, round(len(episode) / _PIECE)))
        found += [part.astype(float) for part in parts if len(part) >= _SHORTEST]
    return found


def drive(
    features: Features,
    description: ArmDescription,
    motions: Sequence[Array],
    step: Step,
    hand: Hand,
    change_weight: float,
    rng: np.random.Generator,
) -> Samples:
    """Drive a policy along motions and say what it should have done.

    What should be done weighs the error of the step against that of its change, the acceleration: both are squared, so
    that their weighted sum is least at one step, the weighted mean of the way back to the clean motion and of the last
    step changed as the clean motion changes its own.

    Args:
        features: Of the arm.
        description: The arm.
        motions: Clean joints (n, dof) each.
        step: The policy.
        hand: What trembles.
        change_weight: Weight of the squared error of the step's change, that of the step itself being 1.
        rng: Of tremor and pace.
    """
    motions = [_faster(_livelier(motion, features, hand, rng), hand, rng) for motion in motions]
    lengths = np.array([len(motion) for motion in motions])
    longest, dof = int(lengths.max()), features.dof
    clean = np.stack([motion[np.minimum(np.arange(longest), len(motion) - 1)] for motion in motions])
    asked = array_chain(description).pose(clean.reshape(-1, dof)).reshape(len(motions), longest, 7)
    noise = np.stack([_trembling(longest, hand, rng) for _ in motions])
    asked = displaced(asked.reshape(-1, 7), noise.reshape(-1, 6)).reshape(asked.shape)

    q, near = clean[:, 0].copy(), 1.0 / (1.0 + change_weight)
    history = np.repeat(asked[:, :1], features.history, axis=1)
    steps = np.zeros((len(motions), PAST_STEPS, dof))
    frames: list[tuple[Array, ...]] = []
    for t in range(longest):
        rows = np.flatnonzero(lengths > t)
        history = np.concatenate([history[:, 1:], asked[:, t : t + 1]], axis=1)
        base, observation = features(q[rows], history[rows], steps[rows])
        wanted, before, earlier = (clean[rows, max(t - age, 0)] for age in (0, 1, 2))
        change = wanted - 2 * before + earlier
        best = near * (wanted - q[rows]) + (1 - near) * (steps[rows, -1] + change)
        frames.append((base, observation, q[rows].copy(), best))
        done = np.clip(step(base, observation), -hand.max_step, hand.max_step)
        reached = np.clip(q[rows] + done, features.lower, features.upper)
        lost = np.abs(wanted - reached).max(axis=1) > _LOST
        reached[lost] = wanted[lost]
        steps[rows] = np.concatenate([steps[rows, 1:], (reached - q[rows])[:, None]], axis=1)
        steps[rows[lost]] = (wanted - before)[lost][:, None]
        q[rows] = reached
    return Samples(*(np.concatenate(column) for column in zip(*frames, strict=True)))


def _livelier(motion: Array, features: Features, hand: Hand, rng: np.random.Generator) -> Array:
    """The motion (n, dof) with small quick movements on top, within the joints' limits.

    People's joints have thirty times the energy at 4 Hz that minimum-jerk movements have; their spectrum of velocity falls
    off exponentially.
    """
    frames, dof = motion.shape
    frequency = np.fft.rfftfreq(frames, 1 / hand.fps)
    strength = np.where(frequency > _SLOW_HZ, np.exp(-0.5 * frequency / _FALL_HZ), 0.0)
    if hand.liveliness == 0 or not strength.any():
        return motion
    real, imaginary = rng.normal(size=(2, len(frequency), dof))
    velocity = np.fft.irfft(strength[:, None] * (real + 1j * imaginary), n=frames, axis=0)
    velocity *= hand.liveliness * rng.uniform() ** 2 / np.sqrt((velocity**2).mean(axis=0))
    # Joints of a short range, and those that slide, have less room.
    velocity *= np.minimum(1.0, (features.upper - features.lower) / _WIDE)
    added = np.cumsum(velocity, axis=0) / hand.fps
    for _ in range(_HALVINGS):
        livelier = motion + added - added[0]
        if ((livelier > features.lower) & (livelier < features.upper)).all():
            return livelier
        added /= 2
    return motion


def _faster(motion: Array, hand: Hand, rng: np.random.Generator) -> Array:
    """The motion (n, dof) in fewer frames, by a factor up to the hand's pace that keeps the largest step.

    In more frames, where the motion is too fast.
    """
    largest = max(float(np.abs(np.diff(motion, axis=0)).max()), 1e-9)
    most = min(hand.pace, hand.max_step / largest, len(motion) / _SHORTEST)
    pace = most if most < 1.0 else float(np.exp(rng.uniform(0.0, np.log(most))))
    if pace == 1.0:
        return motion
    times = np.arange(0.0, len(motion) - 1, pace)
    return CubicSpline(np.arange(len(motion)), motion)(times)


def _trembling(frames: int, hand: Hand, rng: np.random.Generator) -> Array:
    """Noise (frames, 6) of one hand: how much, how much of it turning, and in which band, is its own."""
    if rng.random() < hand.steady or hand.tremor_mm == 0:
        return np.zeros((frames, 6))
    band = BAND_HZ
    if rng.random() < _NARROW:
        centre, half = rng.uniform(BAND_HZ[0] + 0.5, BAND_HZ[1] - 0.5), rng.uniform(0.5, 2.5)
        band = (max(BAND_HZ[0], centre - half), min(BAND_HZ[1], centre + half))
    length = max(frames, round(_CUT_S * hand.fps))
    noise = tremor(length, hand.fps, rng.uniform(0.0, hand.tremor_mm), rng, band)[:frames]
    noise[:, 3:] *= rng.uniform(0.5, 1.5)
    return noise
