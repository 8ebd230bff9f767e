"""Out of reach and back: the hand pulls the target away from the base beyond what the arm can follow."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.closest import closest_poses, follow_closest
from lerobot_mimicik.data.stress.motion import eased, everyday_motion
from lerobot_mimicik.kinematics.tremor import displaced

_BEYOND = (1.02, 1.15)  # of the longest reach
_CONE = 0.4  # spread of the direction about straight outwards, as a fraction of its length
_LEAD_S, _OUT_S, _WAIT_S, _BACK_S, _AFTER_S = 1.0, 2.5, 1.0, 2.5, 2.0


def out_of_reach(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    """Everyday motion whose target is pulled out of reach again and again, each time another way."""
    reference = everyday_motion(arm, frames + 1, fps, rng)
    clean = arm.pose(reference[1:])
    twist = np.zeros((frames, 6))
    samples = arm.pose(rng.uniform(arm.lower, arm.upper, (4096, len(arm.lower))))[:, :3]
    reach = float(np.linalg.norm(samples, axis=1).max())
    pull = _pull(fps)
    for begin in range(0, frames - len(pull) + 1, len(pull)):
        here = slice(begin, begin + len(pull))
        middle = clean[begin + int(np.argmax(pull)), :3]
        outwards = middle / max(float(np.linalg.norm(middle)), 1e-9) + _CONE * rng.uniform(-1, 1, 3)
        outwards /= np.linalg.norm(outwards)
        twist[here, :3] = (
            pull[:, None] * _distance(middle, outwards, reach * rng.uniform(*_BEYOND)) * outwards
        )
    asked = displaced(clean, twist)
    action = follow_closest(arm, reference[0], asked)
    state = np.concatenate([reference[:1], action[:-1]])
    # Where nothing was pulled the reference motion itself is there.
    closest = clean.copy()
    pulled = np.abs(twist).max(axis=1) > 0
    closest[pulled] = closest_poses(arm, action[pulled], asked[pulled], rng)
    return [StressCase(state, action, asked, asked, "Out of reach and back", closest)]


def _pull(fps: float) -> Array:
    """How far the target is pulled, (n,), between 0 and 1."""
    lead, out, wait, back, after = (round(s * fps) for s in (_LEAD_S, _OUT_S, _WAIT_S, _BACK_S, _AFTER_S))
    return np.concatenate([np.zeros(lead), eased(out), np.ones(wait), 1 - eased(back), np.zeros(after)])


def _distance(point: Array, direction: Array, radius: float) -> float:
    """How far along `direction` (3,) the sphere of this radius about the base lies from `point` (3,), m."""
    along = float(point @ direction)
    return -along + float(np.sqrt(max(along**2 + radius**2 - float(point @ point), 0.0)))
