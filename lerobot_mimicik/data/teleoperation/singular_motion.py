"""Joint motion through singularities: recovery demonstrations and the long near-singular test trajectories.

Near a singularity an operator thinks of the joints, not of the tool's path: the motion is a sum of
minimum-jerk movements of the joints between via configurations, and the hand's target strays a little where
the arm cannot follow.
"""

import numpy as np

from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.data.teleoperation.hand_motion import slow_wave
from lerobot_mimicik.data.teleoperation.singularities import NEAR, SingularityGauge, lost_directions

_SLOWEST_S = 0.5  # no movement between two via configurations takes less


class JointPath:
    """Minimum-jerk movements between joint configurations, one after the other, slightly overlapping."""

    def __init__(self, start: Array, rng: np.random.Generator):
        self.start = start
        self.here = start.copy()
        self.now = 0.0
        self._rng = rng
        self._moves: list[tuple[float, float, Array]] = []

    def move(self, q: Array, speed: float) -> None:
        """Goes to `q` (dof,) so that the fastest joint peaks at about `speed` rad/s."""
        way = q - self.here
        duration = max(_SLOWEST_S, 1.875 * float(np.abs(way).max()) / speed) * self._rng.uniform(0.9, 1.2)
        self._moves.append((self.now, duration, way))
        self.here = q.copy()
        self.now += duration * self._rng.uniform(0.85, 1.0)

    def rest(self, seconds: float) -> None:
        """Holds still."""
        self.now += seconds

    def sample(self, fps: float) -> Array:
        """Joints (frames, dof) from the start to the end of the last movement."""
        end = max((onset + duration for onset, duration, _ in self._moves), default=0.0)
        times = np.arange(int(np.ceil(max(end, self.now) * fps)) + 1) / fps
        motion = np.tile(self.start, (len(times), 1))
        for onset, duration, way in self._moves:
            phase = np.clip((times - onset) / duration, 0.0, 1.0)[:, None]
            motion += phase**3 * (10 - 15 * phase + 6 * phase**2) * way
        return motion


def leg(start: Array, regular: Array, singular: Array, rng: np.random.Generator, fps: float) -> Array:
    """Joints (frames, dof) of one passage, from rest to rest.

    From `start` (dof,) into a singular configuration (a row of `singular`), some hesitant movements there,
    and out to an everyday configuration (a row of `regular`).
    """
    path = JointPath(start, rng)
    pace = rng.uniform(0.5, 0.9)
    trap = singular[rng.integers(len(singular))]
    path.move(trap + rng.normal(size=trap.shape) * 0.03, pace)
    path.rest(rng.exponential(0.3))
    for _ in range(int(rng.integers(1, 4))):
        path.move(trap + rng.normal(size=trap.shape) * 0.10, 0.5 * pace)
    path.move(regular[rng.integers(len(regular))], pace)
    path.rest(rng.exponential(0.4))
    return path.sample(fps)


def recovery(regular: Array, singular: Array, rng: np.random.Generator, fps: float, seconds: float) -> Array:
    """Joints (frames, dof) of one recovery demonstration: passages until `seconds` have passed."""
    pieces = [regular[rng.integers(len(regular))][None]]
    while sum(len(piece) for piece in pieces) < seconds * fps:
        pieces.append(leg(pieces[-1][-1], regular, singular, rng, fps))
    return np.concatenate(pieces)


def strayed_hand(
    gauge: SingularityGauge, q: Array, rng: np.random.Generator, fps: float, largest_m: float
) -> Array:
    """How far the hand's target is from the arm's tool (frames, 6: m, rad) during a singular motion.

    Zero away from singularities; near them a slow wandering of at most `largest_m` along the direction that
    the arm has lost (rotation counts 0.15 m per rad).
    """
    closeness = np.clip(1.0 - gauge.nearest(q) / NEAR, 0.0, 1.0)
    # Smoothstep: the hand leaves the tool and returns to it without a kink.
    closeness = closeness**2 * (3 - 2 * closeness)
    push = largest_m * np.clip(0.5 * slow_wave((len(q), 1), fps, rng), -1.0, 1.0)
    return closeness[:, None] * push * lost_directions(gauge.arm, q)
