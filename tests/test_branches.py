"""Leaving a branch: only where a limit is in the way, only to what meets the target, never further than allowed."""

import numpy as np
import pytest

from lerobot_mimicik.guidance.branches import BranchChange
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.settings import PoseTask
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import pose_distance

ARM = describe_arm("airbot_play")
MODEL = ArmModel(ARM)
LOWER, UPPER = MODEL.lower, MODEL.upper
ONE = np.array([0.1, -1.0, 1.2, 1.2, 0.3, -1.2])


def change(distance=10.0, detour=10.0, upper=UPPER):
    model = ArmModel(ARM)
    model.upper = upper

    def meets(q, target):
        metres, radians = pose_distance(MODEL.pose(q), target)
        return metres < 1e-3 and radians < 1e-2

    return BranchChange(model, PoseTask(), meets, distance, detour, 0.005)


def blocked():
    """Limits, a configuration at the upper one of joint 5, and a target that is met by going back from there."""
    upper = UPPER.copy()
    upper[4] = ONE[4] + 0.4
    return upper, ONE + np.array([0, 0, 0, 0, 0.4, 0]), MODEL.pose(ONE)


def test_away_from_limits_nothing_is_looked_for():
    assert change().look(ONE, ONE, MODEL.pose(ONE + 0.05)) is None


def test_behind_a_limit_what_is_found_meets_the_target_within_the_limits():
    upper, closest, target = blocked()
    branch = change(upper=upper)
    found = branch.look(closest, closest, target)
    assert found is not None
    assert branch.goal is found
    assert ((found >= LOWER) & (found <= upper)).all()
    np.testing.assert_allclose(MODEL.pose(found)[:3], target[:3], atol=1e-3)


@pytest.mark.parametrize(("distance", "detour"), [(0.0, 10.0), (0.2, 10.0), (10.0, -1.0)])
def test_nothing_is_found_that_is_too_far_or_leads_too_far_away(distance, detour):
    upper, closest, target = blocked()
    branch = change(distance, detour, upper=upper)
    assert [branch.look(closest, closest, target) for _ in range(8)] == [None] * 8
    assert branch.goal is None


def test_a_change_follows_the_target_and_ends_where_it_cannot():
    branch = change()
    branch.goal = ONE
    moved = MODEL.pose(ONE + 0.05)
    np.testing.assert_allclose(MODEL.pose(branch.follow(moved))[:3], moved[:3], atol=1e-3)
    away = moved.copy()
    away[:3] += 3.0
    assert branch.follow(away) is None
    assert branch.goal is None


def test_a_cancelled_change_is_over():
    branch = change()
    branch.goal = ONE
    branch.cancel()
    assert branch.follow(MODEL.pose(ONE)) is None
