"""Rotations: conversions invert each other, agree with scipy, and have finite gradients at every angle."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics import rotations as rot

F64 = torch.float64
IDENTITY = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=F64)

unit_axes = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda axis: math.hypot(*axis) > 0.1)
    .map(lambda axis: torch.tensor(axis, dtype=F64) / math.hypot(*axis))
)
# Angles [rad] from the identity to the half turn, with the places where formulas fail well represented.
angles = st.one_of(
    st.floats(0, math.pi),
    st.sampled_from([0.0, 1e-30, 1e-10, 1e-7, 1e-4, 0.9e-3, 1.1e-3, 2e-3, math.pi / 2]),
    st.sampled_from([math.pi, math.pi - 1e-7, math.pi - 1e-4]),
)
rotation_vectors = st.builds(lambda axis, angle: axis * angle, unit_axes, angles)
quaternions = rotation_vectors.map(
    lambda vector: torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_quat())
)
positions = st.tuples(*[st.floats(-2, 2)] * 3).map(lambda xyz: torch.tensor(xyz, dtype=F64))
poses = st.builds(lambda position, q: torch.cat((position, rot.half_sphere(q))), positions, quaternions)


def same_rotation(q_a: torch.Tensor, q_b: torch.Tensor, tolerance: float = 1e-9) -> bool:
    return bool(min((q_a - q_b).abs().max(), (q_a + q_b).abs().max()) < tolerance)


def scipy_of(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(q.numpy())


@given(quaternions, quaternions)
def test_the_product_is_scipys(q_a, q_b):
    expected = torch.from_numpy((scipy_of(q_a) * scipy_of(q_b)).as_quat())
    assert same_rotation(rot.quaternion_multiply(q_a, q_b), expected)


@given(quaternions)
def test_a_quaternion_times_its_conjugate_is_the_identity(q):
    torch.testing.assert_close(rot.quaternion_multiply(q, rot.quaternion_conjugate(q)), IDENTITY)


@given(quaternions)
def test_the_half_sphere_keeps_the_rotation_and_has_w_at_least_zero(q):
    for sign in (1, -1):
        half = rot.half_sphere(sign * q)
        assert half[3] >= 0
        assert same_rotation(half, q)


@given(quaternions)
def test_matrices_are_scipys_and_convert_back(q):
    matrix = rot.quaternion_to_matrix(q)
    torch.testing.assert_close(matrix, torch.from_numpy(scipy_of(q).as_matrix()), atol=1e-12, rtol=0)
    back = rot.matrix_to_quaternion(matrix)
    assert back[3] >= 0
    assert same_rotation(back, q)


@given(rotation_vectors)
def test_exponential_and_logarithm_invert_each_other(vector):
    q = rot.rotation_vector_to_quaternion(vector)
    assert same_rotation(q, torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_quat()))
    back = rot.quaternion_to_rotation_vector(q)
    # At the half turn both signs name the same rotation.
    if vector.norm() < math.pi - 1e-9:
        torch.testing.assert_close(back, vector, atol=1e-12, rtol=1e-9)
    else:
        assert same_rotation(back, vector, 1e-7)


@given(rotation_vectors)
def test_float32_loses_no_small_rotation(vector):
    back = rot.quaternion_to_rotation_vector(rot.rotation_vector_to_quaternion(vector.float()))
    assert torch.isfinite(back).all()
    if vector.norm() < math.pi - 1e-3:
        torch.testing.assert_close(back, vector.float(), atol=1e-30, rtol=2e-6)


@given(quaternions, rotation_vectors)
def test_the_angle_between_orientations_is_that_of_the_rotation_between_them(q, vector):
    other = rot.quaternion_multiply(rot.rotation_vector_to_quaternion(vector), q)
    for sign in (1, -1):
        angle = rot.rotation_angle(q, sign * other)
        torch.testing.assert_close(angle, vector.norm(), atol=1e-9, rtol=1e-9)


@given(st.tuples(*[st.floats(-7, 7)] * 3))
def test_roll_pitch_yaw_are_about_the_fixed_axes(rpy):
    expected = torch.from_numpy(Rotation.from_euler("xyz", rpy).as_matrix())
    torch.testing.assert_close(rot.rpy_to_matrix(torch.tensor(rpy, dtype=F64)), expected, atol=1e-12, rtol=0)


@given(poses, poses)
def test_a_relative_pose_leads_from_one_pose_to_the_other(current, target):
    step = rot.relative_pose(current, target)
    position, angle = rot.pose_error(rot.apply_relative_pose(current, step), target)
    assert position < 1e-12
    assert angle < 1e-7
    distance, turn = rot.pose_error(current, target)
    torch.testing.assert_close(step[:3].norm(), distance)
    torch.testing.assert_close(step[3:].norm(), turn, atol=1e-9, rtol=1e-9)


@given(poses)
def test_a_pose_has_no_error_to_itself_and_survives_the_matrix(pose):
    for sign in (1, -1):
        same = torch.cat((pose[:3], sign * pose[3:]))
        assert rot.pose_error(pose, same)[0] == 0
        assert rot.pose_error(pose, same)[1] < 1e-12
    matrix = torch.eye(4, dtype=F64)
    matrix[:3, 3], matrix[:3, :3] = pose[:3], rot.quaternion_to_matrix(pose[3:])
    position, angle = rot.pose_error(rot.matrix_to_pose(matrix), pose)
    assert position == 0
    assert angle < 1e-9


def test_the_step_turns_about_the_base_axes():
    current = torch.tensor([0, 0, 0, *Rotation.from_euler("x", 90, degrees=True).as_quat()], dtype=F64)
    turned = Rotation.from_euler("z", 0.1) * Rotation.from_euler("x", 90, degrees=True)
    target = torch.tensor([1, 2, 3, *turned.as_quat()], dtype=F64)
    expected = torch.tensor([1, 2, 3, 0, 0, 0.1], dtype=F64)
    torch.testing.assert_close(rot.relative_pose(current, target), expected)


def gradient_is_finite(function, *inputs: torch.Tensor) -> bool:
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    out = function(*inputs)
    outputs = out if isinstance(out, tuple) else (out,)
    for output in outputs:
        for component in output.reshape(-1):
            gradients = torch.autograd.grad(component, inputs, retain_graph=True, allow_unused=True)
            if not all(torch.isfinite(g).all() for g in gradients if g is not None):
                return False
    return True


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=40)
@given(current=poses, vector=rotation_vectors)
def test_gradients_are_finite_at_every_angle(dtype, current, vector):
    current, vector = current.to(dtype), vector.to(dtype)
    step = torch.cat((torch.zeros(3, dtype=dtype), vector))
    target = rot.apply_relative_pose(current, step)
    assert gradient_is_finite(rot.rotation_vector_to_quaternion, vector)
    assert gradient_is_finite(rot.quaternion_to_rotation_vector, target[3:])
    assert gradient_is_finite(rot.matrix_to_quaternion, rot.quaternion_to_matrix(target[3:]))
    assert gradient_is_finite(rot.relative_pose, current, target)
    assert gradient_is_finite(rot.pose_error, current, target)


@given(rotation_vectors)
def test_gradients_are_right_away_from_the_half_turn(vector):
    if vector.norm() > math.pi - 1e-2:
        return
    vector = vector.clone().requires_grad_()

    def there_and_back(v: torch.Tensor) -> torch.Tensor:
        q = rot.rotation_vector_to_quaternion(v)
        return rot.quaternion_to_rotation_vector(rot.matrix_to_quaternion(rot.quaternion_to_matrix(q)))

    jacobian = torch.autograd.functional.jacobian(there_and_back, vector)
    torch.testing.assert_close(jacobian, torch.eye(3, dtype=F64), atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)])
def test_batch_axes_are_kept_and_broadcast(shape):
    generator = torch.Generator().manual_seed(0)
    q = torch.nn.functional.normalize(torch.randn(*shape, 4, generator=generator, dtype=F64), dim=-1)
    pose = torch.cat((torch.randn(*shape, 3, generator=generator, dtype=F64), q), dim=-1)
    one = torch.tensor([0.1, 0.2, 0.3, 0.5, -0.5, 0.5, 0.5], dtype=F64)
    assert rot.quaternion_multiply(q, one[3:]).shape == (*shape, 4)
    assert rot.matrix_to_quaternion(rot.quaternion_to_matrix(q)).shape == (*shape, 4)
    assert rot.rotation_angle(one[3:], q).shape == shape
    assert rot.relative_pose(pose, one).shape == (*shape, 6)
    assert rot.relative_pose(one, pose).shape == (*shape, 6)
    assert rot.apply_relative_pose(one, rot.relative_pose(one, pose)).shape == (*shape, 7)
    assert [error.shape for error in rot.pose_error(one, pose)] == [shape, shape]
    if pose.numel():
        alone = rot.relative_pose(one, pose.reshape(-1, 7)[-1])
        torch.testing.assert_close(rot.relative_pose(one, pose).reshape(-1, 6)[-1], alone)
