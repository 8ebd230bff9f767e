"""The closest configuration: a reachable pose is met, no limit is passed, what cannot be met is missed by the least."""

import numpy as np
import pytest

from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.search import closest_configuration
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import pose_distance

ARM = describe_arm("airbot_play")
MODEL, HOME = ArmModel(ARM), np.array(ARM.home)
LOWER, UPPER = MODEL.lower, MODEL.upper


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_nearby_is_met_within_the_limits(seed):
    random = np.random.default_rng(seed)
    start = np.clip(HOME + random.uniform(-0.3, 0.3, 6), LOWER, UPPER)
    target = MODEL.pose(np.clip(start + random.uniform(-0.3, 0.3, 6), LOWER, UPPER))
    found = closest_configuration(MODEL, start, target)
    assert ((found >= LOWER) & (found <= UPPER)).all()
    metres, radians = pose_distance(MODEL.pose(found), target)
    assert metres < 1e-4
    assert radians < 1e-3


def test_a_target_that_is_met_already_is_answered_by_where_one_stands():
    assert closest_configuration(MODEL, HOME, MODEL.pose(HOME)) == pytest.approx(HOME, abs=1e-9)


def test_out_of_reach_the_arm_stretches_towards_the_target_and_no_limit_is_passed():
    target = MODEL.pose(HOME)
    target[:3] *= 5.0 / np.linalg.norm(target[:3])
    before = pose_distance(MODEL.pose(HOME), target)[0]
    found = closest_configuration(MODEL, HOME, target, iterations=60)
    assert ((found >= LOWER) & (found <= UPPER)).all()
    assert pose_distance(MODEL.pose(found), target)[0] < before


def test_beginning_outside_the_limits_ends_within_them():
    found = closest_configuration(MODEL, UPPER + 0.2, MODEL.pose(UPPER))
    assert ((found >= LOWER) & (found <= UPPER)).all()


def test_a_joint_at_its_limit_stays_there_while_the_others_go_on():
    narrow = ArmModel(ARM)
    narrow.upper = UPPER.copy()
    narrow.upper[0] = HOME[0]
    goal = HOME + np.array([0.2, 0.1, -0.1, 0.0, 0.1, 0.0])
    free = closest_configuration(MODEL, HOME, MODEL.pose(goal))
    held = closest_configuration(narrow, HOME, MODEL.pose(goal), iterations=60)
    assert held[0] <= narrow.upper[0]
    missed, start = (pose_distance(MODEL.pose(q), MODEL.pose(goal))[0] for q in (held, HOME))
    assert pose_distance(MODEL.pose(free), MODEL.pose(goal))[0] < 1e-4 < missed < start
