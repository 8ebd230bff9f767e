"""Orientation: found from the kinematics what an arm serves, positions first where it cannot serve all."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import ArmModel, arm_model
from lerobot_mimicik.guidance.orientation import free_axis, service
from lerobot_mimicik.guidance.settings import GuidanceSettings, PoseTask
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from robot_adapters.adapter import IKStatus, MimicIKAdapter

FIVE = arm_model(describe_arm("so101"))


def motion(model: ArmModel, seed: int, frames: int = 200, amplitude: float = 0.5) -> np.ndarray:
    """Joints (T, dof) of a smooth motion about home, clear of the arm itself."""
    rng = np.random.default_rng(seed)
    home, t = model.comfortable(), np.arange(frames)[:, None]
    phase, speed = rng.uniform(0, 2 * np.pi, model.dof), rng.uniform(0.02, 0.06, model.dof)
    joints = home + 0.5 * amplitude * (np.sin(speed * t + phase) - np.sin(phase))
    assert min(model.gap(q)[0] for q in joints) > 0.01
    return joints


def turned(poses: np.ndarray, seed: int, size: float) -> np.ndarray:
    """The poses (T, 7) with any orientation: slowly turned by up to `size` rad about each axis."""
    rng = np.random.default_rng(seed)
    t = np.arange(len(poses))[:, None]
    turn = Rotation.from_rotvec(size * np.sin(0.03 * rng.uniform(0.5, 1.5, 3) * t))
    return np.column_stack([poses[:, :3], (turn * Rotation.from_quat(poses[:, 3:])).as_quat(canonical=True)])


def driven(solver: Guidance, targets: np.ndarray, q: np.ndarray, ahead: int = 0) -> list:
    solver.reset(q)
    found = []
    for t, target in enumerate(targets):
        found.append(solver.solve(q, target, targets[t + 1 : t + 1 + ahead] if ahead else None))
        q = found[-1].q
    return found


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_arms_with_five_joints_miss_one_direction_and_all_others_none(name):
    model = arm_model(describe_arm(name))
    found = service(model, GuidanceSettings())
    assert found.missing == (1 if model.dof == 5 else 0)
    assert found.position_first == (model.dof == 5)


@pytest.mark.parametrize("ahead", [0, 7])
@pytest.mark.parametrize("size", [0.0, 0.5, 1.0])
def test_positions_are_exact_whatever_orientation_is_asked(size, ahead):
    for seed in range(3 if not ahead else 1):
        joints = motion(FIVE, seed, amplitude=0.7)
        targets = turned(np.array([FIVE.pose(q) for q in joints]), seed, size)
        found = driven(Guidance(FIVE), targets, joints[0], ahead)
        assert max(each.certificate.position_error for each in found) < 1e-4
        assert all(each.certificate.reached for each in found)
        if size == 0.0:  # served: the orientation is met as well
            assert max(each.certificate.rotation_error for each in found[20:]) < 0.03


def test_what_is_left_of_an_orientation_is_the_turn_that_the_arm_cannot_make():
    start = FIVE.comfortable()
    target = turned(np.tile(FIVE.pose(start), (40, 1)), 0, 0.6)[-1]
    solver, q = Guidance(FIVE), start
    for _ in range(60):
        found = solver.solve(q, target)
        q = found.q
    error = Rotation.from_quat(FIVE.pose(q)[3:]).inv() * Rotation.from_quat(target[3:])
    axis = np.array(found.certificate.free_axis)
    np.testing.assert_allclose(axis, free_axis(FIVE, q), atol=1e-9)
    left = error.as_rotvec()
    assert np.linalg.norm(left - axis * (axis @ left)) < 0.02
    assert np.linalg.norm(left) > 0.1


def test_the_turn_that_is_missing_moves_no_joint_and_no_tool():
    """Along the free axis no motion of the joints turns the tool while its place is kept."""
    from lerobot_mimicik.guidance.kinematics_kernels import pose_and_jacobian

    q = FIVE.comfortable() + 0.2
    rotation, _, jacobian = pose_and_jacobian(q, FIVE.chain)
    _, _, rows = np.linalg.svd(jacobian[:3])
    turns = rotation.T @ jacobian[3:] @ rows[3:].T
    np.testing.assert_allclose(free_axis(FIVE, q) @ turns, 0.0, atol=1e-9)


def test_an_axis_points_right_while_the_tool_turns_about_it():
    model = arm_model(describe_arm("airbot_play"))
    start = model.comfortable()
    target = model.pose(start)
    twisted = (Rotation.from_quat(target[3:]) * Rotation.from_rotvec([2.0, 0.0, 0.0])).as_quat()
    target = np.concatenate([target[:3] + np.array([0.02, 0.0, 0.01]), twisted])
    solver, q = Guidance(model, GuidanceSettings(orientation="axis", tool_axis="x")), start
    for _ in range(10):
        found = solver.solve(q, target)
        q = found.q
    assert found.certificate.reached
    ahead = Rotation.from_quat(model.pose(q)[3:]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(ahead, Rotation.from_quat(target[3:]).apply([1.0, 0.0, 0.0]), atol=5e-3)
    assert found.certificate.rotation_error > 1.5  # the turn about it is free


def test_a_turn_about_the_axis_that_is_free_costs_nothing():
    task = PoseTask(axis=(0.0, 3.0, 0.0))
    assert task.axis == (0.0, 1.0, 0.0)
    solver = Guidance(arm_model(describe_arm("ur5e")), GuidanceSettings(task=task, clearance=0.0))
    q = solver.model.comfortable()
    target = solver.model.pose(q)
    target[3:] = (Rotation.from_quat(target[3:]) * Rotation.from_rotvec([0.0, -2.5, 0.0])).as_quat()
    np.testing.assert_allclose(solver.solve(q, target).q, q, atol=1e-6)


def test_a_position_alone_leaves_the_arm_at_its_posture():
    start = FIVE.comfortable() + np.array([0.0, 0.2, -0.3, 0.4, 1.0])
    target = FIVE.pose(start)
    solver, q = Guidance(FIVE, GuidanceSettings(orientation="position", posture=1e-3)), start
    for _ in range(80):
        q = solver.solve(q, target).q
    assert np.linalg.norm(FIVE.pose(q)[:3] - target[:3]) < 1e-3
    assert abs(q[4]) < 0.2, "the roll goes home"


def test_a_seventh_joint_goes_to_the_posture_that_is_asked_for():
    model = arm_model(describe_arm("panda"))
    start = model.comfortable()
    target = model.pose(start)

    def elbow(**settings) -> float:
        solver, q = Guidance(model, GuidanceSettings(posture=1e-3, **settings)), start
        for _ in range(60):
            q = solver.solve(q, target).q
        assert np.linalg.norm(model.pose(q)[:3] - target[:3]) < 1e-3
        return q[2]

    wanted = start.copy()
    wanted[2] += 0.5
    assert elbow(posture_joints=tuple(wanted)) > elbow() + 0.1


def test_the_adapter_says_what_it_cannot_turn():
    adapter = MimicIKAdapter.for_arm("so101")
    q = np.array(adapter.description.home)
    target = adapter.forward(q)
    target[3:] = (Rotation.from_quat(target[3:]) * Rotation.from_rotvec([0.4, 0.0, 0.0])).as_quat()
    for _ in range(10):
        result = adapter.solve(q, target)
        q = result.q
    assert result.status is IKStatus.REACHED
    assert result.position_error < 1e-4
    assert re.search(r"cannot turn its tool about the tool's axis \(1\.00 ", result.message)
    # Asked for with its weight, the orientation costs the position, as on other arms.
    full = MimicIKAdapter.for_arm("so101", orientation="full")
    q = np.array(full.description.home)
    for _ in range(10):
        result = full.solve(q, target)
        q = result.q
    assert result.position_error > 1e-3


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (
            {"orientation": "rangd"},
            "expected auto or full or ranged or axis or position. Did you mean ranged?",
        ),
        ({"tool_axis": "w"}, "tool_axis='w': expected x, y, z, -x, -y, -z, or three numbers"),
        ({"tool_axis": (1.0, 0.0)}, "tool_axis: expected 3 numbers, found 2"),
        ({"tool_axis": (0, 0, 0)}, "three zeros are no direction"),
        ({"posture_joints": "ab"}, "posture_joints='ab': expected finite numbers"),
    ],
)
def test_settings_that_mean_nothing_are_named(settings, reason):
    with pytest.raises(ValueError, match=re.escape(reason)):
        GuidanceSettings.of(settings)


def test_a_posture_of_another_arm_is_refused():
    with pytest.raises(ValueError, match=r"posture_joints: expected 5 joints .shoulder_pan"):
        Guidance(FIVE, GuidanceSettings(posture_joints=(0.0,) * 6))
