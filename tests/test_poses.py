"""Pose formats, references and frames are inverse to each other, over batches and at the edges."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lerobot_mimicik.guidance.approach import towards
from lerobot_mimicik.kinematics.poses import (
    IDENTITY,
    PolicyFrames,
    PoseFormat,
    PoseReference,
    compose,
    decode_pose,
    encode_pose,
    inverse,
    pose_distance,
)


def random_poses(seed: int, *batch: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = int(np.prod(batch))
    quaternion = Rotation.random(count, rng=rng).as_quat(canonical=True)
    return np.concatenate([rng.uniform(-1, 1, (count, 3)), quaternion], axis=1).reshape(*batch, 7)


@pytest.mark.parametrize("form", PoseFormat)
@given(seed=st.integers(0, 1000), rows=st.integers(1, 4))
def test_every_format_round_trips(form, seed, rows):
    poses = random_poses(seed, rows, 2)
    numbers = encode_pose(poses, form)
    assert numbers.shape == (rows, 2, form.width)
    np.testing.assert_allclose(decode_pose(numbers, form), poses, atol=1e-9)


def test_networks_need_not_be_exact():
    pose = random_poses(1, 1)[0]
    doubled = np.concatenate([pose[:3], 2 * pose[3:]])
    np.testing.assert_allclose(decode_pose(doubled, PoseFormat.QUATERNION), pose, atol=1e-12)
    sheared = encode_pose(pose, PoseFormat.ROTATION_6D)
    sheared[3:] *= 1.3
    np.testing.assert_allclose(decode_pose(sheared, PoseFormat.ROTATION_6D), pose, atol=1e-9)


@pytest.mark.parametrize(
    ("form", "numbers"),
    [
        (PoseFormat.QUATERNION, [0, 0, 0, 0, 0, 0, 0]),
        (PoseFormat.ROTATION_6D, [0, 0, 0, 1, 0, 0, 2, 0, 0]),
        (PoseFormat.ROTATION_6D_ROWS, [0, 0, 0, 0, 0, 0, 0, 1, 0]),
        (PoseFormat.ROTATION_VECTOR, [0, 0, 0, 1]),
    ],
)
def test_what_is_no_rotation_is_refused(form, numbers):
    with pytest.raises(ValueError, match=r"no rotation|expected poses of"):
        decode_pose(numbers, form)


def test_compose_and_inverse():
    a, b = random_poses(2, 5), random_poses(3, 5)
    np.testing.assert_allclose(compose(compose(a, b), inverse(b)), a, atol=1e-12)
    np.testing.assert_allclose(compose(a, inverse(a)), np.tile(IDENTITY, (5, 1)), atol=1e-12)


@pytest.mark.parametrize("reference", PoseReference)
def test_a_policy_that_stays_where_it_is_commands_the_present_pose(reference):
    frames = PolicyFrames(
        form=PoseFormat.ROTATION_VECTOR,
        reference=reference,
        tool=random_poses(4, 1)[0],
        base=random_poses(5, 1)[0],
    )
    pose = random_poses(6, 1)[0]
    stay = frames.to_policy(pose) if reference is PoseReference.ABSOLUTE else np.zeros(6)
    np.testing.assert_allclose(frames.from_policy(stay, pose), pose, atol=1e-9)


def test_relative_targets_follow_their_frames():
    pose, step = random_poses(7, 1)[0], np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.2])
    in_tool = PolicyFrames(PoseFormat.ROTATION_VECTOR, PoseReference.TOOL).from_policy(step, pose)
    in_base = PolicyFrames(PoseFormat.ROTATION_VECTOR, PoseReference.BASE).from_policy(step, pose)
    rotation, turn = Rotation.from_quat(pose[3:]), Rotation.from_rotvec(step[3:])
    np.testing.assert_allclose(in_tool[:3] - pose[:3], rotation.apply(step[:3]), atol=1e-12)
    np.testing.assert_allclose(in_base[:3] - pose[:3], step[:3], atol=1e-12)
    assert (Rotation.from_quat(in_tool[3:]).inv() * (rotation * turn)).magnitude() < 1e-9
    assert (Rotation.from_quat(in_base[3:]).inv() * (turn * rotation)).magnitude() < 1e-9


@given(seed=st.integers(0, 500))
def test_a_waypoint_lies_on_the_way_and_within_the_bounds(seed):
    start, target = random_poses(seed, 2)
    upper = np.array([0.05, 0.02, 0.03, 0.1, 0.2, 0.05])
    waypoint, share = towards(start, target, -upper, upper)
    np.testing.assert_allclose(waypoint[:3], start[:3] + share * (target[:3] - start[:3]), atol=1e-12)
    turn = Rotation.from_quat(waypoint[3:]) * Rotation.from_quat(start[3:]).inv()
    step = np.concatenate([waypoint[:3] - start[:3], turn.as_rotvec()])
    assert (np.abs(step) <= upper + 1e-9).all()
    assert pose_distance(waypoint, target)[1] <= pose_distance(start, target)[1] + 1e-9


def test_a_near_target_is_its_own_waypoint():
    start = random_poses(8, 1)[0]
    target = compose(start, [0.001, 0, 0, 0, 0, 0, 1])
    waypoint, share = towards(start, target, np.full(6, -0.1), np.full(6, 0.1))
    assert share == 1.0
    np.testing.assert_array_equal(waypoint, target)
