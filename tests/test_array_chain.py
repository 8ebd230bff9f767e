"""ArrayChain agrees with SerialArm, and PointChain with ArrayChain."""

import numpy as np
import pytest
import torch

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from lerobot_mimicik.kinematics.array_chain import ArrayChain
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.point_chain import PointChain

_SLIDER = """<robot name="slider">
<link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="lift" type="prismatic">
<parent link="a"/><child link="b"/><origin xyz="0.1 0 0.2" rpy="0.3 0.1 -0.4"/>
<axis xyz="0 1 0"/><limit lower="-0.5" upper="0.5" effort="1" velocity="1"/></joint>
<joint name="plate" type="fixed">
<parent link="b"/><child link="c"/><origin xyz="0 0 0.1" rpy="0 1.2 0"/></joint>
<joint name="turn" type="continuous">
<parent link="c"/><child link="d"/><origin xyz="0 0.3 0" rpy="0 0 1"/>
<axis xyz="1 1 0"/></joint></robot>"""


def _descriptions():
    yield from (describe_arm(name) for name in SHIPPED_ARMS)
    yield describe_arm("airbot_play", tool_offset=(0.16, 0.01, -0.02, 0.1, 0.2, 0.3))
    yield describe_arm("airbot_play", joint_names=[f"joint{i}" for i in (3, 1, 2, 6, 4, 5)])
    yield describe_arm(_SLIDER, tool_offset=(0.0, 0.0, 0.1))


@pytest.mark.parametrize("description", list(_descriptions()))
def test_forward_and_jacobian_agree_with_serial_arm(description):
    chain, arm = ArrayChain(description), SerialArm(description, dtype=torch.float64)
    q = np.random.default_rng(0).uniform(-2, 2, size=(50, chain.dof))
    rotation, position, jacobian = chain.forward_and_jacobian(q)
    expected = arm.matrix(torch.from_numpy(q)).numpy()
    np.testing.assert_allclose(rotation, expected[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(position, expected[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(jacobian, arm.jacobian(torch.from_numpy(q)).numpy(), atol=1e-12)
    for alone, together in zip(chain.forward(q), (rotation, position), strict=True):
        np.testing.assert_array_equal(alone, together)


@pytest.mark.parametrize("description", list(_descriptions()))
def test_one_configuration_in_floats_agrees_with_arrays(description):
    chain, single = ArrayChain(description), PointChain(description)
    q = np.random.default_rng(2).uniform(-3, 3, size=(200, chain.dof))
    expected = chain.forward_and_jacobian(q)
    for i, row in enumerate(q):
        for own, all_of_them in zip(single.rotation_position_jacobian(row), expected, strict=True):
            np.testing.assert_allclose(own, all_of_them[i], atol=1e-12)
        np.testing.assert_allclose(single.pose(row), chain.pose(row[None])[0], atol=1e-12)
    with pytest.raises(ValueError, match=f"expected {chain.dof} joints"):
        single.pose(q[0, :-1])


def test_body_points_follow_their_links():
    description = describe_arm("airbot_play")
    chain = ArrayChain(description)
    body, (_, offset) = chain.links["end_link"]
    points = [np.empty((0, 3)) for _ in range(chain.dof + 1)]
    points[body] = offset[None]
    q = np.random.default_rng(1).uniform(-1, 1, size=(7, 6))
    moved = chain.body_points(q, points)[body]
    np.testing.assert_allclose(moved[0].T, chain.forward(q)[1], atol=1e-12)


def test_joints_of_another_width_are_refused():
    with pytest.raises(ValueError, match=r"\(N, 6\)"):
        ArrayChain(describe_arm("airbot_play")).forward(np.zeros((3, 5)))


def test_quaternions_of_any_rotation():
    from scipy.spatial.transform import Rotation

    from lerobot_mimicik.kinematics.array_chain import quaternion_from_matrix

    halves = Rotation.from_rotvec(np.pi * np.eye(3))
    rotations = Rotation.concatenate([Rotation.random(200, rng=np.random.default_rng(0)), halves])
    found = quaternion_from_matrix(rotations.as_matrix())
    assert (found[:, 3] >= 0).all()
    np.testing.assert_allclose((Rotation.from_quat(found) * rotations.inv()).magnitude(), 0, atol=1e-7)
