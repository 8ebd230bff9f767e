"""The FK consistency loss: zero at the target, the stated units, gradients that are finite and useful."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize
import torch

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.fk_loss import fk_consistency_loss
from lerobot_mimicik.kinematics.rotations import apply_relative_pose


@pytest.fixture(params=[torch.float32, torch.float64])
def arm(request) -> SerialArm:
    return SerialArm(describe_arm("airbot_play"), dtype=request.param)


@pytest.fixture
def home(arm) -> torch.Tensor:
    return torch.tensor(arm.description.home, dtype=arm.dtype)


def moved(arm: SerialArm, q: torch.Tensor, *step: float) -> torch.Tensor:
    return apply_relative_pose(arm.forward(q), torch.tensor(step, dtype=arm.dtype))


def test_the_loss_is_zero_at_the_target_in_either_half_sphere(arm, home):
    pose = arm.forward(home)
    other_half = torch.cat((pose[:3], -pose[3:]))
    assert fk_consistency_loss(arm, home, pose, 1.0) < 1e-8
    assert fk_consistency_loss(arm, home, other_half, 1.0) < 1e-8


def test_terms_have_the_stated_units(arm, home):
    shifted = moved(arm, home, 0.003, 0, -0.004, 0, 0, 0)
    turned = moved(arm, home, 0, 0, 0, 0.0, 0.1, 0)
    tolerance = {"rtol": 1e-3, "atol": 0.0}
    for actual, expected in [
        (fk_consistency_loss(arm, home, shifted, 7.0, position_scale=1.0), 0.005**2),
        (fk_consistency_loss(arm, home, shifted, 7.0, position_scale=0.005), 1.0),
        (fk_consistency_loss(arm, home, turned, 1.0, position_scale=1.0), 4 * math.sin(0.05) ** 2),
        (fk_consistency_loss(arm, home, turned, 5.0, position_scale=1.0), 5 * 4 * math.sin(0.05) ** 2),
        (fk_consistency_loss(arm, home, turned, 0.0, position_scale=1.0) + 1, 1.0),
    ]:
        torch.testing.assert_close(actual.double(), torch.tensor(expected, dtype=torch.float64), **tolerance)


def test_small_rotations_are_not_lost_in_float32():
    arm = SerialArm(describe_arm("airbot_play"))
    home = torch.tensor(arm.description.home)
    loss = fk_consistency_loss(arm, home, moved(arm, home, 0, 0, 0, 1e-4, 0, 0), 1.0, position_scale=1.0)
    torch.testing.assert_close(loss, torch.tensor(1e-8), rtol=0.05, atol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-4, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, -0.8)])
def test_gradients_are_finite_from_no_error_to_the_half_turn(arm, home, angle, axis):
    q = home.clone().requires_grad_()
    target = moved(arm, home, 0, 0, 0, *(angle * component for component in axis))
    (gradient,) = torch.autograd.grad(fk_consistency_loss(arm, q, target, 1.0), q)
    assert torch.isfinite(gradient).all()
    if angle == 0:
        assert gradient.abs().max() < 1e-2  # rounding of the target, in units of the position scale


def test_the_gradient_is_right():
    arm = SerialArm(describe_arm("airbot_play", tool_offset=(0.16, 0, 0)), dtype=torch.float64)
    home = torch.tensor(arm.description.home, dtype=torch.float64)
    q = home + 0.1 * torch.randn(4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    target = arm.forward(home)
    assert torch.autograd.gradcheck(lambda q: fk_consistency_loss(arm, q, target, 2.0), q.requires_grad_())


def test_descending_the_gradient_reaches_the_target():
    arm = SerialArm(describe_arm("piper"), dtype=torch.float64)
    home = torch.tensor(arm.description.home, dtype=torch.float64)
    target = arm.forward(home)

    def loss_and_gradient(values: np.ndarray) -> tuple[float, np.ndarray]:
        q = torch.from_numpy(values).requires_grad_()
        loss = fk_consistency_loss(arm, q, target, 10.0, position_scale=0.1)
        (gradient,) = torch.autograd.grad(loss, q)
        return loss.item(), gradient.numpy()

    result = scipy.optimize.minimize(loss_and_gradient, home.numpy() + 0.05, jac=True, method="BFGS")
    np.testing.assert_allclose(result.x, home.numpy(), atol=1e-4)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_there_is_one_loss_per_sample(shape):
    arm = SerialArm(describe_arm("airbot_play"))
    q = torch.rand(*shape, 6)
    target = arm.forward(torch.rand(*shape, 6))
    loss = fk_consistency_loss(arm, q, target, 1.0)
    assert loss.shape == shape
    if loss.numel():
        alone = fk_consistency_loss(arm, q.reshape(-1, 6)[-1], target.reshape(-1, 7)[-1], 1.0)
        torch.testing.assert_close(loss.reshape(-1)[-1], alone)


def test_what_does_not_fit_is_refused():
    arm = SerialArm(describe_arm("airbot_play"))
    with pytest.raises(ValueError, match=r"target poses of shape \(\*, 7\).*\(6,\)"):
        fk_consistency_loss(arm, torch.zeros(6), torch.zeros(6), 1.0)
    with pytest.raises(ValueError, match=r"joints of shape \(\*, 6\)"):
        fk_consistency_loss(arm, torch.zeros(7), torch.zeros(7), 1.0)
    with pytest.raises(ValueError, match=r"position_scale must be above 0 m, found 0"):
        fk_consistency_loss(arm, torch.zeros(6), torch.zeros(7), 1.0, position_scale=0.0)
