"""Chunks that do not fit together: where the next targets are known, a jump between two is spread over some frames."""

import numpy as np
import pytest

from lerobot_mimicik.guidance.blending import Blending
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.kinematics.arms import describe_arm

MODEL = ArmModel(describe_arm("airbot_play"))
HOME = MODEL.comfortable()
FRAMES, SEAM, JUMP = 60, 30, np.array([0.012, -0.008, 0.004])
MOTION = HOME + 0.2 * (1 - np.cos(np.linspace(0, 2 * np.pi, FRAMES)))[:, None] * [1, 0.3, -0.4, 1, 0.5, -1]
CLEAN = np.array([MODEL.pose(q) for q in MOTION])


def jumping(jump=JUMP) -> np.ndarray:
    targets = CLEAN.copy()
    targets[SEAM:, :3] += jump
    return targets


def chunk(targets, t, known_beyond=True) -> np.ndarray:
    """What is known at frame `t`: seven targets more, or those of the chunk that is in use."""
    end = t + 8 if known_beyond or t >= SEAM else min(t + 8, SEAM)
    return targets[t:end]


def aims(targets, known_beyond=True, frames=8) -> np.ndarray:
    blending = Blending(frames, MODEL.lever, MODEL.reach)
    return np.array([blending(chunk(targets, t, known_beyond))[0] for t in range(len(targets))])


def driven(targets, blend=8) -> np.ndarray:
    solver, q, commands = Guidance(MODEL, GuidanceSettings(blend=blend)), MOTION[0], []
    solver.reset(q)
    for t, target in enumerate(targets):
        q = solver.solve(q, target, targets[t + 1 : t + 8]).q
        commands.append(q)
    return np.array(commands)


def peak(x, order) -> float:
    return float(np.abs(np.diff(x, n=order, axis=0)).max())


@pytest.mark.parametrize("known_beyond", [True, False])
def test_a_seam_is_gone_over_without_a_jump_and_the_rest_is_what_was_asked(known_beyond):
    targets = jumping()
    gone_to = aims(targets, known_beyond)
    steps = [np.linalg.norm(np.diff(x[:, :3], axis=0), axis=1).max() for x in (gone_to, CLEAN, targets)]
    assert steps[0] < steps[1] + 0.3 * np.linalg.norm(JUMP) < steps[2]
    away = np.linalg.norm((gone_to - targets)[:, :3], axis=1)
    assert away[: SEAM - 4].max() == 0
    assert away[SEAM + (4 if known_beyond else 8) :].max() < 1e-9
    assert away.max() < (0.6 if known_beyond else 1.0) * np.linalg.norm(JUMP)


def test_what_is_smooth_large_or_trembling_is_left_alone():
    rng = np.random.default_rng(0)
    trembling = CLEAN + np.pad(rng.normal(0, 0.002, (FRAMES, 3)), ((0, 0), (0, 4)))
    for targets in (CLEAN, jumping(20 * JUMP), jumping(0.05 * JUMP), trembling):
        np.testing.assert_array_equal(aims(targets), targets)
    np.testing.assert_array_equal(aims(jumping(), frames=0), jumping())


def test_nothing_is_blended_where_the_future_is_not_known():
    blending, targets = Blending(8, MODEL.lever, MODEL.reach), jumping()
    for target in targets:
        np.testing.assert_array_equal(blending(target[None])[0], target)


def test_a_seam_that_another_chunk_takes_the_place_of_leaves_no_jump():
    blending, targets = Blending(8, MODEL.lever, MODEL.reach), jumping()
    turn = SEAM - 2  # half way into the blend the jump is taken back
    gone_to = np.array([blending((targets if t < turn else CLEAN)[t : t + 8])[0] for t in range(FRAMES)])
    assert peak((gone_to - CLEAN)[:, :3], 1) < 0.3 * np.linalg.norm(JUMP)
    np.testing.assert_allclose(gone_to[turn + 8 :], CLEAN[turn + 8 :], atol=1e-9)


def test_the_arm_goes_over_a_seam_that_is_known_ahead_with_a_fraction_of_the_jerk():
    targets = jumping()
    commands = driven(targets)
    assert peak(commands, 3) < 0.2 * peak(driven(targets, blend=0), 3)
    reached = np.array([MODEL.pose(q) for q in commands])
    assert np.linalg.norm((reached - targets)[SEAM + 5 :, :3], axis=1).max() < 1e-3
