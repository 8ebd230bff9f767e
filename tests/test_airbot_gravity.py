"""Gravity torques agree with a physics engine's, for any pose, order of joints and direction of gravity."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from robot_adapters.can.gravity import GravityModel

mujoco = pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", ["airbot_play", "piper"])
@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (3.0, -4.0, 8.0)])
def test_torques_agree_with_mujoco(name, gravity):
    description = describe_arm(name)
    model = mujoco.MjModel.from_xml_string(description.urdf)
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    ours = GravityModel(description, gravity)
    random = np.random.default_rng(0)
    at = [model.joint(joint).qposadr[0] for joint in description.joint_names]
    for _ in range(20):
        q = random.uniform(
            [joint.lower for joint in description.joints()], [j.upper for j in description.joints()]
        )
        data.qpos[:] = 0.0
        data.qpos[at] = q
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(ours.torques(q), data.qfrc_bias[at], atol=1e-9)


def test_the_order_of_joints_is_the_description_s():
    straight = describe_arm("airbot_play")
    order = (3, 0, 5, 1, 2, 4)
    shuffled = describe_arm("airbot_play", joint_names=[straight.joint_names[i] for i in order])
    q = np.array(straight.home)
    np.testing.assert_allclose(
        GravityModel(shuffled).torques(q[list(order)]), GravityModel(straight).torques(q)[list(order)]
    )


def test_a_wrong_number_of_joints_is_named():
    with pytest.raises(ValueError, match="6 joint angles"):
        GravityModel(describe_arm("airbot_play")).torques(np.zeros(5))
