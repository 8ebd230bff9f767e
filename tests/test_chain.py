"""Serial arms: forward kinematics against MuJoCo and a real arm, Jacobians against differences, errors."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ElementTree
from importlib import resources

import mujoco
import numpy as np
import pytest
import torch

from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import pose_error, relative_pose, rpy_to_matrix

SCARA = """<robot name="scara">
  <link name="floor"/><link name="base"/><link name="arm"/>
  <link name="plate"/><link name="quill"/><link name="tip"/>
  <joint name="stand" type="fixed"><parent link="floor"/><child link="base"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.2 -0.4 0.9"/></joint>
  <joint name="tool" type="continuous"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.5" rpy="0 0.1 0"/><axis xyz="0.3 -0.5 0.8"/></joint>
  <joint name="spacer" type="fixed"><parent link="arm"/><child link="plate"/>
    <origin xyz="0.4 0 0" rpy="0 0 0.7"/></joint>
  <joint name="lift" type="prismatic"><parent link="plate"/><child link="quill"/>
    <origin xyz="0.1 0 0" rpy="1 0 0"/><axis xyz="0 1 1"/>
    <limit lower="-0.2" upper="0.1" velocity="0.5"/></joint>
  <joint name="spin" type="revolute"><parent link="quill"/><child link="tip"/>
    <axis xyz="-1 0 0"/><limit lower="-2" upper="2" velocity="5"/></joint>
</robot>"""


def seven_dof_arm() -> ArmDescription:
    """The left arm of Dexmate's Vega torso, from the package dexmate-urdf."""
    folder = resources.files("dexmate_urdf") / "robots" / "humanoid" / "vega_1u"
    urdf = (folder / "vega_1u.urdf").read_text()
    return describe_arm(urdf, base_link="arm_center", tip_link="L_ee")


ARMS = {
    "airbot_play": lambda: describe_arm("airbot_play", tool_offset=(0.1594, 0, 0)),
    "piper": lambda: describe_arm("piper", tool_offset=(0.01, -0.02, 0.13, 0.3, -0.2, 0.1)),
    "seven joints": seven_dof_arm,
    "prismatic, fixed and oblique joints": lambda: describe_arm(SCARA, tool_offset=(0, 0.05, 0.1)),
}


@pytest.fixture(params=ARMS)
def description(request) -> ArmDescription:
    return ARMS[request.param]()


def random_joints(description: ArmDescription, count: int, seed: int = 0) -> np.ndarray:
    """Joint vectors (count, dof) over the whole range; a turn either way for continuous joints."""
    limits = np.array([(joint.lower, joint.upper) for joint in description.joints()])
    limits = np.clip(limits, -2 * math.pi, 2 * math.pi)
    return np.random.default_rng(seed).uniform(*limits.T, (count, len(limits)))


def mujoco_poses(description: ArmDescription, joints: np.ndarray) -> np.ndarray:
    """Poses (n, 7) of the tool in the base link, by MuJoCo from the same URDF text, its shapes left out."""
    robot = ElementTree.fromstring(description.urdf)
    for link in robot.iter("link"):
        for child in [child for child in link if child.tag in ("visual", "collision")]:
            link.remove(child)
    extension = ElementTree.SubElement(robot, "mujoco")
    bounds = {"boundmass": "0.01", "boundinertia": "0.001", "balanceinertia": "true"}
    ElementTree.SubElement(extension, "compiler", {"fusestatic": "false", **bounds})
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))
    data = mujoco.MjData(model)
    addresses = [model.joint(name).qposadr[0] for name in description.joint_names]
    tool = np.eye(4)
    offset = (*description.tool_offset, *[0.0] * (6 - len(description.tool_offset)))
    tool[:3, 3] = offset[:3]
    tool[:3, :3] = rpy_to_matrix(torch.tensor(offset[3:], dtype=torch.float64)).numpy()

    def pose_of(link: str) -> np.ndarray:
        pose = np.eye(4)
        # MuJoCo names the root link's body itself only when the link moves; else it is the world.
        body = model.body(link).id if link in [model.body(i).name for i in range(model.nbody)] else 0
        pose[:3, 3], pose[:3, :3] = data.xpos[body], data.xmat[body].reshape(3, 3)
        return pose

    poses = []
    for q in joints:
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        pose = np.linalg.inv(pose_of(description.base_link)) @ pose_of(description.tip_link) @ tool
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
        poses.append((*pose[:3, 3], *np.roll(quaternion, -1)))
    return np.array(poses)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_forward_kinematics_agrees_with_mujoco(description, dtype):
    arm = SerialArm(description, dtype=dtype)
    joints = random_joints(description, 200)
    poses = arm.forward(torch.from_numpy(joints))
    assert poses.dtype == dtype
    reference = torch.from_numpy(mujoco_poses(description, joints))
    position, angle = pose_error(poses.double(), reference)
    assert position.max() < 1e-5
    assert angle.max() < 1e-5


def test_forward_kinematics_agrees_with_a_real_airbot_play(shared_data):
    import pandas as pd

    log = pd.read_parquet(shared_data("airbot_play_real/rollout.parquet")).astype(float)
    arm = SerialArm(describe_arm("airbot_play", tool_offset=(0.1594, 0, 0)), dtype=torch.float64)
    joints = torch.from_numpy(log[[f"q{i}" for i in range(1, 7)]].to_numpy())
    poses = torch.from_numpy(log[["x", "y", "z", "qx", "qy", "qz", "qw"]].to_numpy())
    position, angle = pose_error(arm.forward(joints), poses)
    # Joints and pose are logged a few ms apart, which shows while the arm moves: hence the median.
    assert position.median() < 1.0e-3
    assert angle.median() < 1.5e-3
    assert position.max() < 4e-3


def test_forward_kinematics_agrees_with_the_piper_makers_own():
    # Computed by the manufacturer's piper_sdk 0.6.2 (2-degree offset form): mm and degrees, fixed-axis x y z.
    joints = torch.tensor([[0, 1.3, -1.2, 0, 0.8, 0], [0.3, 1.1, -1.0, 0.5, 0.6, -0.4]], dtype=torch.float64)
    xyz = torch.tensor([[275.20848, 0, 358.14020], [214.18924, 92.04224, 364.92470]], dtype=torch.float64)
    rpy = torch.tensor([[180.0, 43.433798, 180.0], [162.214798, 57.900907, -165.260153]], dtype=torch.float64)
    matrix = SerialArm(describe_arm("piper"), dtype=torch.float64).matrix(joints)
    torch.testing.assert_close(matrix[:, :3, 3], xyz / 1000, atol=1e-7, rtol=0)
    torch.testing.assert_close(matrix[:, :3, :3], rpy_to_matrix(torch.deg2rad(rpy)), atol=1e-7, rtol=0)


def test_the_jacobian_is_the_derivative_of_the_pose(description):
    arm = SerialArm(description, dtype=torch.float64)
    joints = torch.from_numpy(random_joints(description, 20))
    step = 1e-5
    for index in range(arm.dof):
        change = torch.zeros(arm.dof, dtype=torch.float64)
        change[index] = step
        difference = relative_pose(arm.forward(joints - change), arm.forward(joints + change)) / (2 * step)
        torch.testing.assert_close(arm.jacobian(joints)[..., index], difference, atol=1e-7, rtol=0)


def test_gradients_are_those_of_the_jacobian(description):
    arm = SerialArm(description, dtype=torch.float64)
    joints = torch.from_numpy(random_joints(description, 2)).requires_grad_()
    position_jacobian = arm.jacobian(joints.detach())[:, :3]
    for axis in range(3):
        (gradient,) = torch.autograd.grad(arm.forward(joints)[:, axis].sum(), joints)
        torch.testing.assert_close(gradient, position_jacobian[:, axis])
    assert torch.autograd.gradcheck(arm.forward, (joints,), atol=1e-6)
    assert torch.autograd.gradcheck(arm.matrix, (joints,), atol=1e-6)


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (0,), (4, 0, 2), (9000,)])
def test_any_leading_axes_give_the_poses_of_the_single_configurations(shape):
    arm = SerialArm(describe_arm("airbot_play"))
    joints = torch.rand(*shape, 6, generator=torch.Generator().manual_seed(0))
    poses, matrices, jacobians = arm.forward(joints), arm.matrix(joints), arm.jacobian(joints)
    assert (poses.shape, matrices.shape, jacobians.shape) == ((*shape, 7), (*shape, 4, 4), (*shape, 6, 6))
    if joints.numel():
        last = joints.reshape(-1, 6)[-1]
        torch.testing.assert_close(poses.reshape(-1, 7)[-1], arm.forward(last), atol=1e-6, rtol=0)
        torch.testing.assert_close(jacobians.reshape(-1, 6, 6)[-1], arm.jacobian(last), atol=1e-6, rtol=0)
        assert (poses[..., 6] >= 0).all()
        torch.testing.assert_close(poses[..., 3:].norm(dim=-1), torch.ones(shape), atol=1e-6, rtol=0)


def test_another_joint_order_only_permutes(description):
    order = np.random.default_rng(1).permutation(len(description.joint_names))
    names = tuple(description.joint_names[i] for i in order)
    shuffled = ArmDescription(
        description.urdf, description.base_link, description.tip_link, names, description.tool_offset
    )
    arm, other = SerialArm(description, dtype=torch.float64), SerialArm(shuffled, dtype=torch.float64)
    joints = torch.from_numpy(random_joints(description, 10))
    assert other.joint_names == names
    torch.testing.assert_close(other.forward(joints[:, order]), arm.forward(joints))
    torch.testing.assert_close(other.jacobian(joints[:, order]), arm.jacobian(joints)[..., order])
    assert torch.equal(other.lower, arm.lower[order])
    assert torch.equal(other.velocity, arm.velocity[order])


def test_a_tool_offset_moves_the_tool_in_the_tip_frame():
    joints = torch.from_numpy(random_joints(describe_arm("piper"), 10))
    flange = SerialArm(describe_arm("piper"), dtype=torch.float64).matrix(joints)
    offset = (0.1, -0.2, 0.3, 0.4, -0.5, 0.6)
    point = SerialArm(describe_arm("piper", tool_offset=offset[:3]), dtype=torch.float64).matrix(joints)
    frame = SerialArm(describe_arm("piper", tool_offset=offset), dtype=torch.float64).matrix(joints)
    translation = torch.tensor(offset[:3], dtype=torch.float64)
    torch.testing.assert_close(point[:, :3, 3], flange[:, :3, 3] + flange[:, :3, :3] @ translation)
    torch.testing.assert_close(point[:, :3, :3], flange[:, :3, :3])
    torch.testing.assert_close(frame[:, :3, 3], point[:, :3, 3])
    rotation = rpy_to_matrix(torch.tensor(offset[3:], dtype=torch.float64))
    torch.testing.assert_close(frame[:, :3, :3], flange[:, :3, :3] @ rotation)


def test_limits_are_the_urdfs_and_infinite_where_it_has_none():
    arm = SerialArm(describe_arm(SCARA), dtype=torch.float64)
    assert arm.joint_names == ("tool", "lift", "spin")
    assert arm.lower.tolist() == [-math.inf, -0.2, -2.0]
    assert arm.upper.tolist() == [math.inf, 0.1, 2.0]
    assert arm.velocity.tolist() == [math.inf, 0.5, 5.0]


def test_to_returns_an_arm_and_leaves_the_first_alone():
    arm = SerialArm(describe_arm("airbot_play"))
    assert arm.to() is arm
    assert arm.to("cpu", torch.float32) is arm
    precise = arm.to(dtype=torch.float64)
    assert (arm.dtype, precise.dtype) == (torch.float32, torch.float64)
    assert precise.lower.dtype == torch.float64
    joints = torch.ones(6, dtype=torch.float64)
    built = SerialArm(describe_arm("airbot_play"), dtype=torch.float64)
    assert torch.equal(precise.forward(joints), built.forward(joints))


def test_a_deep_copy_is_an_arm_of_its_own():
    arm = SerialArm(describe_arm("airbot_play"))
    joints = torch.rand(3, 6)
    assert torch.equal(copy.deepcopy(arm).forward(joints), arm.forward(joints))


def test_autocast_does_not_round_poses():
    arm = SerialArm(describe_arm("airbot_play"))
    joints = torch.rand(8, 6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = arm.forward(joints)
    assert torch.equal(mixed, arm.forward(joints))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_poses_on_a_gpu_are_those_of_the_processor_even_with_tf32(monkeypatch):
    monkeypatch.setattr(torch.backends.cuda.matmul, "allow_tf32", True)
    arm = SerialArm(describe_arm("airbot_play"))
    joints = torch.rand(512, 6)
    on_gpu = arm.to("cuda").forward(joints.cuda())
    assert on_gpu.dtype == torch.float32
    torch.testing.assert_close(on_gpu.cpu(), arm.forward(joints), atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", ["forward", "matrix", "jacobian"])
@pytest.mark.parametrize("shape", [(7,), (3, 5), (), (6, 0)])
def test_a_wrong_number_of_joints_is_refused(method, shape):
    arm = SerialArm(describe_arm("airbot_play"))
    with pytest.raises(ValueError, match=r"expected joints of shape \(\*, 6\) for joint1.*found"):
        getattr(arm, method)(torch.zeros(shape))


def test_joints_on_another_device_are_refused():
    arm = SerialArm(describe_arm("airbot_play"))
    with pytest.raises(ValueError, match="joints are on meta, the arm is on cpu"):
        arm.forward(torch.zeros(6, device="meta"))


def test_half_precision_arms_are_refused():
    with pytest.raises(ValueError, match=r"torch\.float16"):
        SerialArm(describe_arm("airbot_play"), dtype=torch.float16)


@pytest.mark.parametrize("name", ["airbot_play", "piper"])
def test_home_is_far_from_singular(name):
    description = describe_arm(name)
    arm = SerialArm(description, dtype=torch.float64)
    singular_values = torch.linalg.svdvals(arm.jacobian(torch.tensor(description.home, dtype=torch.float64)))
    assert singular_values.min() > 0.05
