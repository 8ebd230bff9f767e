"""What the network is told of a target near and far."""

import pytest
import torch

from lerobot_mimicik.conditioning import RelativeConditioning
from lerobot_mimicik.kinematics.rotations import apply_relative_pose

Q, HERE = torch.zeros(1, 6), torch.tensor([[0.3, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0]])
LARGEST = torch.tensor([0.02, 0.03, 0.01, 0.1, 0.2, 0.0])


@pytest.fixture
def conditioning():
    conditioning = RelativeConditioning(6)
    # The last rotation was never used in training.
    conditioning.relative.fit(-0.5 * LARGEST, LARGEST)
    return conditioning


def told(conditioning, relative):
    """The step that the network is asked for, (6,), where the target lies at a relative pose."""
    step = torch.as_tensor(relative)[None]
    observation = conditioning(Q, HERE, apply_relative_pose(HERE, step))
    return conditioning.relative.unnormalise(observation[0, -6:])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_target_as_in_training_is_told_as_it_is(conditioning, share):
    torch.testing.assert_close(told(conditioning, share * LARGEST), share * LARGEST)
    torch.testing.assert_close(told(conditioning, -0.5 * share * LARGEST), -0.5 * share * LARGEST)


def test_a_dimension_that_training_never_used_limits_nothing(conditioning):
    step = torch.tensor([0.01, 0.0, 0.0, 0.0, 0.0, 0.05])
    torch.testing.assert_close(told(conditioning, step), step)


@pytest.mark.parametrize("times", [1.2, 2.0, 3.0, 20.0])
def test_a_far_target_is_a_step_towards_it(conditioning, times):
    for direction in (
        torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        torch.tensor([0.5, -0.1, 0.3, 0, 0.1, 0]),
    ):
        step = told(conditioning, times * direction * LARGEST)
        scale = step @ (direction * LARGEST) / (direction * LARGEST).square().sum()
        torch.testing.assert_close(step, scale * direction * LARGEST)
        largest = (direction * torch.where(direction > 0, 1.0, 2.0)).abs().max()
        assert 0.5 - 1e-4 <= scale * largest <= 1.0 + 1e-4


def test_the_further_the_more_cautious_and_nowhere_a_jump(conditioning):
    sizes = torch.linspace(0.9, 4.0, 200)
    steps = torch.stack([told(conditioning, size * LARGEST)[0] for size in sizes])
    assert steps.diff().abs().max() < 0.02 * LARGEST[0]
    torch.testing.assert_close(steps[-1], 0.5 * LARGEST[0])
