"""The arm of synthetic motion agrees with SerialArm and knows where it must not go."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_mimicik.data.arm_arrays import LIMIT_MARGIN_RAD, ArmArrays, cross
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_poses_matrices_and_jacobians_are_those_of_the_serial_arm(name):
    arm = ArmArrays(describe_arm(name))
    serial = SerialArm(arm.description, dtype=torch.float64)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, size=(20, serial.dof))
    joints = torch.from_numpy(q)
    np.testing.assert_allclose(arm.pose(q), serial.forward(joints).numpy(), atol=1e-9)
    matrix, jacobian = arm.tool_and_jacobian(q)
    np.testing.assert_allclose(matrix, serial.matrix(joints).numpy(), atol=1e-9)
    np.testing.assert_allclose(arm.matrix(q), matrix, atol=1e-12)
    np.testing.assert_allclose(jacobian, serial.jacobian(joints).numpy(), atol=1e-9)
    np.testing.assert_allclose(arm.lower - LIMIT_MARGIN_RAD, serial.lower.numpy(), atol=1e-12)
    np.testing.assert_allclose(arm.upper + LIMIT_MARGIN_RAD, serial.upper.numpy(), atol=1e-12)


def test_home_is_free_and_reaching_below_the_floor_is_not():
    arm = ArmArrays(describe_arm("airbot_play"))
    assert arm.free(arm.home[None]).all()
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, size=(300, 6))
    below = q[arm.matrix(q)[:, 2, 3] < -0.02]
    assert len(below) > 20
    assert not arm.free(below).any()


def test_base_to_tip_undoes_a_permutation_of_the_joints():
    names = [f"joint{i}" for i in (3, 1, 2, 6, 4, 5)]
    arm = ArmArrays(describe_arm("airbot_play", joint_names=names))
    assert [names[i] for i in arm.base_to_tip] == [f"joint{i}" for i in range(1, 7)]


def test_an_arm_without_home_is_refused_by_name():
    with pytest.raises(ValueError, match=r"home.*6 joint angles.*joint1"):
        ArmArrays(replace(describe_arm("airbot_play"), home=()))


def test_the_cross_product_is_numpys():
    a, b = np.random.default_rng(0).normal(size=(2, 5, 4, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b))
